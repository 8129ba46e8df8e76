"""The parts figures are made of: axes, lines, markers, bands; one look for all."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any, TypeAlias

import numpy as np

from hil.core import FloatArray
from hil.report import colours

Trace: TypeAlias = dict[str, Any]


def axes(x: str, y: str, **layout: Any) -> dict[str, Any]:
    """A layout with titled axes; titles carry the unit in brackets."""
    return {
        "xaxis": {"title": {"text": escape(x)}},
        "yaxis": {"title": {"text": escape(y)}},
        "showlegend": False,
        **layout,
    }


def line(
    x: FloatArray, y: FloatArray, name: str, colour: str, *, dash: str = "solid", width: float = 1.6
) -> Trace:
    """A line through (N,) points; NaN breaks it."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": escape(name),
        "x": x,
        "y": y,
        "line": {"color": colour, "dash": dash, "width": width},
    }


def markers(
    x: FloatArray,
    y: FloatArray,
    name: str,
    colour: str,
    *,
    symbol: str = "circle",
    size: float = 4,
    opacity: float = 0.7,
    text: Sequence[str] = (),
) -> Trace:
    """Marks at (N,) points; `text` is shown on hovering."""
    trace: Trace = {
        "type": "scatter",
        "mode": "markers",
        "name": escape(name),
        "x": x,
        "y": y,
        "marker": {"color": colour, "symbol": symbol, "size": size, "opacity": opacity},
    }
    return trace | ({"text": [escape(item) for item in text]} if text else {})


def band(half: float) -> list[dict[str, Any]]:
    """A band of ± `half` behind the data, with its edges; nothing when that is not known."""
    if not np.isfinite(half):
        return []
    across = {"xref": "paper", "x0": 0, "x1": 1, "layer": "below"}
    edge = {"type": "line", "line": {"color": colours.LIMIT, "width": 1}} | across
    area = {"type": "rect", "y0": -half, "y1": half, "line": {"width": 0}} | across
    area |= {"fillcolor": colours.LIMIT, "opacity": 0.25}
    return [area, *(edge | {"y0": y, "y1": y} for y in (-half, half))]


def attempts(times: FloatArray) -> dict[str, Any]:
    """Parts of a layout that mark where the attempts after the first begin; empty without any.

    Args:
        times: (A,) beginnings of the second attempt and those after it, on the x axis.
    """
    if not len(times):
        return {}
    dots = {"color": colours.NEUTRAL, "width": 1.5, "dash": "dot"}
    mark = {"type": "line", "yref": "paper", "y0": 0, "y1": 1, "line": dots}
    words = {"yref": "paper", "y": 1, "yanchor": "top", "xanchor": "left", "showarrow": False}
    at = [float(t) for t in times]
    return {
        "shapes": [{"x0": t, "x1": t} | mark for t in at],
        "annotations": [{"x": t, "text": f"attempt {i}"} | words for i, t in enumerate(at, 2)],
    }


def corner(text: str) -> list[dict[str, Any]]:
    """A short text in the upper left corner."""
    place = {"xref": "paper", "yref": "paper", "x": 0.03, "y": 0.97}
    look = {"xanchor": "left", "yanchor": "top", "showarrow": False}
    return [{"text": escape(text)} | place | look]


def span(values: FloatArray) -> tuple[float, float]:
    """Smallest and largest finite value, never equal."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)
