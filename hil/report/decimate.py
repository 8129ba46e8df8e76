"""Fewer points, same picture: what a plot may leave out without hiding anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from hil.core import FloatArray, IntArray

Shown: TypeAlias = Literal["extremes", "mean", "upper"]

Thin: TypeAlias = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

POINTS = 1200
"""Points of a line after decimation: more than a plot of this page has pixels."""


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


def summarised(
    x: FloatArray, y: FloatArray, shown: Shown = "extremes", points: int = 300
) -> tuple[FloatArray, FloatArray]:
    """A line (N,), (N,) for a plot that holds several.

    Args:
        x: In order.
        y: What is drawn over it.
        shown: `extremes` keeps every one; `mean` is for slow, noisy quantities whose trend
            matters, `upper` for magnitudes, of which the largest matter.
        points: Length of the result for `mean` and `upper`.
    """
    if shown == "extremes" or len(x) <= 2 * points:
        return decimated(x, y)
    edges = np.linspace(0, len(x), points + 1).astype(np.int64)
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
