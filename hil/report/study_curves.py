"""What page and paper share in drawing a study: looks by name, fewer points, identity lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.core import FloatArray, IntArray
from hil.report import colours
from hil.report.decimate import extremes, thinned
from hil.report.traces import span
from hil.studies import Curve, Figure, Panel

PALETTE = (
    colours.MEASURED,
    colours.PREDICTED,
    colours.RESIDUAL,
    colours.DOWN,
    colours.LIMIT,
    colours.JOINTS[5],
    colours.NEUTRAL,
)
SYMBOLS = (
    "circle",
    "square-open",
    "diamond",
    "triangle-up-open",
    "triangle-down",
    "diamond-open",
    "cross",
)
"""Full and open in turn: in a dense cloud shapes alone tell nothing."""
PATTERNS = ("", "/", "x", ".", "\\", "+", "-")


@dataclass(frozen=True, slots=True)
class Look:
    """How a series is drawn; each part alone tells neighbours apart.

    Attributes:
        colour: Of the report's palette.
        dash: Of a line, in plotly's words.
        symbol: Of points, in plotly's words.
        pattern: Of bars, in plotly's words.
    """

    colour: str
    dash: str
    symbol: str
    pattern: str


IDENTITY = Look(colours.NEUTRAL, "dash", "circle", "")


def look(i: int, line: int = 0) -> Look:
    """Of the series `i` of a figure, which is its line number `line`, counted from 0."""
    return Look(
        PALETTE[i % len(PALETTE)],
        colours.DASHES[line % len(colours.DASHES)],
        SYMBOLS[i % len(SYMBOLS)],
        PATTERNS[i % len(PATTERNS)],
    )


def looks_of(figure: Figure, models: Sequence[str] = ()) -> dict[str, Look]:
    """A look for every name in a figure, the same in all of its panels.

    Curves that are not told apart by their name share a look; a line that is alone among lines is
    solid, whatever else there is.

    Args:
        figure: Of a study.
        models: Models that look as in the other plots of the page, in their order there; nothing
            else looks like one of them.
    """
    looks: dict[str, Look] = {name: look(i, i) for i, name in enumerate(models)}
    lines = 0
    for curve in _curves(figure):
        if curve.name in looks or curve.style == "identity":
            continue
        looks[curve.name] = look(len(looks), lines)
        lines += curve.style == "line"
    return looks


def named_in(figures: Sequence[Figure], models: Sequence[str]) -> bool:
    """Whether series or panels bear the name of a model."""
    panels = [panel for figure in figures for panel in figure.panels]
    names = {panel.title for panel in panels} | {c.name for panel in panels for c in panel.curves}
    return not names.isdisjoint(models)


def has_names(curve: Curve) -> bool:
    """Whether its x are names and not numbers."""
    return any(isinstance(x, str) for x in curve.x)


def y_of(curve: Curve) -> FloatArray:
    """(N,) its values."""
    return np.array(curve.y, dtype=np.float64)


def x_of(curve: Curve) -> FloatArray:
    """(N,) its places; of names, their numbers from 0."""
    if has_names(curve):
        return np.arange(len(curve.x), dtype=np.float64)
    return np.array(curve.x, dtype=np.float64)


def fewer(curve: Curve, points: int) -> Curve:
    """The same picture with at most `points` points: a line keeps its extremes."""
    if has_names(curve) or len(curve.y) <= points:
        return curve
    rows: IntArray = thinned(len(curve.y), points)
    if curve.style == "line":
        rows = extremes(y_of(curve), max(4, points))
    x, y = (tuple(values[row] for row in rows.tolist()) for values in (curve.x, curve.y))
    error = tuple(curve.y_error[row] for row in rows.tolist()) if curve.y_error else ()
    return replace(curve, x=x, y=y, y_error=error)


def categories(panel: Panel) -> list[str]:
    """The names along x in the order in which they first occur; empty for numbers."""
    named = [curve for curve in panel.curves if has_names(curve)]
    return list(dict.fromkeys(str(x) for curve in named for x in curve.x))


def diagonal(panel: Panel) -> FloatArray:
    """(2,) from where to where the line y = x is drawn: over everything else in the panel."""
    others = [curve for curve in panel.curves if curve.style != "identity" and curve.y]
    parts = [values for curve in others for values in (x_of(curve), y_of(curve))]
    return np.array(span(np.concatenate(parts) if parts else np.empty(0)))


def curve_count(figures: Sequence[Figure]) -> int:
    """How many series there are."""
    return sum(1 for figure in figures for _ in _curves(figure))


def _curves(figure: Figure) -> Iterator[Curve]:
    return (curve for panel in figure.panels for curve in panel.curves)
