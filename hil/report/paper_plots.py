"""Plots of a page drawn for print: what plotly is told, told to matplotlib, in the same looks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import unescape
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import FloatArray
from hil.report.page_figures import PagePanel
from hil.report.paper_figure import folded, legend, on_sheet, titles
from hil.report.paper_style import HATCHES, LEAST_PANEL, LINES, MARKS, MM, WIDTHS
from hil.studies import Panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Sheet

MOST_PER_ROW = 3
PRINT = 0.55
"""Points of print for a pixel of the screen."""


def drawn_plots(panels: Sequence[PagePanel], format_: str, width: str = "column") -> bytes:
    """Plots side by side as a file.

    Args:
        panels: What to draw.
        format_: `pdf`, `svg` or `png`.
        width: `column` or `page`.

    Returns:
        The bytes of the file; equal plots give equal bytes.
    """
    whole = WIDTHS[width]
    most = 1 if any(panel.wide for panel in panels) else MOST_PER_ROW
    columns = max(1, min(most, len(panels), int(whole // LEAST_PANEL)))
    rows = math.ceil(len(panels) / columns)
    height = rows * min(0.78 * whole / columns, 50.0) + 8
    return on_sheet(lambda sheet: _draw(sheet, panels, rows, columns), whole, height, format_)


def _draw(sheet: Sheet, panels: Sequence[PagePanel], rows: int, columns: int) -> None:
    width, shown = sheet.get_figwidth() / MM, dict[str, Any]()
    places = [sheet.add_subplot(rows, columns, i + 1) for i in range(len(panels))]
    for axes, panel in zip(places, panels, strict=True):
        shown |= _panel(axes, panel.figure)
        if len(places) > 1:
            axes.set_title(folded(panel.title, width / columns))
    titled = [Panel(each.title, each.x_title, each.y_title, ()) for each in panels]
    titles(sheet, places, titled, columns)
    if len(shown) > 1:
        legend(sheet, shown, width)


def _panel(axes: Axes, figure: Mapping[str, Any]) -> dict[str, Any]:
    """Draw one panel; returns what belongs into the legend, by name."""
    layout, shown = figure["layout"], dict[str, Any]()
    bars = [trace for trace in figure["data"] if trace["type"] == "bar"]
    names = list(dict.fromkeys(str(x) for trace in bars for x in trace["x"]))
    for trace in figure["data"]:
        if trace["type"] == "heatmap":
            _grid(axes, trace)
            continue
        if trace["type"] == "bar":
            number = next(i for i, each in enumerate(bars) if each is trace)
            artist = _bar(axes, trace, names, number, len(bars))
        else:
            artist = _scatter(axes, trace, names)
        if name := unescape(str(trace.get("name") or "")):
            shown.setdefault(name, artist)
    for shape in layout.get("shapes") or ():
        _shape(axes, shape)
    for text in layout.get("annotations") or ():
        _text(axes, text)
    _scales(axes, layout)
    if names:
        axes.set_xticks(range(len(names)), [unescape(name) for name in names])
        axes.grid(visible=False, axis="x")
    return shown


def _scatter(axes: Axes, trace: Mapping[str, Any], names: Sequence[str]) -> Any:
    line, mark, mode = trace.get("line") or {}, trace.get("marker") or {}, trace["mode"]
    symbol = str(mark.get("symbol") or "circle")
    colour = mark.get("color") or line.get("color")
    lined, is_open = "lines" in mode, symbol.endswith("-open")
    x, y = _along(trace["x"], names), np.asarray(trace["y"], dtype=np.float64)
    (artist,) = axes.plot(
        x,
        y,
        color=line.get("color") or colour,
        ls=LINES[line.get("dash") or "solid"] if lined else "",
        lw=PRINT * float(line.get("width") or 1.6),
        marker=MARKS[symbol.removesuffix("-open")] if "markers" in mode else "",
        ms=PRINT * float(mark.get("size") or 4),
        mfc="none" if is_open else colour,
        mec=colour,
        mew=_edge(symbol),
        alpha=mark.get("opacity") if not lined else None,
        zorder=2.5 if lined else 2,
    )
    if error := trace.get("error_y"):
        axes.errorbar(
            x, y, yerr=np.asarray(error["array"], dtype=np.float64), fmt="none", zorder=1.5,
            ecolor=error["color"], elinewidth=PRINT * error["thickness"],
            capsize=0.5 * PRINT * error["width"],
        )  # fmt: skip
    return artist


def _edge(symbol: str) -> float:
    """Width of a marker's outline [pt]; marks that are nothing else need one."""
    return 1.5 if symbol == "line-ew-open" else 0.7 if symbol.endswith(("-open", "x")) else 0.0


def _along(x: Any, names: Sequence[str]) -> Any:
    """Places along x: numbers as they are, dates as dates, names by their number."""
    values = list(x)
    if not values or not isinstance(values[0], str):
        return np.asarray(values, dtype=np.float64)
    if names:
        return np.array([names.index(value) for value in values], dtype=np.float64)
    return np.array(values, dtype="datetime64[s]")


def _bar(axes: Axes, trace: Mapping[str, Any], names: Sequence[str], number: int, of: int) -> Any:
    wide = 0.8 / of
    look = trace["marker"]
    pattern = str((look.get("pattern") or {}).get("shape") or "")
    error = (trace.get("error_y") or {}).get("array")
    return axes.bar(
        _along(trace["x"], names) + (number - (of - 1) / 2) * wide,
        np.asarray(trace["y"], dtype=np.float64),
        wide,
        yerr=None if error is None else np.asarray(error, dtype=np.float64),
        facecolor="white" if pattern else look["color"],
        edgecolor=look["color"],
        hatch=HATCHES[pattern],
        linewidth=0.5,
        error_kw={"lw": 0.6, "capsize": 1.2, "capthick": 0.6},
    )


def _grid(axes: Axes, trace: Mapping[str, Any]) -> None:
    """Counts as filled cells; every cell is a vector, none a pixel."""
    from matplotlib.colors import LinearSegmentedColormap

    z: FloatArray = np.ma.masked_invalid(np.asarray(trace["z"], dtype=np.float64))
    scale = LinearSegmentedColormap.from_list("counts", [c for _, c in trace["colorscale"]])
    mesh = axes.pcolormesh(trace["x"], trace["y"], z, cmap=scale, shading="nearest")
    told = trace.get("colorbar")
    if not told:
        return  # pages of before have none: their counts are told by nothing but the caption
    assert axes.figure is not None
    bar = axes.figure.colorbar(mesh, ax=axes, ticks=told["tickvals"], fraction=0.06, pad=0.02)
    bar.ax.set_yticklabels(told["ticktext"])
    bar.set_label(told["title"]["text"])
    if bar.solids is not None:
        bar.solids.set_rasterized(False)  # matplotlib would make it an image


def _shape(axes: Axes, shape: Mapping[str, Any]) -> None:
    line = shape.get("line") or {}
    look: dict[str, Any] = {"color": line.get("color"), "lw": PRINT * float(line.get("width") or 1)}
    if shape["type"] == "rect":
        axes.axhspan(
            shape["y0"], shape["y1"], color=shape["fillcolor"], alpha=shape["opacity"], lw=0
        )
    elif shape.get("yref") == "paper":
        (at,) = _along([shape["x0"]], ())
        axes.axvline(at, ls=LINES[line.get("dash") or "solid"], **look)
    else:
        axes.axhline(shape["y0"], ls=LINES[line.get("dash") or "solid"], **look)


def _text(axes: Axes, told: Mapping[str, Any]) -> None:
    """In a corner of the panel, or at the upper end of a line."""
    box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1}
    at: dict[str, Any] = {"va": "top", "ha": "left", "bbox": box, "zorder": 5}
    if told.get("xref") == "paper":
        axes.text(told["x"], told["y"], unescape(told["text"]), transform=axes.transAxes, **at)
    else:
        (x,) = _along([told["x"]], ())
        axes.text(
            x, told["y"], " " + unescape(told["text"]), transform=axes.get_xaxis_transform(), **at
        )


def _scales(axes: Axes, layout: Mapping[str, Any]) -> None:
    """Logarithms, ranges, zero, dates."""
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.ticker import MaxNLocator

    y = layout["yaxis"]
    if y.get("type") == "log":
        axes.set_yscale("log")
    if y.get("range"):
        axes.set_ylim(*(10.0**v if y.get("type") == "log" else v for v in y["range"]))
    elif y.get("rangemode") == "tozero":
        axes.set_ylim(bottom=0)
    if y.get("type") == "log":
        _powers(axes)
    if layout["xaxis"].get("dtick") == 1:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if layout["xaxis"].get("type") == "date":
        locator = AutoDateLocator(minticks=2, maxticks=5)  # type: ignore[no-untyped-call]
        form = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        axes.xaxis.set_major_formatter(form)


def _powers(axes: Axes) -> None:
    """Numbers beside a logarithmic axis, in Unicode; 2 and 5 as well where it has few powers."""
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
