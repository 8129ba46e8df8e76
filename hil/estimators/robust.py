"""Robust regression with Huber's or Tukey's loss, by iteratively reweighted least squares.

`Reweighting` alternates between a least-squares fit and new weights until both converge. The weight
of a sample decreases with its residual, relative to the robust standard deviation of its joint.
Because every round needs all samples, `RobustRows` stores them in memory, joint by joint, without
columns that do not affect a joint. Huber's loss is convex. Tukey's loss ignores large outliers
completely and is not convex; its iteration therefore starts from Huber's solution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray
from hil.estimators.least_squares import (
    Solution,
    System,
    at_least_rounding,
    weighted_least_squares,
)

Loss = Literal["huber", "tukey"]
LOSSES = ("huber", "tukey")

HUBER, TUKEY = 1.345, 4.685
"""Tuning constants of the losses for an efficiency of 95 % with Gaussian errors."""

NORMAL = 1.4826
"""Ratio of standard deviation to median absolute deviation for a normal distribution."""


MOST, MOST_CONSTRAINED = 100, 10
"""Maximum number of rounds without constraints, and of subsequent rounds with constraints."""

SETTLED, SETTLED_CONSTRAINED = 1e-5, 1e-3
"""Relative change of the prediction at which the rounds end, without and with constraints.

The change of the prediction is relative to the robust standard deviation of the residual.
"""

Constrain = Callable[[Solution], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Reweighted:
    """Converged solution of a reweighted least-squares problem.

    Attributes:
        solution: Least-squares solution with joint weights from `scale`.
        scale: (n,) robust standard deviation of each joint's residual.
        weight: (N, n) weights of the samples, between 0 and 1.
        iterations: Number of rounds that were computed.
    """

    solution: Solution
    scale: FloatArray
    weight: FloatArray
    iterations: int


class Reweighting:
    """Iteration of least-squares fits with weights from the residual of the previous fit.

    Args:
        rows: Observations; their values may be changed between runs.
        loss: Loss function that defines the weights.
        constrain: Function from a solution to constrained coefficients; None for no constraint. The
            constraint is applied after the weights have converged without constraint; then the
            iteration is repeated with the constraint.
    """

    def __init__(self, rows: RobustRows, loss: Loss, constrain: Constrain | None = None) -> None:
        self._rows, self._loss, self._constrain = rows, loss, constrain

    def run(self, start: Reweighted | None) -> Reweighted:
        """Return the converged weights and coefficients, from a start or from least squares."""
        begun = self._begin() if start is None else start
        fit = self._settle(begun, self._loss, None, MOST)
        if self._constrain is not None:
            fit = self._settle(fit, self._loss, self._constrain, MOST_CONSTRAINED)
        return replace(fit, solution=self._with_uncertainty(fit))

    def _begin(self) -> Reweighted:
        """Return the initial solution: weighted least squares, or Huber's solution for `tukey`."""
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
        system = X, y, joint = self._rows.system(weight)
        fitted = weighted_least_squares(X, y, (1.0 / scale**2)[joint])
        solution = Solution(
            coefficients=fitted.coefficients,
            sigma=scale,
            weight=1.0 / scale**2,
            bread=fitted.bread,
            rank=fitted.rank,
            condition=fitted.condition,
            system=system,
        )
        if constrain is not None:
            solution = replace(solution, coefficients=constrain(solution))
        return Reweighted(solution, scale, weight, rounds)

    def _with_uncertainty(self, fit: Reweighted) -> Solution:
        """Return the solution, its standard deviations and the inverse curvature of the loss."""
        rest = self._rows.residual(fit.solution.coefficients)
        slope = influence_slope(rest / fit.scale, self._loss)
        gram = self._rows.gram(slope / fit.scale**2)
        length = np.sqrt(np.diag(fit.solution.bread))
        try:
            bread = np.linalg.inv(gram * np.outer(length, length)) * np.outer(length, length)
        except np.linalg.LinAlgError as error:
            raise FitError(
                "too few samples agree with the model to compute standard errors of its parameters",
                hint="choose loss: huber, or check the data: most samples are outliers",
            ) from error
        degrees = max(len(rest) - self._rows.p / rest.shape[1], 1.0)
        sigma = np.sqrt(np.sum(rest**2, axis=0) / degrees)
        return replace(fit.solution, sigma=sigma, bread=bread)

    def _scale(self, fit: Reweighted) -> FloatArray:
        return self._floor(robust_scale(self._rows.residual(fit.solution.coefficients)))

    def _floor(self, scale: FloatArray) -> FloatArray:
        return at_least_rounding(scale, self._rows.target)


def robust_weights(z: FloatArray, loss: Loss) -> FloatArray:
    """Return ψ(z)/z of residuals in standard deviations: 1 at 0, smaller for large residuals."""
    size = np.abs(z)
    if loss == "huber":
        return np.asarray(HUBER / np.maximum(size, HUBER))
    return np.asarray(np.maximum(1.0 - (size / TUKEY) ** 2, 0.0) ** 2)


def influence_slope(z: FloatArray, loss: Loss) -> FloatArray:
    """Return ψ′(z), the sensitivity of the fit to an observation with residual z."""
    size = np.abs(z)
    if loss == "huber":
        return np.asarray(size <= HUBER, dtype=np.float64)
    ratio = (size / TUKEY) ** 2
    return np.asarray(np.where(ratio < 1.0, (1.0 - ratio) * (1.0 - 5.0 * ratio), 0.0))


def robust_scale(residual: FloatArray) -> FloatArray:
    """Return (n,) the standard deviation of residuals (N, n) about 0 from their median (MAD)."""
    return np.asarray(NORMAL * np.median(np.abs(residual), axis=0))


@dataclass(slots=True, eq=False)
class RobustRows:
    """Regressor and target in memory, without columns that do not affect a joint.

    Attributes:
        columns: Column indices (k_j,) of each joint, ascending.
        blocks: Regressor (N, k_j) of each joint.
        target: (N, n) target.
        p: Total number p of columns.
    """

    columns: list[IntArray]
    blocks: list[FloatArray]
    target: FloatArray
    p: int

    @staticmethod
    def of(
        observations: Iterable[tuple[slice, FloatArray, FloatArray]], felt: BoolArray
    ) -> RobustRows:
        """Add the rows of W (N·n, p) and the targets (N, n).

        The mask `felt` (n, p) states which columns affect each joint.
        """
        joints, p = felt.shape
        columns: list[IntArray] = [np.flatnonzero(own) for own in felt]
        pieces: list[list[FloatArray]] = [[] for _ in range(joints)]
        targets = []
        for _, W, target in observations:
            cube = W.reshape(len(target), joints, p)
            for j, own in enumerate(columns):
                pieces[j].append(cube[:, j, own])
            targets.append(target)
        return RobustRows(columns, [np.concatenate(x) for x in pieces], np.concatenate(targets), p)

    def residual(self, coefficients: FloatArray) -> FloatArray:
        """Return (N, n) the target minus the prediction."""
        predicted = [
            block @ coefficients[own] for block, own in zip(self.blocks, self.columns, strict=True)
        ]
        return np.asarray(self.target - np.stack(predicted, axis=1))

    def replace(self, joint: int, column: int, values: FloatArray) -> None:
        """Replace one column of one joint by other values (N,)."""
        self.blocks[joint][:, int(np.searchsorted(self.columns[joint], column))] = values

    def system(self, weight: FloatArray) -> System:
        """Return a small system with the Gram matrix of rows that have weights (N, n) ≥ 0."""
        X, y, joint = [], [], []
        for j, (block, own) in enumerate(zip(self.blocks, self.columns, strict=True)):
            root = gram_root(np.column_stack([block, self.target[:, j]]), weight[:, j])
            rows = np.zeros((len(root), self.p))
            rows[:, own] = root[:, :-1]
            X.append(rows)
            y.append(root[:, -1])
            joint.append(np.full(len(root), j))
        return np.vstack(X), np.concatenate(y), np.concatenate(joint)

    def gram(self, weight: FloatArray) -> FloatArray:
        """Return (p, p) the matrix XᵀWX, also for negative weights (N, n)."""
        total = np.zeros((self.p, self.p))
        for j, (block, own) in enumerate(zip(self.blocks, self.columns, strict=True)):
            total[np.ix_(own, own)] += (block * weight[:, j, None]).T @ block
        return total


def gram_root(matrix: FloatArray, weight: FloatArray) -> FloatArray:
    """Return (k, k) R with RᵀR = Mᵀ diag(w) M, from the Gram matrix of scaled columns.

    The computation from the Gram matrix takes a tenth of the time of QR. Half of the digits are
    lost by using the Gram matrix, which is acceptable for regressors.
    """
    gram = (matrix * weight[:, None]).T @ matrix
    length = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    root: FloatArray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale
    return root
