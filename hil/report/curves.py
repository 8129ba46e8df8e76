"""Preparation of curves for drawing: default looks and reduction of the number of points.

`dressed` prepares a figure for plotly and matplotlib: every curve gets a look, and points that
would not be visible are removed. Other functions of the module reduce the number of samples when a
figure is created. The reduction is not visible: a line keeps its extreme values, and a point cloud
keeps its density.
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
"""Maximum number of points of a line after decimation; this number exceeds the width of a plot
in pixels.
"""


Entry: TypeAlias = tuple[str, str, str]
"""Legend entry: text, colour, and sign (name of a dash pattern in `colours.STROKES`, `band`, or
name of a mark).
"""


def dressed(figure: Figure, points: int = 0, models: Sequence[str] = ()) -> Figure:
    """Return the figure with a look for every curve; a single panel gets the full page width.

    Args:
        figure: Figure whose curves have an explicit look or no look.
        points: Maximum number of points of each curve; 0 keeps all points.
        models: Names of all models of the page, as in `looks_of`.
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
    """Return the legend entries of a dressed figure, one per curve name; empty for a single name.

    Bars are omitted from the legend entries, because the plotting library shows the patterns of
    bars in a separate legend.
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
    """Return whether the x values of a curve are names or dates instead of numbers."""
    if isinstance(curve.x, np.ndarray) and curve.x.dtype.kind in "fiu":
        return False
    return any(isinstance(x, str) for x in curve.x)


def y_of(curve: Curve) -> FloatArray:
    """Return the (N,) y values of a curve."""
    return np.asarray(curve.y, dtype=np.float64)


def x_of(curve: Curve) -> FloatArray:
    """Return the (N,) x values of a curve; names are replaced by their index from 0."""
    if has_names(curve):
        return np.arange(len(curve.x), dtype=np.float64)
    return np.asarray(curve.x, dtype=np.float64)


def fewer(curve: Curve, points: int) -> Curve:
    """Return a curve that looks the same but has at most `points` points.

    The reduction of a line keeps its extreme values; the reduction of other curves keeps evenly
    spaced points.
    """
    if has_names(curve) or len(curve.y) <= points:
        return curve
    rows = thinned(len(curve.y), points)
    if curve.style == "line":
        rows = extremes(y_of(curve), max(4, points))
    error = np.asarray(curve.y_error)[rows] if len(curve.y_error) else ()
    hover = [curve.hover[row] for row in rows.tolist()] if curve.hover else ()
    return replace(curve, x=x_of(curve)[rows], y=y_of(curve)[rows], y_error=error, hover=hover)


def categories(panel: Panel) -> list[str]:
    """Return the names along x in the order of their first occurrence; empty for numbers."""
    if panel.x_axis.scale == "date":
        return []
    named = [curve for curve in panel.curves if has_names(curve)]
    return list(dict.fromkeys(str(x) for curve in named for x in curve.x))


def diagonal(panel: Panel) -> FloatArray:
    """Return the (2,) ends of the line y = x over the range of all other curves of the panel."""
    others = [curve for curve in panel.curves if curve.style != "identity" and len(curve.y)]
    parts = [values for curve in others for values in (x_of(curve), y_of(curve))]
    return np.array(span(np.concatenate(parts) if parts else np.empty(0)))


def span(values: FloatArray) -> tuple[float, float]:
    """Return the smallest and largest finite value; equal values are widened by ±0.5."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def extremes(values: FloatArray, points: int = POINTS) -> IntArray:
    """Return row numbers that preserve the picture of a line: smallest and largest value per bin.

    Args:
        values: (N,) samples in the order of drawing. A NaN value is ignored inside a bin, but
            retained if the bin contains only NaN, so that gaps remain visible.
        points: Maximum number of returned row numbers, at least 4.

    Returns:
        (M,) increasing row numbers, M ≤ `points`; the first and the last row are always included.
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
    """Return the x and y values (N,) of a line, reduced to the rows `extremes` of `y`."""
    rows = extremes(y, points)
    return x[rows], y[rows]


SUMMARISED = 300
"""Number of points of a line that is reduced by averages or maxima."""


def summarised(
    x: FloatArray, y: FloatArray, shown: Shown = "extremes"
) -> tuple[FloatArray, FloatArray]:
    """Return x and y values (N,) of a line with fewer points, for a plot with several lines.

    Args:
        x: (N,) increasing values.
        y: (N,) values over x.
        shown: Kind of reduction: `extremes`, `mean` or `upper`. The reduction `extremes` keeps
            extreme values, with up to `POINTS` points. The reduction `mean` averages over
            `SUMMARISED` intervals and is suitable for slow, noisy quantities whose trend matters.
            The reduction `upper` keeps the maximum of `SUMMARISED` intervals and is suitable for
            magnitudes.
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
    """Return x and y values of a line whose parts are reduced separately, with NaN between parts.

    Args:
        thin: Function that reduces one part of the line.
        x: (N,) increasing values.
        y: (N,) values over x.
        begins: Row number at the start of each part except the first part.
    """
    parts = [thin(x[a:b], y[a:b]) for a, b in pairwise((0, *begins, len(x))) if b > a]
    gap = np.full(1, np.nan)
    apart = [piece for part in parts for piece in (part, (gap, gap))][:-1]
    if not apart:
        return x, y
    return np.concatenate([a for a, _ in apart]), np.concatenate([b for _, b in apart])


def thinned(n: int, points: int) -> IntArray:
    """Return at most `points` evenly spaced row numbers out of `n` rows.

    The even spacing of the selected rows preserves the density of a point cloud.
    """
    if n <= points:
        return np.arange(n)
    return np.linspace(0, n - 1, points).round().astype(np.int64)


def binned(
    x: FloatArray, y: FloatArray, bins: int = 30, least: int = 5
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean and the standard deviation of `y` in equally wide bins of `x`.

    Args:
        x: (N,), finite.
        y: (N,), finite.
        bins: Number of bins between the smallest and the largest `x`.
        least: Minimum number of samples per bin; bins with fewer samples are omitted.

    Returns:
        Bin centres, means and standard deviations, each of shape (M,) with M ≤ `bins`.
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
