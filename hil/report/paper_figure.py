"""A study's figure drawn for print: as wide as a column, told apart without colour as well."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import FloatArray
from hil.report.paper_style import (
    HATCHES,
    LEAST_PANEL,
    LETTER,
    LINES,
    MARKS,
    METADATA,
    MM,
    STYLE,
    WIDTHS,
)
from hil.report.study_curves import (
    IDENTITY,
    Look,
    categories,
    diagonal,
    fewer,
    has_names,
    looks_of,
    x_of,
    y_of,
)
from hil.studies import Curve, Figure, Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Sheet


POINTS = 1000
"""Points of a line or cloud: more than 88 mm of print show."""

BAND_FROM = 30
"""Error bars of a line with more points than this would be a smear: they become a band."""


def drawn(figure: Figure, format_: str, width: str = "column") -> bytes:
    """The figure as a file.

    Args:
        figure: What to draw.
        format_: `pdf`, `svg` or `png`.
        width: `column` or `page`.

    Returns:
        The bytes of the file; equal figures give equal bytes.
    """
    columns = _columns(figure, WIDTHS[width])
    rows = math.ceil(len(figure.panels) / columns) or 1
    height = rows * _height(figure, WIDTHS[width] / columns) + 7
    return on_sheet(
        lambda sheet: _draw(sheet, figure, rows, columns), WIDTHS[width], height, format_
    )


def on_sheet(draw: Callable[[Sheet], None], width: float, height: float, format_: str) -> bytes:
    """The file of a sheet of `width` × `height` mm that `draw` has drawn on."""
    import matplotlib as mpl
    from matplotlib.figure import Figure as Sheet
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    out = io.BytesIO()
    with mpl.rc_context(STYLE):
        apart = ConstrainedLayoutEngine(w_pad=1.5 * MM, h_pad=1 * MM, wspace=0.02, hspace=0.02)
        sheet = Sheet(figsize=(width * MM, height * MM), layout=apart)
        draw(sheet)
        sheet.savefig(out, format=format_, metadata=METADATA[format_])
    return out.getvalue()


def _columns(figure: Figure, width: float) -> int:
    """Panels side by side: as asked for, but none too narrow to be read."""
    return max(1, min(figure.per_row, len(figure.panels), int(width // LEAST_PANEL)))


def _height(figure: Figure, width: float) -> float:
    """Of one panel [mm]; regression plots are square, long names below bars need room."""
    square = any(c.style == "identity" for panel in figure.panels for c in panel.curves)
    names = max((len(name) for panel in figure.panels for name in categories(panel)), default=0)
    tall = width * 0.95 if square else min(width * 0.78, 50.0)
    return tall + (min(names, 24) * 0.8 if _slanted(figure, width) else 0.0)


def _slanted(figure: Figure, width: float) -> bool:
    """Whether names along x would run into each other."""
    named = [categories(panel) for panel in figure.panels]
    return max((sum(len(name) + 1 for name in names) for names in named), default=0) > width / 1.6


def _draw(sheet: Sheet, figure: Figure, rows: int, columns: int) -> None:
    looks, shown = looks_of(figure), dict[str, Any]()
    width = sheet.get_figwidth() / MM
    slanted = _slanted(figure, width / columns)
    places = [sheet.add_subplot(rows, columns, i + 1) for i in range(len(figure.panels))]
    for axes, panel in zip(places, figure.panels, strict=True):
        shown |= _panel(axes, panel, looks, slanted)
        if len(places) > 1:
            axes.set_title(folded(panel.title, width / columns))
    titles(sheet, places, figure.panels, columns)
    if len(shown) > 1:
        legend(sheet, shown, width)


def titles(sheet: Sheet, places: Sequence[Axes], panels: Sequence[Panel], columns: int) -> None:
    """Axis titles; one that all panels share stands once, below or beside all of them."""
    width = sheet.get_figwidth() / MM
    x, y = ({getattr(panel, name) for panel in panels} for name in ("x_title", "y_title"))
    if len(x) == 1 and len(places) > 1:
        sheet.supxlabel(folded(min(x), width), fontsize=STYLE["axes.labelsize"])
    if len(y) == 1 and len(places) > columns:
        sheet.supylabel(folded(min(y), 60), fontsize=STYLE["axes.labelsize"])
    for i, (axes, panel) in enumerate(zip(places, panels, strict=True)):
        if len(x) > 1 or len(places) == 1:
            axes.set_xlabel(folded(panel.x_title, width / columns))
        if len(y) > 1 or (len(places) <= columns and i == 0):
            axes.set_ylabel(folded(panel.y_title, 40))


def folded(text: str, room: float) -> str:
    """A title in as many lines as it takes in `room` mm."""
    return "\n".join(wrap(text, max(12, int(room / LETTER)))) if text else ""


def legend(sheet: Sheet, shown: Mapping[str, Any], width: float) -> None:
    """Above all panels: in one row if it fits, else in columns as wide as the longest name."""
    from matplotlib.lines import Line2D

    rooms = [10 + LETTER * len(name) for name in shown]
    across = len(rooms) if sum(rooms) < width else max(1, int(width / max(rooms)))
    drawn = sheet.legend(
        list(shown.values()), list(shown), loc="outside upper center", ncols=across
    )
    for handle in drawn.legend_handles:
        if isinstance(handle, Line2D):  # a mark of a dense cloud is too small to be told
            handle.set_markersize(3.5)
            handle.set_alpha(1)


def _panel(axes: Axes, panel: Panel, looks: Mapping[str, Look], slanted: bool) -> dict[str, Any]:
    """Draw a panel; returns what of it belongs into the legend, by name."""
    names = categories(panel)
    bars = [curve for curve in panel.curves if curve.style == "bars"]
    shown: dict[str, Any] = {}
    for curve in panel.curves:
        if curve.style == "identity":
            ends = diagonal(panel)
            (artist,) = axes.plot(
                ends, ends, color=IDENTITY.colour, ls=LINES[IDENTITY.dash], lw=0.7, zorder=3
            )
            _square(axes, ends)
        elif curve.style == "bars":
            artist = _bars(axes, curve, looks[curve.name], names, (bars.index(curve), len(bars)))
        else:
            artist = _series(axes, fewer(curve, POINTS), looks[curve.name], names)
        if curve.name:
            shown.setdefault(curve.name, artist)
    if names:
        axes.set_xticks(range(len(names)), names, **_turned(slanted))
        axes.grid(visible=False, axis="x")
    if panel.corner:
        _corner(axes, panel.corner)
    return shown


def _bars(axes: Axes, curve: Curve, look: Look, names: list[str], place: tuple[int, int]) -> Any:
    number, of = place
    wide = 0.8 / of
    x = _places(curve, names) + (number - (of - 1) / 2) * wide
    error = {"lw": 0.6, "capsize": 1.2 if len(names) * of < 40 else 0, "capthick": 0.6}
    return axes.bar(
        x,
        y_of(curve),
        wide,
        yerr=np.array(curve.y_error) if curve.y_error else None,
        facecolor=look.colour if not look.pattern else "white",
        edgecolor=look.colour,
        hatch=HATCHES[look.pattern],
        linewidth=0.5,
        ecolor="black",
        error_kw=error,
    )


def _series(axes: Axes, curve: Curve, look: Look, names: list[str]) -> Any:
    x, y = _places(curve, names), y_of(curve)
    error = np.array(curve.y_error, dtype=np.float64) if curve.y_error else None
    if curve.style == "line":
        if error is not None and len(y) > BAND_FROM:
            axes.fill_between(x, y - error, y + error, color=look.colour, alpha=0.2, lw=0)
            error = None
        few = len(y) <= BAND_FROM
        mark = MARKS[look.symbol.removesuffix("-open")] if few else ""
        (artist,) = axes.plot(x, y, color=look.colour, ls=LINES[look.dash], marker=mark, ms=2.5)
    else:
        artist = _marks(axes, x, y, look)
    if error is not None:
        axes.errorbar(x, y, yerr=error, fmt="none", ecolor=look.colour, lw=0.6, capsize=1.2)
    return artist


def _marks(axes: Axes, x: FloatArray, y: FloatArray, look: Look) -> Any:
    """Few marks are drawn large, many small; every second kind is an outline."""
    size = 3.5 if len(y) <= 60 else 1.8 if len(y) <= 400 else 1.3
    is_open = look.symbol.endswith("-open")
    (artist,) = axes.plot(
        x,
        y,
        color=look.colour,
        ls="",
        marker=MARKS[look.symbol.removesuffix("-open")],
        ms=size * (1.3 if is_open else 1.0),
        mew=(0.25 if len(y) > 60 else 0.7) if is_open else 0,
        mfc="none" if is_open else look.colour,
        alpha=0.8,
        zorder=4 if len(y) <= 60 else 2,
    )
    return artist


def _square(axes: Axes, ends: FloatArray) -> None:
    """The same range along both axes, so that the line y = x is the diagonal."""
    apart = 0.05 * float(ends[1] - ends[0])
    axes.set_xlim(ends[0] - apart, ends[1] + apart)
    axes.set_ylim(ends[0] - apart, ends[1] + apart)
    axes.set_box_aspect(1)


def _places(curve: Curve, names: list[str]) -> FloatArray:
    """(N,) where its values stand along x."""
    if not has_names(curve):
        return x_of(curve)
    return np.array([names.index(str(name)) for name in curve.x], dtype=np.float64)


def _turned(slanted: bool) -> dict[str, Any]:
    return {"rotation": 50, "ha": "right", "rotation_mode": "anchor"} if slanted else {}


def _corner(axes: Axes, text: str) -> None:
    box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1}
    axes.text(0.04, 0.96, text, transform=axes.transAxes, va="top", bbox=box, zorder=5)
