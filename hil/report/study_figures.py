"""The figures of studies as plots of the page: panels side by side under one legend."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from hil.report import plotly_figures
from hil.report.blocks import Panel as Plot
from hil.report.blocks import Plots
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
from hil.report.traces import Trace, axes, corner, line, markers
from hil.report.words import number
from hil.studies import Curve, Figure, Panel

GLYPHS = {
    "circle": "●",
    "square-open": "□",
    "diamond": "◆",
    "triangle-up-open": "△",
    "triangle-down": "▼",
    "diamond-open": "◇",
    "cross": "✚",
}
BAND_FROM = 30
"""Error bars of a line with more points than this would be a smear: they become its edges."""


def plots_of(figure: Figure, points: int, models: Sequence[str] = ()) -> Plots:
    """A figure as a block of the page.

    Args:
        figure: Of a study.
        points: At most so many points are kept of each series.
        models: See `looks_of`.
    """
    looks = looks_of(figure, models)
    wide = figure.per_row == 1 or len(figure.panels) == 1
    panels = tuple(
        Plot(panel.title, _plotly(panel, looks, points), _said(figure, panel), wide)
        for panel in figure.panels
    )
    columns = figure.per_row if figure.per_row == 2 else 0
    return Plots(figure.title, figure.caption, panels, _legend(figure, looks), columns=columns)


def _plotly(panel: Panel, looks: Mapping[str, Look], points: int) -> plotly_figures.Figure:
    traces = [
        trace
        for curve in panel.curves
        for trace in _traces(panel, fewer(curve, points), looks.get(curve.name, IDENTITY))
    ]
    bars = any(curve.style == "bars" for curve in panel.curves)
    layout = axes(panel.x_title, panel.y_title, barmode="group", showlegend=bars)
    if names := categories(panel):
        shown = [escape(name) for name in names]
        layout["xaxis"] |= {"type": "category", "tickmode": "array", "tickvals": shown}
        layout["xaxis"] |= {"categoryorder": "array", "categoryarray": shown}
    if panel.corner:
        layout["annotations"] = corner(panel.corner)
    return {"data": traces, "layout": layout}


def _traces(panel: Panel, curve: Curve, look: Look) -> list[Trace]:
    if curve.style == "identity":
        ends = diagonal(panel)
        return [_quiet(line(ends, ends, curve.name, look.colour, dash=look.dash, width=1.4))]
    if curve.style == "bars":
        return [_bar(curve, look)]
    x, y = x_of(curve), y_of(curve)
    if curve.style == "points":
        size = 3.0 if len(y) > 300 else 4.0 if len(y) > 100 else 6.0 if len(y) > 30 else 9.0
        trace = markers(x, y, curve.name, look.colour, symbol=look.symbol, size=size)
    else:
        trace = line(x, y, curve.name, look.colour, dash=look.dash, width=1.5)
    if has_names(curve):
        trace["x"] = [escape(str(name)) for name in curve.x]
    edges = _edges(curve, look) if curve.y_error and _is_long(curve) else []
    if curve.y_error and not edges:
        trace["error_y"] = _error(curve, look.colour)
    return [*edges, _quiet(trace)]


def _is_long(curve: Curve) -> bool:
    return curve.style == "line" and len(curve.y) > BAND_FROM and not has_names(curve)


def _edges(curve: Curve, look: Look) -> list[Trace]:
    x, y, error = x_of(curve), y_of(curve), np.array(curve.y_error, dtype=np.float64)
    both = ((y + error, f"{curve.name} + error"), (y - error, f"{curve.name} − error"))
    return [_quiet(line(x, edge, name, look.colour, dash="dot", width=1.0)) for edge, name in both]


def _bar(curve: Curve, look: Look) -> Trace:
    trace: Trace = {
        "type": "bar",
        "name": escape(curve.name),
        "x": [escape(str(name)) for name in curve.x] if has_names(curve) else x_of(curve),
        "y": y_of(curve),
        "marker": {"color": look.colour, "pattern": {"shape": look.pattern}},
    }
    return trace | ({"error_y": _error(curve, IDENTITY.colour)} if curve.y_error else {})


def _error(curve: Curve, colour: str) -> Trace:
    error = np.array(curve.y_error, dtype=np.float64)
    return {"type": "data", "array": error, "color": colour, "thickness": 1.4, "width": 3}


def _quiet(trace: Trace) -> Trace:
    """Left out of the plot's own legend: the one above all panels has it."""
    return trace | {"showlegend": False}


def _legend(figure: Figure, looks: Mapping[str, Look]) -> tuple[tuple[str, str, str], ...]:
    """One entry per name of lines and marks; bars have a legend of their own, with patterns."""
    out: dict[str, tuple[str, str, str]] = {}
    for curve in (curve for panel in figure.panels for curve in panel.curves):
        look = looks.get(curve.name, IDENTITY)
        if curve.style == "bars" or not curve.name:
            continue
        sign = GLYPHS[look.symbol] if curve.style == "points" else look.dash
        if curve.style == "identity":
            look = IDENTITY
            sign = look.dash
        out.setdefault(curve.name, (curve.name, look.colour, sign))
    return tuple(out.values())


def _said(figure: Figure, panel: Panel) -> str:
    """What a panel shows, for those who do not see it: every series with its range."""
    told = [f"{figure.title}, {panel.title}", *([panel.corner] if panel.corner else [])]
    for curve in panel.curves:
        y = y_of(curve)
        y = y[np.isfinite(y)]
        if len(y):
            told.append(f"{curve.name}: {number(float(y.min()))} to {number(float(y.max()))}")
    return "; ".join(told)
