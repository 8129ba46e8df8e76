"""Least squares over joints that are as noisy as their own residual says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.compress import JointwiseQR

System = tuple[FloatArray, FloatArray, IntArray]
"""X (m, p), y (m,) and the joint (m,) of every row, as `JointwiseQR.system` gives them."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Coefficients and what one needs to tell how certain they are.

    Attributes:
        coefficients: (p,).
        sigma: (n,) standard deviation of each joint's residual.
        weight: (n,) weight of each joint, 1/σ² of the fit before, or 1.
        bread: (p, p) (XᵀWX)⁻¹.
        rank: Excited directions.
        condition: Condition number of the column-scaled, weighted regressor.
        system: The compressed, unweighted observations.
    """

    coefficients: FloatArray
    sigma: FloatArray
    weight: FloatArray
    bread: FloatArray
    rank: int
    condition: float
    system: System

    def weighted_system(self) -> tuple[FloatArray, FloatArray]:
        """X (m, p) and y (m,) with every row divided by the deviation its joint is given."""
        X, y, joint = self.system
        root = np.sqrt(self.weight)[joint]
        return X * root[:, None], y * root


def jointwise_least_squares(observed: JointwiseQR, *, weighted: bool) -> Solution:
    """Ordinary least squares; then, if `weighted`, again with joints weighted by 1/σ².

    Source: Jubien, Gautier & Janot 2014 (IDIM-WLS).
    """
    from hil.estimators.linear import WeightedLeastSquares

    system = X, y, joint = observed.system()
    solver, weight = WeightedLeastSquares().fit(X, y), np.ones(len(observed.rows))
    sigma = observed.residual_std(solver.coef_)
    if weighted:
        weight = 1.0 / at_least_rounding(sigma, y) ** 2
        solver.fit(X, y, sample_weight=weight[joint])
        sigma = observed.residual_std(solver.coef_)
    bread, condition = solver.unscaled_covariance_, float(solver.condition_)
    return Solution(solver.coef_, sigma, weight, bread, solver.rank_, condition, system)


def at_least_rounding(sigma: FloatArray, y: FloatArray) -> FloatArray:
    """Deviations (n,) above 0 to divide by.

    Noise-free data would weight by 1/0, and so would a target y (m,) that is 0 throughout.
    """
    floor = 1e-12 * float(np.max(np.abs(y))) or 1.0
    return np.asarray(np.maximum(sigma, floor))
