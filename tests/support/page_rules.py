"""What every page keeps to: units, plots said in words, the palette, shapes beside colours."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import unescape
from itertools import combinations
from typing import Any

from hil.report import colours
from hil.report.curves import dressed, legend
from hil.report.page import Page
from hil.report.plotly_figure import figure_json, plotly_of
from hil.studies.figure import Figure, Panel

UNITS = {
    "1", "%", "A", "N·m", "kg", "kg·m", "mm", "rad", "rad/s", "°", "°/s", "°/s²", "°/s³", "mrad",
    "s", "ms", "°C", "years", "UTC",
}  # fmt: skip
NAMED = {"joint", "parameter", "load"}
"""Axes along which names stand."""
COUNTED = {
    "dwell, in the order of the prediction", "held-out dwell, in order of time",
    "test sample, in order of time", "epoch",
}  # fmt: skip
"""Axes along which things are counted, and which say what."""
ROOM = 28
"""Letters that fit beside a panel of the height it is printed in."""


def faults(page: Page) -> list[str]:
    """Everything on the page that breaks a rule."""
    return [
        f"{section.title}: {block.title}: {fault}"
        for section in page.sections
        for block in map(dressed, (b for b in section.blocks if isinstance(b, Figure)))
        for fault in (*_of_legend(block), *(f for panel in block.panels for f in _of(panel)))
    ] + [
        f"{section.title}: a table has no caption"
        for section in page.sections
        for block in section.blocks
        if block.kind == "table" and not block.caption
    ]


def panels(page: Page) -> list[Panel]:
    """All plots of the page."""
    blocks = [block for section in page.sections for block in section.blocks]
    figures = (dressed(block) for block in blocks if isinstance(block, Figure))
    return [panel for figure in figures for panel in figure.panels]


def _of_legend(block: Figure) -> Iterator[str]:
    for text, colour, look in legend(block):
        if colour not in colours.DARK:
            yield f"legend of {text!r} is {colour}, which is not of the palette"
        if look not in (*colours.STROKES, "band") and len(look) != 1:
            yield f"legend of {text!r} has the unknown look {look!r}"


def _of(panel: Panel) -> Iterator[str]:
    figure = plotly_of(panel)
    layout = figure["layout"]
    for axis in ("xaxis", "yaxis"):
        title = unescape(layout[axis]["title"]["text"])
        unit = re.search(r"\[([^\]]+)\]$", title)
        if title not in NAMED | COUNTED and (unit is None or unit[1] not in UNITS):
            yield f"{panel.title}: {axis} {title!r} has no unit"
    y_title = unescape(layout["yaxis"]["title"]["text"])
    if not panel.wide and len(y_title) > ROOM:
        yield f"{panel.title}: {y_title!r} is cut off in print"
    text = figure_json(figure)
    for colour in set(re.findall(r"#[0-9A-Fa-f]{3,8}|rgba?\([^)]*\)", text)) - set(colours.DARK):
        yield f"{panel.title}: {colour} is not of the palette"
    for a, b in combinations(figure["data"], 2):
        if _colour(a) != _colour(b) and _shape(a) == _shape(b) and a.get("name") != b.get("name"):
            yield f"{panel.title}: {a['name']} and {b['name']} differ in colour alone"


def _colour(trace: dict[str, Any]) -> str:
    return str((trace.get("marker") or {}).get("color") or (trace.get("line") or {}).get("color"))


def _shape(trace: dict[str, Any]) -> tuple[Any, ...]:
    """What tells a trace without colour: kind, dash, symbol, pattern, bars, straight."""
    mark, line = trace.get("marker") or {}, trace.get("line") or {}
    return (
        trace["type"], trace.get("mode"), line.get("dash"), mark.get("symbol"),
        str(mark.get("pattern")), (trace.get("error_y") or {}).get("thickness"),
        len(trace["x"]) == 2,
    )  # fmt: skip
