"""Damped Newton steps with a curvature that is never negative, dense and in float64.

For problems of some hundred coordinates: observations are compressed before, so that a step costs
well under a millisecond, and no line search or restart is worth its code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from hil.core import FloatArray

FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e16

LITTLE_DAMPING = 1e-2
"""Only a step damped no more than this can say that nothing is left to gain."""

LONGEST_STEP = 3.0
"""Of any coordinate: they are logarithms and ratios, and beyond lies nothing but overflow."""


class Local(NamedTuple):
    """A cost near a point.

    Attributes:
        cost: Its value.
        gradient: (U,).
        curvature: (U, U) positive semidefinite, of Gauss–Newton type.
    """

    cost: float
    gradient: FloatArray
    curvature: FloatArray


Cost = Callable[[FloatArray], Local]


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where a minimisation ended.

    Attributes:
        u: (U,).
        cost: There.
        iterations: Steps tried.
        converged: False when the steps ran out, or got lost, first.
    """

    u: FloatArray
    cost: float
    iterations: int
    converged: bool


def minimise(
    cost: Cost, start: FloatArray, *, iterations: int = 300, tolerance: float = 1e-10
) -> Minimum:
    """The least cost from a start, by Levenberg's and Marquardt's damping.

    The damping follows the ratio of gained and promised decrease (Nielsen 1999, as in Madsen,
    Nielsen & Tingleff, 'Methods for non-linear least squares problems', 2004, algorithm 3.16),
    scaled by the largest diagonal of the curvature so far (Moré 1978), for on the way to a bound a
    coordinate's own curvature dies. It ends where a step promises a decrease below `tolerance`
    of the cost.
    """
    u = np.array(start, dtype=np.float64)
    here, damping, growth = cost(u), FIRST_DAMPING, 2.0
    scale = np.zeros(len(u))
    for count in range(1, iterations + 1):
        scale = np.maximum(scale, np.diag(here.curvature))
        step = _step(here, damping * np.where(scale > 0, scale, 1.0))
        if step is not None:
            promised = -float(step @ (here.gradient + 0.5 * here.curvature @ step))
            if promised <= tolerance * here.cost and damping <= LITTLE_DAMPING:
                return Minimum(u, here.cost, count, True)
            there = cost(u + step)
            if there.cost < here.cost:
                gain = (here.cost - there.cost) / promised
                u, here, growth = u + step, there, 2.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
                continue
        damping, growth = damping * growth, 2.0 * growth
        if damping > MOST_DAMPING:
            return Minimum(u, here.cost, count, False)
    return Minimum(u, here.cost, iterations, False)


def _step(here: Local, damping: FloatArray) -> FloatArray | None:
    """The damped step; None where rounding leaves no definite matrix, or it leads too far."""
    try:
        factor = cho_factor(here.curvature + np.diag(damping), check_finite=False)
    except LinAlgError:
        return None
    step: FloatArray = -cho_solve(factor, here.gradient, check_finite=False)
    return step if np.all(np.abs(step) <= LONGEST_STEP) else None
