"""What a figure out of a page has to have before it can be drawn; pages may be old, or damaged."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

TRACES = {
    "scatter": ("mode", "x", "y"),
    "bar": ("marker.color", "x", "y"),
    "heatmap": ("colorscale", "x", "y", "z"),
}
"""What a trace of each kind is drawn from, besides what it may have."""

BARS = ("array", "color", "thickness", "width")
"""Error bars of a scatter."""

SHAPES = {"rect": ("y0", "y1", "fillcolor", "opacity"), "line": ("y0",)}
SCALE = ("tickvals", "ticktext", "title.text")
"""A heatmap's scale of counts; those of before November 2026 have none."""


def checked_figure(figure: Any) -> dict[str, Any]:
    """The figure itself.

    Args:
        figure: As it was read, arrays unpacked.

    Raises:
        ValueError: Something is missing or of another shape; says what and where.
    """
    _require(figure, "the figure", ("data", "layout.xaxis.title.text", "layout.yaxis.title.text"))
    for i, trace in enumerate(_list(figure["data"], "data")):
        _trace(trace, f"data.{i}")
    layout = figure["layout"]
    for i, shape in enumerate(_list(layout.get("shapes") or [], "layout.shapes")):
        _shape(shape, f"layout.shapes.{i}")
    for i, text in enumerate(_list(layout.get("annotations") or [], "layout.annotations")):
        _require(text, f"layout.annotations.{i}", ("x", "y", "text"))
    return dict(figure)


def _trace(trace: Any, where: str) -> None:
    _kind(trace, TRACES, where)
    x, y = (len(_row(trace[name], f"{where}.{name}")) for name in ("x", "y"))
    if trace["type"] == "heatmap":
        _grid(trace, where)
        if np.shape(trace["z"]) != (y, x):
            raise ValueError(f"{where}.z is {np.shape(trace['z'])}, but must be {(y, x)}")
        return
    if x != y:
        raise ValueError(f"{where} has {x} values of x and {y} of y")
    if bars := trace.get("error_y"):
        _require(bars, f"{where}.error_y", BARS if trace["type"] == "scatter" else ("array",))


def _grid(trace: Mapping[str, Any], where: str) -> None:
    """What a heatmap's colours mean."""
    colours = _list(trace["colorscale"], f"{where}.colorscale")
    if len(colours) < 2 or not all(isinstance(stop, list) and len(stop) == 2 for stop in colours):
        raise ValueError(f"{where}.colorscale is no list of two or more [place, colour]")
    if scale := trace.get("colorbar"):
        _require(scale, f"{where}.colorbar", SCALE)
        if len(scale["tickvals"]) != len(scale["ticktext"]):
            raise ValueError(f"{where}.colorbar has other numbers of tickvals than of ticktext")


def _shape(shape: Any, where: str) -> None:
    _kind(shape, SHAPES, where)
    if shape.get("yref") == "paper":
        _require(shape, where, ("x0",))


def _kind(part: Any, known: Mapping[str, tuple[str, ...]], where: str) -> None:
    """Whether a part has a type that is known, and what one of that type needs."""
    _require(part, where, ("type",))
    if part["type"] not in known:
        raise ValueError(f"{where}.type is {part['type']!r}, but must be one of {', '.join(known)}")
    _require(part, where, known[part["type"]])


def _require(part: Any, where: str, paths: tuple[str, ...]) -> None:
    for path in paths:
        found = part
        for key in path.split("."):
            if not isinstance(found, Mapping) or found.get(key) is None:
                raise ValueError(f"{where} has no {path}")
            found = found[key]


def _list(part: Any, where: str) -> list[Any]:
    if not isinstance(part, list):
        raise ValueError(f"{where} is no list")
    return part


def _row(part: Any, where: str) -> Any:
    if not isinstance(part, list | np.ndarray) or np.ndim(part) != 1:
        raise ValueError(f"{where} is no list of values")
    return part
