"""Conversion of figures to plotly documents in pages, and of plotly documents to figures.

The function `plotly_of` converts a panel into the plotly document that is embedded in a page. The
function `placed_figures` reads all figures of a page. The command `hil figures` can therefore
export figures from the page alone, even if the recordings were deleted, and from pages of all
earlier versions of hil.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass, replace
from html import escape, unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from hil.core import DataError, FloatArray, json_text
from hil.report.colours import FILL, LIMIT, NEUTRAL, OFTEN, SELDOM
from hil.report.curves import categories, diagonal, has_names, x_of, y_of
from hil.studies import Axis, Band, Curve, Figure, Grid, Look, Mark, Panel, Scale

Trace: TypeAlias = dict[str, Any]

BAND_FROM = 30
"""Maximum number of points of a line with individual error bars; for more points, the error is
drawn as two edge lines.

With more points, individual error bars would overlap.
"""

LEFT = {"showarrow": False, "xanchor": "left", "yanchor": "top"}
DOTS = {"color": NEUTRAL, "width": 1.5, "dash": "dot"}
TICK = "line-ew-open"
BROAD = 9
"""Thickness of a range bar [px]; the ends of the bar are drawn with a line of 1 px."""


def plotly_of(panel: Panel) -> dict[str, Any]:
    """Return `{"data": [traces], "layout": {…}}` of a dressed panel; arrays are not converted."""
    bars = any(curve.style == "bars" for curve in panel.curves)
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": escape(panel.x_title)}} | _scale(panel.x_axis, None),
        "yaxis": {"title": {"text": escape(panel.y_title)}} | _scale(panel.y_axis, panel),
        "showlegend": bars,
        "shapes": [*_band(panel.band), *map(_mark, panel.marks)],
        "annotations": [
            {"x": mark.x, "text": escape(mark.text), "yref": "paper", "y": 1} | LEFT
            for mark in panel.marks
            if mark.text
        ],
    }
    if bars:
        layout["barmode"] = "group"
    if names := categories(panel):
        shown = [escape(name) for name in names]
        layout["xaxis"] |= {"type": "category", "tickmode": "array", "tickvals": shown}
        layout["xaxis"] |= {"categoryorder": "array", "categoryarray": shown}
    if panel.corner:
        corner = {"xref": "paper", "yref": "paper", "x": 0.03, "y": 0.97}
        layout["annotations"] += [{"text": escape(panel.corner)} | corner | LEFT]
    data = [trace for curve in panel.curves for trace in _traces(panel, curve)]
    return {"data": data + ([_heatmap(panel.grid)] if panel.grid else []), "layout": layout}


def _scale(axis: Axis, panel: Panel | None) -> dict[str, Any]:
    if axis.scale == "date":
        return {"type": "date", "nticks": 4}
    out: dict[str, Any] = {"type": "log"} if axis.scale == "log" else {}
    if axis.limits:
        ends = axis.limits
        out["range"] = [math.log10(end) for end in ends] if axis.scale == "log" else list(ends)
    if axis.scale == "log" and panel is not None:
        out |= _decades(axis, panel)
    if axis.from_zero:
        out["rangemode"] = "tozero"
    return out | ({"dtick": 1} if axis.whole else {})


def _decades(axis: Axis, panel: Panel) -> dict[str, Any]:
    """Return the plotly settings for the ticks of a logarithmic axis.

    The ticks of the axis are 1, 2 and 5 per decade for a narrow range, and powers of ten for a wide
    range.
    """
    values = np.concatenate([np.empty(0), *(y_of(curve) for curve in panel.curves)])
    values = values[np.isfinite(values) & (values > 0)]
    low, high = axis.limits or ((values.min(), values.max()) if len(values) else (1.0, 1.0))
    decades = math.log10(high / low)
    if decades < 2.5:
        return {"dtick": "D2"}
    return {"exponentformat": "power", "dtick": max(1, math.ceil(decades / 6))}


def _band(band: Band | None) -> list[dict[str, Any]]:
    if band is None or not np.isfinite(band.half):
        return []
    across = {"xref": "paper", "x0": 0, "x1": 1, "layer": "below"}
    edge = {"type": "line", "line": {"color": LIMIT, "width": 1}} | across
    area = {"type": "rect", "y0": -band.half, "y1": band.half, "line": {"width": 0}} | across
    area |= {"fillcolor": LIMIT, "opacity": 0.25}
    return [area, *(edge | {"y0": y, "y1": y} for y in (-band.half, band.half))]


def _mark(mark: Mark) -> dict[str, Any]:
    ends = {"x0": mark.x, "x1": mark.x, "yref": "paper", "y0": 0, "y1": 1}
    return {"type": "line", "line": DOTS} | ends


def _traces(panel: Panel, curve: Curve) -> list[Trace]:
    """Return the plotly traces of a curve in drawing order."""
    look = curve.look
    assert look is not None, "dress the figure first"
    if curve.style == "identity":
        ends = diagonal(panel)
        return _traces(panel, replace(curve, x=ends, y=ends, style="line"))
    named = has_names(curve)
    x: Any = [escape(str(name)) for name in curve.x] if named else x_of(curve)
    y = y_of(curve)
    own: Trace = {"type": "scatter", "name": escape(curve.name), "x": x, "y": y}
    if curve.hover:
        own["text"] = [escape(word) for word in curve.hover]
    error = np.asarray(curve.y_error, dtype=np.float64)
    if curve.style == "bars":
        pattern = {"color": look.colour, "pattern": {"shape": look.pattern}}
        bar = own | {"type": "bar", "marker": pattern}
        return [bar | ({"error_y": _error(error, NEUTRAL)} if len(error) else {})]
    if curve.style == "ticks":
        tick = {"symbol": TICK, "size": 30, "color": look.colour, "line": {"width": 4}}
        return [own | {"mode": "markers", "marker": tick}]
    # The legend above all panels shows all curves except bars.
    own["showlegend"] = False
    line = {"color": look.colour, "dash": look.dash, "width": look.width}
    mark = {"color": look.colour, "symbol": look.symbol, "size": look.size or _size(len(y))}
    if curve.style == "ranges":
        # Separate bars, because a line would suggest values between the points.
        own |= {"mode": "markers", "hoverinfo": "skip", "marker": mark | {"size": 1}}
        both = (_error(error, FILL, BROAD, 0), _error(error, NEUTRAL, 1, 4.5))
        return [own | {"error_y": bar} for bar in both]
    if curve.style == "points":
        own |= {"mode": "markers", "marker": mark | {"opacity": look.opacity}}
    elif curve.style == "marked":
        mark["size"] = look.size or 6
        own |= {"mode": "lines+markers", "line": line, "marker": mark}
    else:
        own |= {"mode": "lines", "line": line}
    if not len(error):
        return [own]
    if curve.style != "line" or len(y) <= BAND_FROM or named:
        return [own | {"error_y": _error(error, look.colour)}]
    edge = own | {"line": line | {"dash": "dot", "width": 1.0}}
    sides = ((y + error, f"{curve.name} + error"), (y - error, f"{curve.name} − error"))
    return [*(edge | {"y": values, "name": escape(name)} for values, name in sides), own]


def _error(error: FloatArray, colour: str, thick: float = 1.4, width: float = 3) -> dict[str, Any]:
    return {"type": "data", "array": error, "color": colour, "thickness": thick, "width": width}


def _size(points: int) -> float:
    """Return the mark size [px], which decreases with the number of points."""
    return 3.0 if points > 300 else 4.0 if points > 100 else 6.0 if points > 30 else 9.0


def _heatmap(grid: Grid) -> Trace:
    most = 10.0 ** float(np.nanmax(grid.log_count, initial=0.0))
    shown = [n for k in range(8) for n in (10**k, 3 * 10**k) if n <= most * (1 + 1e-9)]
    return {
        "type": "heatmap",
        "x": grid.x,
        "y": grid.y,
        "z": grid.log_count,
        "colorscale": [[0, SELDOM], [1, OFTEN]],
        "colorbar": {
            "title": {"text": "samples [1]", "side": "right"},
            "tickvals": [math.log10(n) for n in shown],
            "ticktext": [str(n) for n in shown],
            "thickness": 9,
            "outlinewidth": 0,
        },
        "hovertemplate": "%{x:.3g}, %{y:.3g}: 10^%{z:.1f} samples<extra></extra>",
    }


_HTML_SAFE = str.maketrans(
    {"<": "\\u003c", ">": "\\u003e", "&": "\\u0026", "\u2028": "\\u2028", "\u2029": "\\u2029"}
)


def figure_json(figure: dict[str, Any]) -> str:
    """Return a figure as JSON with arrays as base64-encoded float32, for plotly.js.

    The seven significant digits of float32 exceed the resolution of a plot; float32 arrays take
    less than half the size of text. The characters `<`, `>` and `&` are escaped, so that no text in
    the JSON can end the enclosing script element.
    """
    text = json_text(_plain(figure), separators=(",", ":"), allow_nan=False)
    return text.translate(_HTML_SAFE)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        packed = np.ascontiguousarray(value, dtype="<f4")
        out = {"dtype": "f4", "bdata": base64.b64encode(packed.tobytes()).decode("ascii")}
        if packed.ndim > 1:
            out["shape"] = ", ".join(str(n) for n in packed.shape)
        return out
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


@dataclass(frozen=True, slots=True)
class Placed:
    """Figure of a page, with the section that contains the figure.

    Attributes:
        section: Id of the section in the page.
        place: Heading of the section.
        figure: The figure.
    """

    section: str
    place: str
    figure: Figure


def placed_figures(page: Path) -> list[Placed]:
    """Return all figures of a page.

    Raises:
        DataError: The file cannot be read, is not a page written by hil, or contains no plots.
    """
    try:
        text = page.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{page} cannot be read: {error}", hint="check whether it exists and its permissions"
        ) from error
    reader = _Reader()
    try:
        reader.feed(text)
        reader.close()
    except (ValueError, LookupError) as error:
        raise DataError(
            f"{page} is damaged or was not written by hil: {error}",
            hint="write the page again: hil report RUN",
        ) from error
    found = reader.placed()
    if not found:
        raise DataError(f"{page} has no plots", hint="name a page written by hil, or a run")
    return found


class _Reader(HTMLParser):
    """HTML parser that collects headings, captions and the plotly documents of a page."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self._plots: list[tuple[str, str, str, list[Panel]]] = []
        self._section = self._place = self._caption = self._open = ""
        self._wide = False
        self._text: list[str] = []

    def placed(self) -> list[Placed]:
        """Return the figures that the parser has read so far.

        Panels with the full width of the page become separate figures.
        """
        out = []
        for section, place, title, panels in self._plots:
            apart = len(panels) > 1 and all(panel.wide for panel in panels)
            parts = [(panel.title, [panel]) for panel in panels] if apart else [(title, panels)]
            for heading, some in parts:
                per_row = 1 if any(panel.wide for panel in some) else 3
                if some:
                    figure = Figure("", heading, "", tuple(some), per_row)
                    out.append(Placed(section, place, figure))
        return out

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        if tag == "h2":
            self._section = named.get("id") or ""
        if tag == "figure":
            self._wide = "wide" in (named.get("class") or "").split()
        if tag in ("h2", "h3", "figcaption") or (
            tag == "script" and named.get("type") == "application/json" and "id" not in named
        ):
            self._open, self._text = tag, []

    def handle_data(self, data: str) -> None:
        if self._open:
            self._text.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag != self._open:
            return
        text, self._open = "".join(self._text), ""
        if tag == "h2":
            self._place = text
        elif tag == "h3":
            self._plots.append((self._section, self._place, text, []))
        elif tag == "figcaption":
            self._caption = text
        else:
            self._plots[-1][3].append(self._panel(text))

    def _panel(self, text: str) -> Panel:
        """Return the panel that a plotly document describes.

        Raises:
            ValueError: The document is invalid, for example in an old or damaged page.
        """
        try:
            return panel_of(json.loads(text), self._caption, wide=self._wide)
        except KeyError as error:
            raise ValueError(f"in the plot {self._caption!r}: {error} is missing") from error
        except (ValueError, TypeError, IndexError, AttributeError) as error:
            raise ValueError(f"in the plot {self._caption!r}: {error}") from error


def panel_of(raw: Any, title: str, *, wide: bool = False) -> Panel:
    """Return the panel that a plotly document describes: the inverse of `plotly_of`.

    Raises:
        KeyError, ValueError, TypeError, IndexError, AttributeError: The plotly document is damaged.
    """
    layout, curves, grid = raw["layout"], list[Curve](), None
    for trace in raw["data"]:
        if trace["type"] == "heatmap":
            x, y, z = (_array(trace[name]) for name in "xyz")
            if z.shape != (len(y), len(x)):
                raise ValueError(f"z is {z.shape}, but must be {(len(y), len(x))}")
            grid = Grid(x, y, z)
        elif trace["type"] == "bar":
            pattern = (trace["marker"].get("pattern") or {}).get("shape") or ""
            look = Look(str(trace["marker"]["color"]), pattern=str(pattern))
            curves.append(_curve(trace, "bars", look))
        elif trace["type"] == "scatter":
            curves += _scatter(trace)
        else:
            raise ValueError(f"a trace has the unknown type {trace['type']!r}")
    texts = [(text, str(text["text"])) for text in layout.get("annotations") or ()]
    said = {str(text["x"]): unescape(word) for text, word in texts if text.get("xref") != "paper"}
    corner = [unescape(word) for text, word in texts if text.get("xref") == "paper"]
    shapes = layout.get("shapes") or ()
    places = [shape["x0"] for shape in shapes if shape.get("yref") == "paper"]
    halves = [float(shape["y1"]) for shape in shapes if shape["type"] == "rect"]
    return Panel(
        title,
        unescape(str(layout["xaxis"]["title"]["text"])),
        unescape(str(layout["yaxis"]["title"]["text"])),
        tuple(curves),
        corner[0] if corner else "",
        wide=wide,
        x_axis=_axis(layout["xaxis"]),
        y_axis=_axis(layout["yaxis"]),
        band=Band("", halves[0]) if halves else None,
        marks=tuple(Mark(place, said.get(str(place), "")) for place in places),
        grid=grid,
    )


def _scatter(trace: Any) -> list[Curve]:
    """Return the curve of a plotly trace in a list.

    The list is empty for a trace with the ends of a range, which belong to the curve of a different
    trace.
    """
    line, mark, mode = trace.get("line") or {}, trace.get("marker") or {}, str(trace["mode"])
    symbol = str(mark.get("symbol") or "circle")
    thick = float((trace.get("error_y") or {}).get("thickness") or 0)
    look = Look(
        str(line.get("color") or mark["color"]),
        str(line.get("dash") or "solid"),
        symbol,
        width=float(line.get("width") or 1.6),
        size=float(mark.get("size") or 4),
        opacity=float(mark.get("opacity") or 1.0),
    )
    if look.size == 1 and thick:
        return [_curve(trace, "ranges", look)] if thick == BROAD else []
    if symbol == TICK:
        return [_curve(trace, "ticks", look)]
    if "lines" in mode:
        return [_curve(trace, "marked" if "markers" in mode else "line", look)]
    return [_curve(trace, "points", look)]


def _curve(trace: Any, style: Any, look: Look) -> Curve:
    raw, y = trace["x"], _array(trace["y"])
    named = isinstance(raw, list) and any(isinstance(value, str) for value in raw)
    x: Any = [unescape(str(value)) for value in raw] if named else _array(raw)
    if np.ndim(x) != 1 or y.ndim != 1 or len(x) != len(y):
        raise ValueError(f"a trace has {np.size(x)} values of x and {y.size} of y")
    error = _array(trace["error_y"]["array"]) if trace.get("error_y") else ()
    if len(error) not in (0, len(y)):
        raise ValueError(f"a trace has {len(error)} error bars for {len(y)} values")
    return Curve(unescape(str(trace.get("name") or "")), x, y, style, error, look)


def _array(value: Any) -> FloatArray:
    """Return an array that is stored as base64 data, or as a list in which null stands for NaN."""
    if isinstance(value, dict):
        packed = np.frombuffer(base64.b64decode(value["bdata"]), "<f4").astype(np.float64)
        return packed.reshape([int(n) for n in str(value.get("shape", packed.size)).split(",")])
    if not isinstance(value, list):
        raise ValueError("expected a list of numbers")
    return np.array(value, dtype=np.float64)


def _axis(raw: Any) -> Axis:
    scale: Scale = raw["type"] if raw.get("type") in ("log", "date") else "linear"
    ends = raw.get("range")
    limits = None
    if ends:
        low, high = (float(end) for end in ends)
        limits = (10.0**low, 10.0**high) if scale == "log" else (low, high)
    return Axis(scale, limits, raw.get("rangemode") == "tozero", raw.get("dtick") == 1)
