"""Export of figures to files: one-column or full-page figures for papers, and themed SVG.

The exported figures have the same looks as the plotly figures in a page, and are distinguishable
without colour. Equal figures are exported as byte-identical files. The library matplotlib is
imported only when needed.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from hil.core import FloatArray
from hil.report.colours import DARK, DOWN, FILL, LIMIT, NEUTRAL, OFTEN, SELDOM, UP
from hil.report.curves import categories, diagonal, dressed, has_names, x_of, y_of
from hil.report.plotly_figure import BAND_FROM
from hil.studies import Curve, Figure, Grid, Look, Mark, Panel, Span

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Sheet
    from matplotlib.figure import SubFigure

Place: TypeAlias = Literal["outside upper center", "outside lower center"]
WIDTHS = {"column": 88.0, "page": 181.0}
"""Figure widths of robotics journals [mm]: width of one column, and of the full page."""

MM = 1 / 25.4
"""Length of one millimetre in inches."""
LETTER = 1.25
"""Average width of a character in an axis title or a legend [mm]."""
LEAST_PANEL = 40.0
"""Minimum width of a panel [mm]; panels that would be narrower are moved to the next row."""
MOST_PER_ROW = 3
POINTS = 1000
"""Maximum number of points of a line or cloud, more than are visible in a print of 88 mm width."""
PRINT = 0.55
"""Size in print [pt] of one screen pixel."""

STYLE: Any = {
    "font.family": "DejaVu Sans",  # part of matplotlib, so that every machine draws the same
    "font.size": 6.5,
    "axes.titlesize": 7,
    "axes.labelsize": 6.5,
    "axes.labelpad": 2,
    "axes.titlepad": 3,
    "xtick.labelsize": 6,
    "ytick.labelsize": 6,
    "xtick.major.size": 2,
    "ytick.major.size": 2,
    "xtick.major.pad": 1.5,
    "ytick.major.pad": 1.5,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "axes.linewidth": 0.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.4,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "legend.columnspacing": 1.2,
    "lines.linewidth": 0.9,
    "lines.markersize": 2.2,
    "hatch.linewidth": 0.4,
    "text.parse_math": False,  # a dollar sign in a title is plain text
    "axes.unicode_minus": True,
    "pdf.fonttype": 42,  # embed TrueType: publishers reject bitmap fonts
    "svg.fonttype": "path",
    "svg.hashsalt": "hil",
    "savefig.dpi": 600,
    "axes.formatter.useoffset": False,
}

LINES: dict[str, Any] = {
    "solid": "-",
    "dash": (0, (4, 1.5)),
    "dot": (0, (1, 1.2)),
    "longdash": (0, (7, 2)),
    "dashdot": (0, (4, 1.2, 1, 1.2)),
    "longdashdot": (0, (7, 1.5, 1, 1.5)),
}
MARKS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "triangle-down": "v",
    "cross": "P",
    "x": "x",
    "line-ew": "_",
}
"""Matplotlib markers by plotly symbol name; the suffix `-open` of a name selects the outline
only.
"""
HATCHES = {"": "", "/": "/////", "x": "xxxxx", ".": ".....", "\\": "\\\\\\\\\\", "+": "+++++",
           "-": "-----"}  # fmt: skip

METADATA: dict[str, dict[str, Any]] = {
    "pdf": {"CreationDate": None, "Producer": None, "Creator": "hil"},
    "svg": {"Date": None, "Creator": "hil"},
    "png": {"Software": None},
}
"""Metadata of exported files without times and versions, so that equal figures yield
byte-identical files.
"""


def drawn(figure: Figure, format_: str, width: str = "column") -> bytes:
    """Return the figure as the content of a file.

    Args:
        figure: Figure that is drawn.
        format_: File format: `pdf`, `svg` or `png`.
        width: Figure width: `column` or `page`.
    """
    figure, whole = dressed(_with_few_marked(figure), POINTS), WIDTHS[width]
    columns = _columns(figure, whole)
    rows = math.ceil(len(figure.panels) / columns) or 1
    height = rows * _height(figure, whole / columns) + 7
    return on_sheet(lambda sheet: draw(sheet, figure, whole), whole, height, format_)


def on_sheet(
    draw: Callable[[Sheet], None],
    width: float,
    height: float,
    format_: str,
    *,
    text: bool = False,
) -> bytes:
    """Return the file content of a sheet of `width` × `height` mm, drawn by the function `draw`.

    If `text` is true, an SVG file contains its text as characters instead of paths. An SVG file
    with text as characters is smaller and searchable, and uses a font of the viewer.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure as Sheet
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    out = io.BytesIO()
    fonts = {"svg.fonttype": "none"} if text else {}
    with mpl.rc_context(STYLE | fonts):
        apart = ConstrainedLayoutEngine(w_pad=1.5 * MM, h_pad=1 * MM, wspace=0.02, hspace=0.02)
        sheet = Sheet(figsize=(width * MM, height * MM), layout=apart)
        draw(sheet)
        sheet.savefig(out, format=format_, metadata=METADATA[format_])
    return out.getvalue()


THEME = {
    "#ffffff": ("page", "#15181c"),
    "#000000": ("ink", "#ececec"),
    STYLE["grid.color"].lower(): ("grid", "#2d3238"),
    **{light.lower(): (f"c{i}", dark.lower()) for i, (light, dark) in enumerate(DARK.items())},
}
"""Tuple of the name in the style sheet and the colour in dark mode, by colour in light mode."""


def following_the_screen(svg: bytes) -> str:
    """Return an SVG of the sheet of `on_sheet`, with colours for light and dark mode."""
    text = svg.decode()
    text = text[text.index("<svg") :]
    # Coordinates are rounded to 0.01 pt, which is invisible and halves the file size.
    parts = re.split(r"(<text\b.*?</text>)", text, flags=re.DOTALL)  # names possibly contain digits
    parts[::2] = [re.sub(r"(\d\.\d\d)\d+", r"\1", part) for part in parts[::2]]
    text = "".join(parts)
    # Without a fixed size, the picture fills its container.
    text = re.sub(r' (width|height)="[0-9.]+pt"', "", text, count=2)
    # The metadata would contain URLs of other sites.
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for light, (name, _) in THEME.items():
        text = re.sub(rf'(fill|stroke)(: |="){light}\b', rf"\1\2var(--{name}, {light})", text)
    light_sheet = " ".join(f"--{name}: {light};" for light, (name, _) in THEME.items())
    dark_sheet = " ".join(f"--{name}: {dark};" for name, dark in THEME.values())
    style = (
        f"<style>svg {{ {light_sheet} }} text {{ fill: var(--ink); }} "
        f"@media (prefers-color-scheme: dark) {{ svg {{ {dark_sheet} }} }}</style>"
    )
    end = text.index(">") + 1
    return f'{text[: end - 1]} role="img">{style}{text[end:]}'


def draw(
    sheet: Sheet | SubFigure, figure: Figure, width: float, legend: Place = "outside upper center"
) -> None:
    """Draw a dressed figure on a sheet of `width` mm.

    Panels below each other share the labels of the x axis if the panels have the same x axis.
    """
    columns = _columns(figure, width)
    rows = math.ceil(len(figure.panels) / columns) or 1
    slanted = _slanted(figure, width / columns)
    shown: dict[str, Any] = {}
    places = [sheet.add_subplot(rows, columns, i + 1) for i in range(len(figure.panels))]
    for axes, panel in zip(places, figure.panels, strict=True):
        shown |= _panel(axes, panel, slanted=slanted)
        if len(places) > 1 and panel.title:
            axes.set_title(_folded(panel.title, width / columns))
    _titles(sheet, places, figure.panels, columns, width)
    if columns == 1 and figure.panels and len({panel.x_axis for panel in figure.panels}) == 1:
        for axes, panel in zip(places[:-1], figure.panels, strict=False):
            axes.tick_params(labelbottom=panel.x_axis.limits is None)
    if len(shown) > 1:
        _legend(sheet, shown, width, legend)


def _with_few_marked(figure: Figure) -> Figure:
    """Add markers to lines with few points, if these lines have no explicit look."""
    panels = [
        replace(
            panel,
            curves=tuple(
                replace(curve, style="marked")
                if curve.style == "line" and curve.look is None and len(curve.y) <= BAND_FROM
                else curve
                for curve in panel.curves
            ),
        )
        for panel in figure.panels
    ]
    return replace(figure, panels=tuple(panels))


def _columns(figure: Figure, width: float) -> int:
    """Return the number of panels side by side, limited by the minimum panel width."""
    asked = figure.per_row or MOST_PER_ROW
    return max(1, min(asked, len(figure.panels), int(width // LEAST_PANEL)))


def _height(figure: Figure, width: float) -> float:
    """Return the height of one panel [mm].

    Regression plots are square; panels with long names below their bars have additional height.
    """
    square = any(c.style == "identity" for panel in figure.panels for c in panel.curves)
    names = max((len(name) for panel in figure.panels for name in categories(panel)), default=0)
    tall = width * 0.95 if square else min(width * 0.78, 50.0)
    return tall + (min(names, 24) * 0.8 if _slanted(figure, width) else 0.0)


def _slanted(figure: Figure, width: float) -> bool:
    """Return whether the names along x would overlap if written horizontally."""
    named = [categories(panel) for panel in figure.panels]
    return max((sum(len(name) + 1 for name in names) for names in named), default=0) > width / 1.6


def _titles(
    sheet: Sheet | SubFigure,
    places: Sequence[Axes],
    panels: Sequence[Panel],
    columns: int,
    width: float,
) -> None:
    """Draw the titles of the x axes and the y axes.

    An axis title that all panels share is drawn only one time, below or beside all panels.
    """
    x, y = ({getattr(panel, name) for panel in panels} for name in ("x_title", "y_title"))
    if len(x) == 1 and columns == 1 and places:
        places[-1].set_xlabel(_folded(panels[-1].x_title, width))
    elif len(x) == 1 and len(places) > 1:
        sheet.supxlabel(_folded(min(x), width), fontsize=STYLE["axes.labelsize"])
    if len(y) == 1 and len(places) > columns:
        sheet.supylabel(_folded(min(y), 60), fontsize=STYLE["axes.labelsize"])
    for i, (axes, panel) in enumerate(zip(places, panels, strict=True)):
        if len(x) > 1:
            axes.set_xlabel(_folded(panel.x_title, width / columns))
        if len(y) > 1 or (len(places) <= columns and i == 0):
            axes.set_ylabel(_folded(panel.y_title, 40))


def _folded(text: str, room: float) -> str:
    """Return a title, wrapped into lines of at most `room` mm."""
    return "\n".join(wrap(text, max(12, int(room / LETTER)))) if text else ""


def _legend(sheet: Sheet | SubFigure, shown: Mapping[str, Any], width: float, place: Place) -> None:
    """Draw the legend above all panels: in one row if possible, otherwise in equal columns."""
    from matplotlib.lines import Line2D

    rooms = [10 + LETTER * len(name) for name in shown]
    across = len(rooms) if sum(rooms) < width else max(1, int(width / max(rooms)))
    drawn = sheet.legend(list(shown.values()), list(shown), loc=place, ncols=across)
    for handle in drawn.legend_handles:
        if isinstance(handle, Line2D):  # marks of a dense cloud are too small for a legend
            handle.set_markersize(3.5)
            handle.set_alpha(1)


def _panel(axes: Axes, panel: Panel, *, slanted: bool) -> dict[str, Any]:
    """Draw a panel and return its legend handles by name."""
    names, shown = categories(panel), dict[str, Any]()
    for span in panel.spans:
        _span(axes, span)
    if panel.band and np.isfinite(panel.band.half):
        half = panel.band.half
        area = axes.axhspan(-half, half, color=LIMIT, alpha=0.25, lw=0)
        for edge in (-half, half):
            axes.axhline(edge, color=LIMIT, lw=PRINT)
        if panel.band.name:
            shown[panel.band.name] = area
    bars = [curve for curve in panel.curves if curve.style == "bars"]
    for curve in panel.curves:
        look = curve.look
        assert look is not None, "dress the figure first"
        if curve.style == "identity":
            ends = diagonal(panel)
            artist = _line(axes, replace(curve, x=ends, y=ends, style="line"), look, names)
            _square(axes, ends)
        elif curve.style == "bars":
            place = next(i for i, each in enumerate(bars) if each is curve)
            artist = _bars(axes, curve, look, names, (place, len(bars)))
        elif curve.style == "ranges":
            artist = _ranges(axes, curve, names)
        else:
            artist = _line(axes, curve, look, names)
        if curve.name:
            shown.setdefault(curve.name, artist)
    if panel.grid:
        _grid(axes, panel.grid)
    for mark in panel.marks:
        shown |= _mark(axes, mark)
    if panel.corner:
        axes.text(0.04, 0.96, panel.corner, transform=axes.transAxes, va="top", **_BOXED)
    _scales(axes, panel)
    if names:
        turned: dict[str, Any] = (
            {"rotation": 50, "ha": "right", "rotation_mode": "anchor"} if slanted else {}
        )
        axes.set_xticks(range(len(names)), names, **turned)
        axes.grid(visible=False, axis="x")
    return shown


_BOXED: dict[str, Any] = {
    "bbox": {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1},
    "zorder": 5,
}


def _line(axes: Axes, curve: Curve, look: Look, names: Sequence[str]) -> Any:
    """Draw a line, markers, or a line with markers; open symbols are drawn as outlines."""
    x, y = _places(curve, names), y_of(curve)
    symbol, lined = look.symbol, curve.style in ("line", "marked")
    is_open, marked = symbol.endswith("-open"), curve.style != "line"
    # The fewer the marks, the larger each is drawn.
    size = PRINT * look.size or (3.5 if len(y) <= 60 else 1.8 if len(y) <= 400 else 1.3)
    edge = 1.5 if curve.style == "ticks" else 0.7 if is_open or symbol == "x" else 0.0
    (artist,) = axes.plot(
        x,
        y,
        color=look.colour,
        ls=LINES[look.dash] if lined else "",
        lw=PRINT * look.width,
        marker=MARKS[symbol.removesuffix("-open")] if marked else "",
        ms=PRINT * 30 if curve.style == "ticks" else 2.5 if lined and not look.size else size,
        mfc="none" if is_open else look.colour,
        mec=look.colour,
        mew=0.25 if is_open and len(y) > 60 else edge,
        alpha=None if lined or curve.style == "ticks" else look.opacity,
        zorder=2.5 if lined else 4 if len(y) <= 60 else 2,
    )
    error = np.asarray(curve.y_error, dtype=np.float64)
    if len(error) and curve.style == "line" and len(y) > BAND_FROM:
        axes.fill_between(x, y - error, y + error, color=look.colour, alpha=0.2, lw=0)
    elif len(error):
        axes.errorbar(x, y, yerr=error, fmt="none", ecolor=look.colour, lw=0.6, capsize=1.2)
    return artist


def _bars(
    axes: Axes, curve: Curve, look: Look, names: Sequence[str], place: tuple[int, int]
) -> Any:
    number, of = place
    wide = 0.8 / of
    error = np.asarray(curve.y_error, dtype=np.float64)
    return axes.bar(
        _places(curve, names) + (number - (of - 1) / 2) * wide,
        y_of(curve),
        wide,
        yerr=error if len(error) else None,
        facecolor="white" if look.pattern else look.colour,
        edgecolor=look.colour,
        hatch=HATCHES[look.pattern],
        linewidth=0.5,
        ecolor="black",
        error_kw={"lw": 0.6, "capsize": 1.2 if len(names) * of < 40 else 0, "capthick": 0.6},
    )


def _ranges(axes: Axes, curve: Curve, names: Sequence[str]) -> Any:
    x, y = _places(curve, names), y_of(curve)
    looks = ((FILL, 9 * PRINT, 0.0), (NEUTRAL, PRINT, 2.25 * PRINT))
    area, _ = (
        axes.errorbar(x, y, yerr=np.asarray(curve.y_error), fmt="none", zorder=1.5, ecolor=colour,
                      elinewidth=wide, capsize=cap)
        for colour, wide, cap in looks
    )  # fmt: skip
    return area


def _places(curve: Curve, names: Sequence[str]) -> Any:
    """Return the (N,) positions along x: numbers, indices of names, or dates."""
    if not has_names(curve):
        return x_of(curve)
    if not names:
        return np.array([str(x) for x in curve.x], dtype="datetime64[s]")
    return np.array([names.index(str(x)) for x in curve.x], dtype=np.float64)


def _square(axes: Axes, ends: FloatArray) -> None:
    """Set equal ranges of the x axis and the y axis, so that the line y = x is the diagonal."""
    apart = 0.05 * float(ends[1] - ends[0])
    axes.set_xlim(ends[0] - apart, ends[1] + apart)
    axes.set_ylim(ends[0] - apart, ends[1] + apart)
    axes.set_box_aspect(1)


def _grid(axes: Axes, grid: Grid) -> None:
    """Draw the counts of a grid as filled cells in vector graphics."""
    from matplotlib.colors import LinearSegmentedColormap

    z: FloatArray = np.ma.masked_invalid(grid.log_count)
    scale = LinearSegmentedColormap.from_list("counts", [SELDOM, OFTEN])
    mesh = axes.pcolormesh(grid.x, grid.y, z, cmap=scale, shading="nearest")
    most = float(np.nanmax(grid.log_count, initial=0.0))
    ticks = [math.log10(n) for k in range(8) for n in (10**k, 3 * 10**k)]
    ticks = [tick for tick in ticks if tick <= most + 1e-9]
    assert axes.figure is not None
    bar = axes.figure.colorbar(mesh, ax=axes, ticks=ticks, fraction=0.06, pad=0.02)
    bar.ax.set_yticklabels([f"{10**tick:.0f}" for tick in ticks])
    bar.set_label("samples [1]")
    if bar.solids is not None:
        bar.solids.set_rasterized(False)  # matplotlib would convert it to an image


def _mark(axes: Axes, mark: Mark) -> dict[str, Any]:
    at: Any = np.datetime64(mark.x, "s") if isinstance(mark.x, str) else mark.x
    drawn = axes.axvline(at, ls=LINES["dot"], color=NEUTRAL, lw=1.5 * PRINT)
    if mark.text:
        place = axes.get_xaxis_transform()
        axes.text(at, 1, f" {mark.text}", transform=place, va="top", ha="left", **_BOXED)
    return {mark.name: drawn} if mark.name else {}


def _span(axes: Axes, span: Span) -> None:
    colour = {1: UP, -1: DOWN}.get(span.approach, NEUTRAL)
    axes.axvspan(span.begin, span.end, color=colour, alpha=0.22 if span.approach else 0.1, lw=0)
    sign = {1: "▲", -1: "▼"}.get(span.approach, "")
    if sign:
        middle, place = (span.begin + span.end) / 2, axes.get_xaxis_transform()
        axes.text(middle, 1.01, sign, transform=place, ha="center", va="bottom", fontsize=4,
                  color=colour)  # fmt: skip


def _scales(axes: Axes, panel: Panel) -> None:
    """Set the scales, limits and ticks of the x axis and the y axis."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.ticker import MaxNLocator

    x, y = panel.x_axis, panel.y_axis
    if y.scale == "log":
        axes.set_yscale("log")
    if y.limits:
        axes.set_ylim(*y.limits)
    elif y.from_zero:
        axes.set_ylim(bottom=0)
    if y.scale == "log":
        _powers(axes)
    if x.limits:
        axes.set_xlim(*x.limits)
    if x.whole:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if x.scale == "date":
        locator = AutoDateLocator(minticks=2, maxticks=5)  # type: ignore[no-untyped-call]
        form = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(form)
    if panel.square:
        axes.set_aspect("equal")


def _powers(axes: Axes) -> None:
    """Label a logarithmic axis with Unicode powers of ten; add 2 and 5 if the range is small."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axes.get_ylim()
    subs = (1.0, 2.0, 5.0) if high / low < 300 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(subs=subs, numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _power(value: float) -> str:
    if 1e-4 < value < 1e5:
        return f"{value:g}"
    return "10" + str(round(math.log10(value))).translate(
        str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    )
