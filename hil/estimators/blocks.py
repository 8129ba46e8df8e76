"""Stretches of time that count as one observation each, for standard errors of what moves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.correlation import correlated_samples

TIMES = 4.0
"""A block lasts so many correlation times of the residual: then blocks hardly know of another."""

FEWEST = 10
"""Blocks that are made even if they have to be shorter for it: fewer tell no variance."""


def time_blocks(residual: FloatArray, offsets: IntArray) -> IntArray:
    """(N,) number of the block each row belongs to; no block reaches over the end of a series.

    Args:
        residual: (N, n) of a fit; its slowest joint decides how long blocks are.
        offsets: (S + 1,) row at which each series begins.
    """
    slowest = float(np.max(correlated_samples(residual, offsets), initial=1.0))
    longest = max(1, len(residual) // FEWEST)
    length = int(np.clip(np.ceil(TIMES * slowest), 1, longest))
    number, first = np.empty(len(residual), dtype=np.int64), 0
    for start, stop in pairwise(offsets.tolist()):
        count = max(1, (stop - start) // length)
        number[start:stop] = first + np.arange(stop - start) * count // max(stop - start, 1)
        first += count
    return number
