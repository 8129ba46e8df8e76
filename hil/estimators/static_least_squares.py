"""The five ways of the static paper to solve R·θ = i (eq. 21–24), by the field's own code.

What is minimised is scikit-learn's, whose scaling differs from the paper's printed one (n rows):

| method | minimised | in the paper |
|---|---|---|
| ls, wls | Σ wᵢ rᵢ² | the same (21) |
| ridge | Σ rᵢ² + α Σ θₖ² | α/2 in (22), α in its solution |
| lasso | Σ rᵢ²/(2n) + α Σ abs(θₖ) | Σ rᵢ² + α/2 (Σ abs(θₖ))² in (23) |
| elastic-net | Σ rᵢ²/(2n) + α ρ Σ abs(θₖ) + α (1−ρ)/2 Σ θₖ² | α in place of ρ in (24) |

So α = 0.001 is next to nothing for ridge and a lot for lasso. Offsets are never penalised, as in
scikit-learn with an intercept (where the column of ones of eq. 20 ends up).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.covariance import ClusterSums, clustered_covariance
from hil.estimators.pose_weights import pose_counts, repeat_weights, residual_weights
from hil.estimators.regression import WeightedLeastSquares

Method = Literal["ls", "ridge", "lasso", "elastic-net", "wls"]
Weights = Literal["paper", "repeats", "pose"]

PENALISED = ("ridge", "lasso", "elastic-net")
TOLERANCE = 1e-8
"""Of the coordinate descent, as in the paper."""

MOST_PASSES = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class DwellSeries:
    """The dwells that rows come from.

    Attributes:
        pose: (D,) from 0; what is clustered.
        scatter: (D, n) variance of the samples of each dwell about their mean.
        samples: (D,) how many samples there were.
    """

    pose: IntArray
    scatter: FloatArray
    samples: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One regression: joints that share no parameter with any other.

    Attributes:
        X: (N, p) regressor, its offset columns included.
        y: (N,) target.
        joint: (N,) joint of each row, from 0.
        dwell: (N,) dwell of each row, from 0.
        offset: Joint → its column of ones.
        series: All dwells.
    """

    X: FloatArray
    y: FloatArray
    joint: IntArray
    dwell: IntArray
    offset: dict[int, int]
    series: DwellSeries

    @property
    def pose(self) -> IntArray:
        """(N,) pose of each row, from 0."""
        return self.series.pose[self.dwell]


class Solution(NamedTuple):
    """What a method finds for a block.

    Attributes:
        coefficients: (p,).
        covariance: (p, p), clustered by pose; NaN where the method gives none.
        degrees: (p,) degrees of freedom of the intervals; NaN likewise.
        weight: (N,) how much each row counted.
        rank: Excited directions.
        condition: Condition number of the column-scaled, weighted regressor.
    """

    coefficients: FloatArray
    covariance: FloatArray
    degrees: FloatArray
    weight: FloatArray
    rank: int
    condition: float


def least_squares(block: Block, weights: Weights | None) -> Solution:
    """Least squares, weighted if asked, with pose-clustered CR2 covariance."""
    first = WeightedLeastSquares().fit(block.X, block.y)
    if weights is None:
        return _clustered(block, first, np.ones(len(block.y)))
    if weights == "paper":
        return _weighted_by_residual(block, first)
    weight = pose_counts(block.pose) if weights == "pose" else _weighted_by_repeats(block)
    return _clustered(block, _weighted(block, weight), weight)


def penalised(
    block: Block, method: str, alpha: float, l1_ratio: float, standardise: bool
) -> Solution:
    """Ridge, lasso or elastic net of scikit-learn; no uncertainties: a penalty biases.

    Args:
        block: The regression.
        method: `ridge`, `lasso` or `elastic-net`.
        alpha: Weight of the penalty.
        l1_ratio: Share of Σ abs(θ) in the elastic net's penalty.
        standardise: Penalise coefficients of columns scaled to standard deviation 1.
    """
    own = [k for k in range(block.X.shape[1]) if k not in block.offset.values()]
    mean_X, mean_y = _joint_means(block, block.X[:, own]), _joint_means(block, block.y[:, None])
    X = block.X[:, own] - mean_X[block.joint]
    y = block.y - mean_y[block.joint, 0]
    scale = _scale_of(X) if standardise else np.ones(len(own))
    coefficients = np.zeros(block.X.shape[1])
    if own:
        fitted = _regressor(method, alpha, l1_ratio).fit(X / scale, y)
        coefficients[own] = fitted.coef_ / scale
    for joint, column in block.offset.items():
        coefficients[column] = mean_y[joint, 0] - mean_X[joint] @ coefficients[own]
    p = len(coefficients)
    probe = WeightedLeastSquares().fit(block.X, block.y)
    unknown = np.full((p, p), np.nan)
    ones = np.ones(len(block.y))
    return Solution(
        coefficients, unknown, unknown[0], ones, int(probe.rank_), float(probe.condition_)
    )


def _regressor(method: str, alpha: float, l1_ratio: float) -> Any:
    from sklearn.linear_model import ElasticNet, Lasso, LinearRegression, Ridge

    if alpha == 0.0:  # scikit-learn advises against descending to least squares
        return LinearRegression(fit_intercept=False)
    descent: dict[str, Any] = {"fit_intercept": False, "tol": TOLERANCE, "max_iter": MOST_PASSES}
    if method == "ridge":
        return Ridge(alpha=alpha, fit_intercept=False)
    if method == "lasso":
        return Lasso(alpha=alpha, **descent)
    return ElasticNet(alpha=alpha, l1_ratio=l1_ratio, **descent)


def _weighted(block: Block, weight: FloatArray) -> WeightedLeastSquares:
    return WeightedLeastSquares().fit(block.X, block.y, sample_weight=weight)


def _clustered(block: Block, solver: WeightedLeastSquares, weight: FloatArray) -> Solution:
    sums = ClusterSums.of(block.X, block.y - block.X @ solver.coef_, weight, block.pose)
    return _told(solver, sums, weight)


def _told(solver: WeightedLeastSquares, sums: ClusterSums, weight: FloatArray) -> Solution:
    found = clustered_covariance(solver.bread_, sums)
    condition = float(solver.condition_)
    return Solution(solver.coef_, *found, weight, int(solver.rank_), condition)


def _weighted_by_residual(block: Block, first: WeightedLeastSquares) -> Solution:
    """The paper's two steps; the intervals know that the weights came from the same data.

    Where a residual is large its weight is small, so its pull does not grow with it. That makes
    the second fit answer less to an error than its weights suggest, and inherit part of the first
    fit's error: (B₁ − D)·B₀⁻¹·s joins the score, see `PoseWeights.answer`.
    """
    residual = block.y - block.X @ first.coef_
    weight, ones = np.empty_like(block.y), np.ones_like(block.y)
    gap = np.zeros_like(first.bread_)
    for joint in block.offset:
        rows = block.joint == joint
        found = residual_weights(residual[rows], block.pose[rows], _floor(block))
        weight[rows] = found.weight
        own = ClusterSums.of(block.X[rows], residual[rows], ones[rows], block.pose[rows]).score
        gap += (own.T * found.answer) @ own
    second = _weighted(block, weight)
    sums = ClusterSums.of(block.X, block.y - block.X @ second.coef_, weight, block.pose)
    inherited = ClusterSums.of(block.X, residual, ones, block.pose).score @ first.bread_ @ gap
    return _told(second, replace(sums, score=sums.score + inherited), weight)


def _weighted_by_repeats(block: Block) -> FloatArray:
    weight = np.empty_like(block.y)
    for joint in block.offset:
        rows = block.joint == joint
        weight[rows] = repeat_weights(
            block.series.scatter[:, joint], block.series.samples, block.dwell[rows], _floor(block)
        )
    return weight


def _floor(block: Block) -> float:
    """Variance below which data count as free of noise."""
    return max((1e-12 * float(np.max(np.abs(block.y), initial=0.0))) ** 2, 1e-60)


def _joint_means(block: Block, values: FloatArray) -> FloatArray:
    """(n, k) mean of values (N, k) over the rows of each joint; 0 for joints without rows."""
    count = np.bincount(block.joint)
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, block.joint, values)
    means: FloatArray = sums / np.maximum(count, 1)[:, None]
    return means


def _scale_of(X: FloatArray) -> FloatArray:
    scale = np.asarray(np.std(X, axis=0))
    return np.where(scale > 0, scale, 1.0)
