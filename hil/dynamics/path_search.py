"""The least of many distances along a densely sampled path, without computing them all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.core import FloatArray, IntArray

STRIDE = 16
"""Samples between those that are looked at first."""

TIE_M = 1e-9
"""Nothing is gained by looking for what is lower by less."""


def least_along(
    q: FloatArray, distances: Callable[[FloatArray], FloatArray], reach: FloatArray
) -> tuple[float, int]:
    """The smallest of all distances over all samples of a path, and the index of its sample.

    Between samples a and b that were computed, a distance cannot fall below (d_a + d_b − s) / 2,
    where s is how far its two bodies can have moved against each other: Σ |Δq| times the reach
    beyond each joint. Where that is not below the smallest distance found so far, the samples
    between are skipped; elsewhere the one in the middle is computed next.

    Args:
        q: (N, n) positions, N ≥ 1.
        distances: Gives (R, N) distances [m] for any positions (N, n).
        reach: (R, n) metres that a distance can change per radian of each joint.
    """
    turned = np.vstack([np.zeros(q.shape[1]), np.abs(np.diff(q, axis=0)).cumsum(axis=0)])
    at = np.unique(np.append(np.arange(0, len(q), STRIDE), len(q) - 1))
    found = distances(q[at])
    least = _least(found, at)
    left, right = at[:-1], at[1:]
    d_left, d_right = found[:, :-1], found[:, 1:]
    while True:
        moved = reach @ (turned[right] - turned[left]).T
        bound = 0.5 * (d_left + d_right - moved).min(axis=0, initial=np.inf)
        doubtful = np.flatnonzero((right - left > 1) & (bound < least[0] - TIE_M))
        if len(doubtful) == 0:
            return least
        left, right = left[doubtful], right[doubtful]
        middle = (left + right) // 2
        found = distances(q[middle])
        least = min(least, _least(found, middle))
        d_left = np.hstack([d_left[:, doubtful], found])
        d_right = np.hstack([found, d_right[:, doubtful]])
        left, right = np.append(left, middle), np.append(middle, right)


def _least(found: FloatArray, at: IntArray) -> tuple[float, int]:
    least = found.min(axis=0, initial=np.inf)
    return float(least.min()), int(at[least.argmin()])
