"""Quantiles of errors that come in trajectories, and how much they promise of the next one.

Samples of a trajectory resemble each other, so ten thousand samples of nine trajectories are not
ten thousand observations. Trajectories may be exchanged for each other; samples may not.
"""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray

ROUNDING = 1e-9


def block_numbers(blocks: IntArray) -> tuple[IntArray, int]:
    """(N,) number of each row's block from 0, and how many there are."""
    names, numbers = np.unique(blocks, return_inverse=True)
    return numbers, len(names)


def block_weights(numbers: IntArray, count: int) -> FloatArray:
    """(N,) weights that add up to 1, every block having the same share."""
    sizes = np.bincount(numbers, minlength=count)
    weights: FloatArray = 1.0 / (count * sizes[numbers])
    return weights


def weighted_quantile(values: FloatArray, weights: FloatArray, level: float) -> float:
    """Least of the values that at least the share `level` of the weight does not exceed.

    A level of 1 or more gives the largest value.
    """
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    place = int(np.searchsorted(reached, level - ROUNDING))
    return float(values[order[min(place, len(order) - 1)]])


def effective_samples(outside: BoolArray, numbers: IntArray, count: int) -> float:
    """How many independent samples would estimate the share outside as well as these do.

    If the share outside varied by chance alone, its variance among trajectories would be that of
    a binomial; the ratio of the two is the design effect of cluster samples (Kish 1965). At least
    the number of blocks, at most that of samples; of a single block, which cannot say, the
    former.

    Args:
        outside: (N,) which samples are outside.
        numbers: (N,) block of each.
        count: Blocks.
    """
    if count < 2:
        return float(count)
    shares = np.bincount(numbers, outside, count) / np.bincount(numbers, minlength=count)
    mean, variance = float(np.mean(shares)), float(np.var(shares, ddof=1))
    if variance <= 0.0:
        return float(len(outside))
    return float(np.clip(count * mean * (1.0 - mean) / variance, count, len(outside)))


def level_for(coverage: float, size: float) -> float:
    """Level of the quantile of `size` observations that covers the next with `coverage`.

    Above 1 there are too few of them for that.
    """
    return coverage * (size + 1.0) / size


def conformal_quantile(
    sizes: FloatArray, blocks: IntArray, coverage: float, *, strict: bool = False
) -> tuple[float, float]:
    """A bound for the next trajectory, and the share of its samples that it is proven to hold.

    With equal weights of K trajectories the quantile at level p holds at least p·K/(K + 1) of a
    new one on average, however its samples depend on each other (hierarchical conformal
    prediction: Lee, Barber & Willett 2023). `strict` raises the level until that is the coverage
    asked for. Without, the level is raised by the effective number of samples in place of K: the
    same where all samples of a trajectory are alike, next to nothing where they are independent.

    Args:
        sizes: (N,) magnitudes of errors, N > 0.
        blocks: (N,) trajectory of each.
        coverage: Share asked for.
        strict: As above.
    """
    numbers, count = block_numbers(blocks)
    weights = block_weights(numbers, count)
    effective = float(count)
    if not strict:
        first = weighted_quantile(sizes, weights, coverage)
        effective = effective_samples(sizes > first, numbers, count)
    level = min(level_for(coverage, effective), 1.0)
    return weighted_quantile(sizes, weights, level), level * count / (count + 1.0)
