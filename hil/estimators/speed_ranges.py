"""Ranges of a joint's speed, standstill being the first."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, IntArray


def speed_edges(speeds: FloatArray, ranges: int, standstill: float) -> FloatArray:
    """(ranges − 1,) speeds where ranges meet: standstill, then equally many samples in each.

    Args:
        speeds: (N,) magnitudes of one joint's velocity [rad/s].
        ranges: How many, standstill included.
        standstill: Where the first ends [rad/s].
    """
    moving = speeds[speeds > standstill]
    if ranges < 2 or len(moving) == 0:
        return np.full(max(ranges - 1, 0), standstill)
    inner = np.quantile(moving, np.arange(1, ranges - 1) / (ranges - 1))
    return np.concatenate([[standstill], inner])


def range_numbers(speeds: FloatArray, edges: FloatArray) -> IntArray:
    """(N, n) or (n,) number of the range of each speed; an edge belongs to the range below it."""
    return np.asarray((speeds[..., None] > edges).sum(axis=-1), dtype=np.int64)


def window_of(
    chosen: int, where: IntArray, blocks: IntArray, ranges: int, least: int
) -> tuple[int, int]:
    """First and last of the ranges around `chosen` that hold enough samples together.

    Enough are `least` samples of at least half of the trajectories, or all there are.

    Args:
        chosen: The range in question.
        where: (N,) range of each sample.
        blocks: (N,) trajectory of each.
        ranges: How many there are.
        least: Samples.
    """
    most = len(np.unique(blocks))
    for reach in range(ranges):
        first, last = max(chosen - reach, 0), min(chosen + reach, ranges - 1)
        inside = (where >= first) & (where <= last)
        if inside.sum() >= least and 2 * len(np.unique(blocks[inside])) >= most:
            return first, last
    return 0, ranges - 1
