"""Robust regression: losses that grow slower than squares, by iteratively reweighted least squares.

`Reweighting` alternates between least squares and weights until both agree: each sample weighs
less, the further its residual lies out in units of its joint's own robust deviation. All samples
are needed again in every round, so they stay in memory (`RobustRows`), joint by joint and without
the columns that a joint cannot feel. Huber's loss is convex; Tukey's, which ignores outliers
altogether, is not and therefore starts from Huber's solution.
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
"""Tuning constants at which 95 % of the efficiency on Gaussian errors is kept."""

NORMAL = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


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
        return replace(fit, solution=self._with_uncertainty(fit))

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


def robust_weights(z: FloatArray, loss: Loss) -> FloatArray:
    """ψ(z)/z of residuals in standard deviations: 1 at 0, less further out."""
    size = np.abs(z)
    if loss == "huber":
        return np.asarray(HUBER / np.maximum(size, HUBER))
    return np.asarray(np.maximum(1.0 - (size / TUKEY) ** 2, 0.0) ** 2)


def influence_slope(z: FloatArray, loss: Loss) -> FloatArray:
    """ψ′(z): how much an observation still counts where it is."""
    size = np.abs(z)
    if loss == "huber":
        return np.asarray(size <= HUBER, dtype=np.float64)
    ratio = (size / TUKEY) ** 2
    return np.asarray(np.where(ratio < 1.0, (1.0 - ratio) * (1.0 - 5.0 * ratio), 0.0))


def robust_scale(residual: FloatArray) -> FloatArray:
    """(n,) standard deviation of residuals (N, n) about 0 that outliers leave alone (MAD)."""
    return np.asarray(NORMAL * np.median(np.abs(residual), axis=0))


@dataclass(slots=True, eq=False)
class RobustRows:
    """Regressor and target in memory, without the columns a joint cannot feel.

    Attributes:
        columns: Per joint (k_j,) numbers of its columns, ascending.
        blocks: Per joint (N, k_j).
        target: (N, n).
        p: Number of all columns.
    """

    columns: list[IntArray]
    blocks: list[FloatArray]
    target: FloatArray
    p: int

    @staticmethod
    def of(
        observations: Iterable[tuple[slice, FloatArray, FloatArray]], felt: BoolArray
    ) -> RobustRows:
        """Collect W (N·n, p) and targets (N, n); `felt` (n, p) says which joint feels what."""
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
        """(N, n) target less prediction."""
        predicted = [
            block @ coefficients[own] for block, own in zip(self.blocks, self.columns, strict=True)
        ]
        return np.asarray(self.target - np.stack(predicted, axis=1))

    def replace(self, joint: int, column: int, values: FloatArray) -> None:
        """Put other values (N,) into one column of one joint."""
        self.blocks[joint][:, int(np.searchsorted(self.columns[joint], column))] = values

    def system(self, weight: FloatArray) -> System:
        """A small system with the weighted rows' Gram matrix; weights (N, n), none below 0."""
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
        """(p, p) XᵀWX, also for weights (N, n) below 0."""
        total = np.zeros((self.p, self.p))
        for j, (block, own) in enumerate(zip(self.blocks, self.columns, strict=True)):
            total[np.ix_(own, own)] += (block * weight[:, j, None]).T @ block
        return total


def gram_root(matrix: FloatArray, weight: FloatArray) -> FloatArray:
    """(k, k) R with RᵀR = Mᵀ diag(w) M, by the Gram matrix of scaled columns.

    A tenth of the cost of QR; half of the digits are lost, of which regressors need few.
    """
    gram = (matrix * weight[:, None]).T @ matrix
    length = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    root: FloatArray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale
    return root
