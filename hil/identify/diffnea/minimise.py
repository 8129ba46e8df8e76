"""Nonlinear least squares by Levenberg–Marquardt, dense and in float64.

For problems of some hundred rows: observations are compressed before, so that a step costs less
than a millisecond and no line search or restart is worth its code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from hil.typing import FloatArray

Residual = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""u (U,) → residual r (m,) and its Jacobian (m, U). Only |r|², Jᵀr and JᵀJ count."""

FIRST_DAMPING, MOST_DAMPING = 1e-3, 1e16


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where a minimisation ended.

    Attributes:
        u: (U,).
        cost: |r(u)|².
        iterations: Steps tried.
        converged: False when the steps ran out first.
    """

    u: FloatArray
    cost: float
    iterations: int
    converged: bool


def minimise(
    residual: Residual, start: FloatArray, *, iterations: int = 300, tolerance: float = 1e-12
) -> Minimum:
    """Least squares from a start, damped per coordinate.

    The damping follows the ratio of gained and promised decrease (Nielsen 1999, as in Madsen,
    Nielsen & Tingleff, 'Methods for non-linear least squares problems', 2004, algorithm 3.16) and
    is scaled by the largest diagonal of JᵀJ seen so far (Moré 1978). It ends where a step promises
    a decrease below `tolerance` of the cost.
    """
    u = np.array(start, dtype=np.float64)
    r, J = residual(u)
    cost, scale = float(r @ r), np.zeros(len(u))
    damping, growth = FIRST_DAMPING, 2.0
    for count in range(1, iterations + 1):
        gradient, curvature = J.T @ r, J.T @ J
        scale = np.maximum(scale, np.diag(curvature))
        step = _step(curvature, gradient, damping * np.where(scale > 0, scale, 1.0))
        promised = 0.0 if step is None else float(-step @ gradient - _quadratic(curvature, step))
        if step is not None and promised <= tolerance * cost:
            return Minimum(u, cost, count, True)
        if step is not None:
            trial, slope = residual(u + step)
            now = float(trial @ trial)
            if now < cost:
                u, r, J = u + step, trial, slope
                gain = (cost - now) / (2.0 * promised)
                cost, growth = now, 2.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
                continue
        damping, growth = damping * growth, 2.0 * growth
        if damping > MOST_DAMPING:
            return Minimum(u, cost, count, True)
    return Minimum(u, cost, iterations, False)


def _step(curvature: FloatArray, gradient: FloatArray, damping: FloatArray) -> FloatArray | None:
    """The damped Gauss–Newton step, None where rounding leaves no positive definite matrix."""
    try:
        factor = cho_factor(curvature + np.diag(damping), check_finite=False)
    except LinAlgError:
        return None
    step: FloatArray = -cho_solve(factor, gradient, check_finite=False)
    return step if np.all(np.isfinite(step)) else None


def _quadratic(curvature: FloatArray, step: FloatArray) -> float:
    return 0.5 * float(step @ curvature @ step)
