"""Curves on their way to a drawer: looks filled in, and fewer points for the same picture.

`dressed` is what plotly and matplotlib are given: every curve has its look, and no more points than
can be seen. The functions below thin samples when a figure is built, which nobody sees either:
a line keeps its extremes, a cloud its density.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from hil.core import FloatArray, IntArray
from hil.report.colours import GLYPHS, IDENTITY, LIMIT, NEUTRAL, looks_of
from hil.studies import Curve, Figure, Panel

Shown: TypeAlias = Literal["extremes", "mean", "upper"]

Thin: TypeAlias = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

POINTS = 1200
"""Points of a line after decimation: more than a plot of this page has pixels."""


Entry: TypeAlias = tuple[str, str, str]
"""Of a legend: text, colour, and a dash of `colours.STROKES`, `band` or a mark."""


def dressed(figure: Figure, points: int = 0, models: Sequence[str] = ()) -> Figure:
    """Return the figure with a look for every curve, and panels that stand alone wide.

    Args:
        figure: Its curves may have looks of their own, or none.
        points: At most so many are kept of each curve; 0 for all.
        models: See `looks_of`.
    """
    looks = looks_of(figure, models)

    def with_look(curve: Curve) -> Curve:
        own = IDENTITY if curve.style == "identity" else looks.get(curve.name)
        return replace(fewer(curve, points) if points else curve, look=curve.look or own)

    alone = figure.per_row == 1 or (figure.per_row > 0 and len(figure.panels) == 1)
    panels = (
        replace(panel, curves=tuple(map(with_look, panel.curves)), wide=panel.wide or alone)
        for panel in figure.panels
    )
    return replace(figure, panels=tuple(panels))


def legend(figure: Figure) -> list[Entry]:
    """Return the entries of a dressed figure, one per name; none where there is nothing to tell.

    Bars are left out: a drawer shows their patterns in a legend of its own.
    """
    entries: dict[str, Entry] = {}
    for panel in figure.panels:
        for curve in panel.curves:
            if curve.name and curve.look and curve.style not in ("bars", "ticks"):
                colour = NEUTRAL if curve.style == "ranges" else curve.look.colour
                entries.setdefault(curve.name, (curve.name, colour, _sign(curve)))
        if panel.band and np.isfinite(panel.band.half):
            entries.setdefault(panel.band.name, (panel.band.name, LIMIT, "band"))
        for mark in panel.marks:
            if mark.name:
                entries.setdefault(mark.name, (mark.name, NEUTRAL, "dot"))
    return list(entries.values()) if len(entries) > 1 else []


def _sign(curve: Curve) -> str:
    assert curve.look is not None
    if curve.style == "ranges":
        return "band"
    if curve.style in ("points", "marked"):
        dense = curve.style == "points" and curve.look.symbol == "circle" and len(curve.y) > 300
        return "•" if dense else GLYPHS[curve.look.symbol]
    return curve.look.dash


def has_names(curve: Curve) -> bool:
    """Return whether its x are names (or dates) and not numbers."""
    if isinstance(curve.x, np.ndarray) and curve.x.dtype.kind in "fiu":
        return False
    return any(isinstance(x, str) for x in curve.x)


def y_of(curve: Curve) -> FloatArray:
    """(N,) its values."""
    return np.asarray(curve.y, dtype=np.float64)


def x_of(curve: Curve) -> FloatArray:
    """(N,) its places; of names, their numbers from 0."""
    if has_names(curve):
        return np.arange(len(curve.x), dtype=np.float64)
    return np.asarray(curve.x, dtype=np.float64)


def fewer(curve: Curve, points: int) -> Curve:
    """Return the same picture with at most `points` points: a line keeps its extremes."""
    if has_names(curve) or len(curve.y) <= points:
        return curve
    rows = thinned(len(curve.y), points)
    if curve.style == "line":
        rows = extremes(y_of(curve), max(4, points))
    error = np.asarray(curve.y_error)[rows] if len(curve.y_error) else ()
    hover = [curve.hover[row] for row in rows.tolist()] if curve.hover else ()
    return replace(curve, x=x_of(curve)[rows], y=y_of(curve)[rows], y_error=error, hover=hover)


def categories(panel: Panel) -> list[str]:
    """Return the names along x in the order in which they first occur; empty for numbers."""
    if panel.x_axis.scale == "date":
        return []
    named = [curve for curve in panel.curves if has_names(curve)]
    return list(dict.fromkeys(str(x) for curve in named for x in curve.x))


def diagonal(panel: Panel) -> FloatArray:
    """(2,) from where to where the line y = x is drawn: over everything else in the panel."""
    others = [curve for curve in panel.curves if curve.style != "identity" and len(curve.y)]
    parts = [values for curve in others for values in (x_of(curve), y_of(curve))]
    return np.array(span(np.concatenate(parts) if parts else np.empty(0)))


def span(values: FloatArray) -> tuple[float, float]:
    """Smallest and largest finite value, never equal."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def extremes(values: FloatArray, points: int = POINTS) -> IntArray:
    """Rows that keep the picture of a line: the smallest and the largest value per bin.

    Args:
        values: (N,) samples in order; NaN is ignored inside a bin and kept where a bin has
            nothing else, so that gaps stay gaps.
        points: At most this many rows come back, ≥ 4.

    Returns:
        (M,) row numbers in rising order, M ≤ `points`; the first and last row are always there.
    """
    n = len(values)
    if n <= points:
        return np.arange(n)
    bins = (points - 2) // 2
    width = -(-n // bins)
    padded = np.full(bins * width, np.nan)
    padded[:n] = values
    table = padded.reshape(bins, width)
    start = np.arange(bins) * width
    low = np.where(np.isnan(table), np.inf, table).argmin(axis=1) + start
    high = np.where(np.isnan(table), -np.inf, table).argmax(axis=1) + start
    rows = np.unique(np.concatenate(([0], low, high, [n - 1])))
    return rows[rows < n]


def decimated(x: FloatArray, y: FloatArray, points: int = POINTS) -> tuple[FloatArray, FloatArray]:
    """A line (N,), (N,) thinned by `extremes` of `y`."""
    rows = extremes(y, points)
    return x[rows], y[rows]


SUMMARISED = 300
"""Points of a line that is summarised."""


def summarised(
    x: FloatArray, y: FloatArray, shown: Shown = "extremes"
) -> tuple[FloatArray, FloatArray]:
    """A line (N,), (N,) for a plot that holds several, of `SUMMARISED` points unless `extremes`.

    Args:
        x: In order.
        y: What is drawn over it.
        shown: `extremes` keeps every one; `mean` is for slow, noisy quantities whose trend
            matters, `upper` for magnitudes, of which the largest matter.
    """
    if shown == "extremes" or len(x) <= 2 * SUMMARISED:
        return decimated(x, y)
    edges = np.linspace(0, len(x), SUMMARISED + 1).astype(np.int64)
    start, width = edges[:-1], np.diff(edges)
    middle = np.add.reduceat(x, start) / width
    if shown == "mean":
        return middle, np.add.reduceat(y, start) / width
    return middle, np.maximum.reduceat(y, start)


def in_parts(
    thin: Thin, x: FloatArray, y: FloatArray, begins: Sequence[int]
) -> tuple[FloatArray, FloatArray]:
    """A line (N,), (N,) of several parts, each thinned by itself and NaN between them.

    Args:
        thin: Thins one part.
        x: In order.
        y: What is drawn over it.
        begins: Rows at which the parts after the first begin.
    """
    parts = [thin(x[a:b], y[a:b]) for a, b in pairwise((0, *begins, len(x))) if b > a]
    gap = np.full(1, np.nan)
    apart = [piece for part in parts for piece in (part, (gap, gap))][:-1]
    if not apart:
        return x, y
    return np.concatenate([a for a, _ in apart]), np.concatenate([b for _, b in apart])


def thinned(n: int, points: int) -> IntArray:
    """At most `points` of `n` row numbers, evenly spread; for clouds, where density matters."""
    if n <= points:
        return np.arange(n)
    return np.linspace(0, n - 1, points).round().astype(np.int64)


def binned(
    x: FloatArray, y: FloatArray, bins: int = 30, least: int = 5
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and standard deviation of `y` over equally wide bins of `x`.

    Args:
        x: (N,), finite.
        y: (N,), finite.
        bins: How many bins between the smallest and the largest `x`.
        least: Bins with fewer samples are left out.

    Returns:
        Centres, means and standard deviations, each (M,) with M ≤ `bins`.
    """
    if len(x) == 0 or np.ptp(x) == 0:
        return np.empty(0), np.empty(0), np.empty(0)
    edges = np.linspace(x.min(), x.max(), bins + 1)
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, bins - 1)
    count = np.bincount(which, minlength=bins)
    kept = count >= least
    divisor = np.maximum(count, 1)
    mean = np.bincount(which, y, minlength=bins) / divisor
    variance = np.bincount(which, (y - mean[which]) ** 2, minlength=bins) / divisor
    centres = (edges[:-1] + edges[1:]) / 2
    return centres[kept], mean[kept], np.sqrt(variance[kept])
