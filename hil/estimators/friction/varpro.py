"""Variable projection: least squares with a few parameters that are not linear.

In min over θ, c of ‖F(θ) c − t‖² the linear c follows from θ, so that only θ is searched for. The
Jacobian of the projected residual is exact (Golub & Pereyra, SIAM J. Numer. Anal. 1973):

    ∂(F c − t)/∂θᵢ = P⊥ ∂Fᵢ c + F⁺ᵀ ∂Fᵢᵀ P⊥ t
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray

Columns = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""θ (p,) → F (N, k) and its derivatives (p, N, k)."""

MOST_STEPS = 12
FIRST_DAMPING = 1e-2
MOST_DAMPING = 1e6
SMALL_GAIN = 1e-5
"""The search ends when a step lowers the sum of squares by less than this share."""


@dataclass(frozen=True, slots=True, eq=False)
class Projected:
    """Where the search ended.

    Attributes:
        theta: (p,) inside the bounds.
        linear: (k,) coefficients of the columns there.
        squares: Sum of squares of the residual.
        steps: Steps taken.
    """

    theta: FloatArray
    linear: FloatArray
    squares: float
    steps: int


def variable_projection(
    columns: Columns,
    target: FloatArray,
    start: FloatArray,
    low: FloatArray,
    high: FloatArray,
    *,
    most_steps: int = MOST_STEPS,
) -> Projected:
    """Fit θ within bounds by Levenberg–Marquardt on the projected residual.

    Args:
        columns: See `Columns`.
        target: (N,).
        start: (p,) first θ.
        low: (p,) lower bounds.
        high: (p,) upper bounds.
        most_steps: Steps at most.
    """
    theta, damping = np.clip(start, low, high), FIRST_DAMPING
    linear, residual, J = _linearised(*columns(theta), target)
    squares, taken = float(residual @ residual), 0
    while taken < most_steps and damping < MOST_DAMPING:
        tried = np.clip(theta + _step(J, residual, damping, theta, low, high), low, high)
        found = _linearised(*columns(tried), target)
        taken += 1
        new = float(found[1] @ found[1])
        if not new < squares:
            damping *= 8.0
            continue
        gain = (squares - new) / squares
        theta, squares, damping = tried, new, damping / 5.0
        linear, residual, J = found
        if gain < SMALL_GAIN:
            break
    return Projected(theta, linear, squares, taken)


def _linearised(
    F: FloatArray, slopes: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Linear coefficients (k,), residual F c − t (N,) and its derivative by θ (N, p)."""
    length = np.linalg.norm(F, axis=0)
    length[length == 0] = 1.0
    U, singular, Vt = np.linalg.svd(F / length, full_matrices=False)
    kept = singular > 1e-10 * singular[0]
    U, half = U[:, kept], (Vt[kept].T / singular[kept]) / length[:, None]
    linear = half @ (U.T @ target)
    residual = F @ linear - target
    J = np.empty((len(target), len(slopes)))
    for i, slope in enumerate(slopes):
        along = slope @ linear
        # F⁺ᵀ = U · halfᵀ, and P⊥ t is minus the residual.
        back = U @ (half.T @ (slope.T @ -residual))
        J[:, i] = along - U @ (U.T @ along) + back
    return linear, residual, J


def _step(
    J: FloatArray,
    residual: FloatArray,
    damping: float,
    theta: FloatArray,
    low: FloatArray,
    high: FloatArray,
) -> FloatArray:
    """Damped step; parameters at a bound that push outwards stay where they are."""
    slope = J.T @ residual
    stuck = ((theta <= low) & (slope > 0)) | ((theta >= high) & (slope < 0))
    free = ~stuck
    step = np.zeros_like(theta)
    if np.any(free):
        normal = J[:, free].T @ J[:, free]
        normal += damping * np.diag(np.diag(normal)) + 1e-30 * np.eye(int(free.sum()))
        step[free] = -np.linalg.solve(normal, slope[free])
    return step
