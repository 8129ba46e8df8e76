"""Random motions to start from, within the linear limits and as far as possible within the rest."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil.excitation.optimiser.linear_limits import LinearLimits
from hil.excitation.optimiser.motion_limits import MotionLimits

DRAWS = 40
SHRINKAGE = (1.0, 0.7, 0.5, 0.3, 0.15)
"""Tried from the largest; a small motion has room to grow while it is improved."""


def draw(
    linear: LinearLimits,
    others: MotionLimits,
    rng: np.random.Generator,
    centres: FloatArray | None = None,
) -> FloatArray:
    """(n, f) free coefficients of a motion.

    Where limits besides the linear ones are given: the first draw that keeps them, or that of
    `DRAWS` that exceeds them least. With `centres` (m, n) every draw is about one of them.
    """
    best, least = np.empty(0), np.inf
    for _ in range(DRAWS):
        free = within_linear_limits(linear, rng)
        centre = None if centres is None else rng.choice(centres)
        for share in SHRINKAGE:
            smaller = free * np.r_[1.0, np.full(free.shape[1] - 1, share)]
            if centre is not None:
                smaller[:, 0] = np.clip(centre, *linear.centres(smaller))
            excess = float(others.excess(smaller).max(initial=-np.inf))
            if excess < least:
                best, least = smaller, excess
            if least <= 0:
                return best
    return best


def within_linear_limits(linear: LinearLimits, rng: np.random.Generator) -> FloatArray:
    """(n, f): a random series per joint, 70 to 100 % of the largest its limits allow."""
    free = rng.standard_normal(linear.free_shape)
    free *= (linear.largest_scale(free) * rng.uniform(0.7, 1.0, len(free)))[:, None]
    free[:, 0] = rng.uniform(*linear.centres(free))
    return free
