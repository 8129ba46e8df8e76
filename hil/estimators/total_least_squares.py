"""Total least squares: errors in the regressor as well as in the target.

Columns known exactly (a constant) are projected out first, the others are divided by their noise,
and the smallest right singular vector of [X y] gives the coefficients (Van Huffel & Vandewalle,
The Total Least Squares Problem, 1991, mixed LS–TLS; in identification Gautier & Briot). It is
consistent where the noise of the columns is independent, equal after scaling, and known up to a
factor; motion noise in a dynamic regressor is none of these exactly. And it magnifies noise: with
σ' the smallest singular value of X and σ that of [X y], the problem is like least squares with
XᵀX − σ² 1, ill-posed where σ' is not well above σ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FitError, FloatArray
from hil.estimators.compress import upper_triangle

LEAST_GAP = 1.02
"""σ'/σ below which the solution says nothing."""

NARROW_GAP = 1.5
"""σ'/σ below which it is magnified so much that people should know."""


@dataclass(frozen=True, slots=True, eq=False)
class TotalLeastSquares:
    """A mixed LS–TLS solution.

    Attributes:
        coefficients: (p,).
        gap: σ'/σ, how far the problem is from ill-posed; above 1.
    """

    coefficients: FloatArray
    gap: float

    @property
    def note(self) -> str:
        """For people, empty where there is nothing to say."""
        if self.gap >= NARROW_GAP:
            return ""
        share = 1.0 / (1.0 - self.gap**-2)
        return (
            "total least squares is nearly ill-posed here: the least excited direction stands out "
            f"of the noise by a factor of {self.gap:.3g} only, and is magnified {share:.3g} times"
        )


def total_least_squares(
    X: FloatArray, y: FloatArray, noise: FloatArray, target_noise: float, exact: BoolArray
) -> TotalLeastSquares:
    """Coefficients (p,) of y = Xβ with noise in both.

    Args:
        X: (m, p).
        y: (m,).
        noise: (p,) standard deviation of each column's noise.
        target_noise: Of the target.
        exact: (p,) columns without noise.

    Raises:
        FitError: It is ill-posed.
    """
    order = np.concatenate([np.flatnonzero(exact), np.flatnonzero(~exact)])
    fixed, p = int(exact.sum()), len(exact)
    scale = np.where(exact, 1.0, noise)[order]
    R = upper_triangle(np.column_stack([X[:, order] / scale, y / target_noise]))
    noisy = R[fixed:, fixed:]
    vector = np.linalg.svd(noisy)[2][-1]
    gap = _gap(noisy)
    if gap < LEAST_GAP or abs(vector[-1]) < 1e-9:
        raise FitError(
            "total least squares is ill-posed: the noise of the regressor is as large as its least "
            f"excited direction (ratio of singular values {gap:.3g})",
            hint="record motions that excite more, or use method: wls",
        )
    free = -vector[:-1] / vector[-1]
    rest = R[:fixed, -1] - R[:fixed, fixed:-1] @ free
    known = np.linalg.solve(R[:fixed, :fixed], rest)
    coefficients = np.empty(p)
    coefficients[order] = np.concatenate([known, free]) * target_noise / scale
    return TotalLeastSquares(coefficients, gap)


def _gap(noisy: FloatArray) -> float:
    smallest = float(np.linalg.svd(noisy[:, :-1], compute_uv=False)[-1])
    both = float(np.linalg.svd(noisy, compute_uv=False)[-1])
    return smallest / both if both > 0 else np.inf


def rough(values: FloatArray) -> FloatArray:
    """(p,) standard deviation of the noise on smooth columns (N, p), from third differences.

    White noise of deviation s has third differences of deviation √20 s; a smooth signal has almost
    none. The median over time leaves out steps.
    """
    if len(values) < 4:
        return np.zeros(values.shape[1])
    third = np.abs(np.diff(values, n=3, axis=0))
    return np.asarray(1.4826 * np.median(third, axis=0) / np.sqrt(20.0))
