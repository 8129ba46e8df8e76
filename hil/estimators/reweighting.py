"""Iteratively reweighted least squares over joints that each have a deviation of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hil.core import FitError, FloatArray
from hil.estimators.jointwise import Solution, at_least_rounding
from hil.estimators.robust_loss import Loss, influence_slope, robust_scale, robust_weights
from hil.estimators.robust_rows import RobustRows

MOST, MOST_CONSTRAINED = 100, 10
"""Rounds of least squares, and of least squares under constraints behind them."""

SETTLED, SETTLED_CONSTRAINED = 1e-5, 1e-3
"""Change of the prediction, as a share of the residual, at which the rounds end."""

Constrain = Callable[[Solution], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Reweighted:
    """Where the weights have settled.

    Attributes:
        solution: With the deviations `scale` as weights of the joints.
        scale: (n,) robust deviation of each joint's residual.
        weight: (N, n) of the samples, between 0 and 1.
        iterations: Rounds it took.
    """

    solution: Solution
    scale: FloatArray
    weight: FloatArray
    iterations: int


class Reweighting:
    """Least squares, again and again, with the weights its own residual asks for.

    Args:
        rows: Observations; they may be changed between runs.
        loss: Which weights.
        constrain: From a solution to coefficients under constraints, or None. It comes in once the
            weights have settled without it, and they settle again.
    """

    def __init__(self, rows: RobustRows, loss: Loss, constrain: Constrain | None = None) -> None:
        self._rows, self._loss, self._constrain = rows, loss, constrain

    def run(self, start: Reweighted | None) -> Reweighted:
        """Weights and coefficients that agree, from a start, or from least squares."""
        begun = self._begin() if start is None else start
        fit = self._settle(begun, self._loss, None, MOST)
        if self._constrain is not None:
            fit = self._settle(fit, self._loss, self._constrain, MOST_CONSTRAINED)
        return replace(fit, solution=self._told(fit))

    def _begin(self) -> Reweighted:
        """Least squares, joints weighted; for Tukey, which is not convex, Huber's solution."""
        ones = np.ones_like(self._rows.target)
        fit = self._solved(ones[0], ones, None, 0)
        fit = self._solved(self._scale(fit), ones, None, 0)
        return fit if self._loss == "huber" else self._settle(fit, "huber", None, MOST)

    def _settle(
        self, fit: Reweighted, loss: Loss, constrain: Constrain | None, most: int
    ) -> Reweighted:
        rest = self._rows.residual(fit.solution.coefficients)
        enough = SETTLED if constrain is None else SETTLED_CONSTRAINED
        for _ in range(most):
            scale = self._floor(robust_scale(rest))
            weight = robust_weights(rest / scale, loss)
            fit = self._solved(scale, weight, constrain, fit.iterations + 1)
            before, rest = rest, self._rows.residual(fit.solution.coefficients)
            if np.all(np.std(rest - before, axis=0) <= enough * scale):
                break
        return fit

    def _solved(
        self, scale: FloatArray, weight: FloatArray, constrain: Constrain | None, rounds: int
    ) -> Reweighted:
        from hil.estimators.linear import WeightedLeastSquares

        system = X, y, joint = self._rows.system(weight)
        solver = WeightedLeastSquares().fit(X, y, sample_weight=(1.0 / scale**2)[joint])
        solution = Solution(
            coefficients=solver.coef_,
            sigma=scale,
            weight=1.0 / scale**2,
            bread=solver.unscaled_covariance_,
            rank=solver.rank_,
            condition=float(solver.condition_),
            system=system,
        )
        if constrain is not None:
            solution = replace(solution, coefficients=constrain(solution))
        return Reweighted(solution, scale, weight, rounds)

    def _told(self, fit: Reweighted) -> Solution:
        """The solution with plain deviations, and the bread of the loss's own curvature."""
        rest = self._rows.residual(fit.solution.coefficients)
        slope = influence_slope(rest / fit.scale, self._loss)
        gram = self._rows.gram(slope / fit.scale**2)
        length = np.sqrt(np.diag(fit.solution.bread))
        try:
            bread = np.linalg.inv(gram * np.outer(length, length)) * np.outer(length, length)
        except np.linalg.LinAlgError as error:
            raise FitError(
                "too few samples fit the model to tell how certain its parameters are",
                hint="choose loss: huber, or look at the data: most of them look like outliers",
            ) from error
        degrees = max(len(rest) - self._rows.p / rest.shape[1], 1.0)
        sigma = np.sqrt(np.sum(rest**2, axis=0) / degrees)
        return replace(fit.solution, sigma=sigma, bread=bread)

    def _scale(self, fit: Reweighted) -> FloatArray:
        return self._floor(robust_scale(self._rows.residual(fit.solution.coefficients)))

    def _floor(self, scale: FloatArray) -> FloatArray:
        return at_least_rounding(scale, self._rows.target)
