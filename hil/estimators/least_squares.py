"""Least squares that robots need and libraries lack, on numpy alone.

Observations of a robot are rows of a regressor, one per joint and instant, of which there may be
millions. `JointwiseQR` keeps one small triangle R_j per joint j, with R_jᵀR_j = [W τ]ⱼᵀ[W τ]ⱼ:
every solution, residual norm and weighting by joint follows from the triangles, so memory stays
bounded and weighting again costs nothing. `jointwise_least_squares` is the solution itself
(ordinary, then weighted by each joint's own residual), on `weighted_least_squares`, which knows
about directions that the data do not excite.

Behind it stand the relatives that other estimators choose instead, each a function of X and y:
ridge regression with a penalty chosen on trajectories or groups of poses left out, total least
squares for regressors with noise, and instrumental variables. Standard errors of correlated
observations are in `hil.estimators.covariance`, losses other than squares in
`hil.estimators.robust`, scikit-learn's contract in `hil.estimators.regression`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray

System = tuple[FloatArray, FloatArray, IntArray]
"""X (m, p), y (m,) and the joint (m,) of every row, as `JointwiseQR.system` gives them."""


class Weighted(NamedTuple):
    """A weighted least-squares solution.

    Attributes:
        coefficients: (p,).
        bread: (p, p) (XᵀWX)⁻¹, the covariance if the weights are reciprocals of the variances.
        rank: Excited directions.
        condition: Condition number of the column-scaled, weighted regressor.
        squares: Σ wᵢ rᵢ² of the residual.
    """

    coefficients: FloatArray
    bread: FloatArray
    rank: int
    condition: float
    squares: float


def weighted_least_squares(
    X: FloatArray, y: FloatArray, weight: FloatArray | None = None, rank_tolerance: float = 1e-9
) -> Weighted:
    """Minimise Σ wᵢ (yᵢ − xᵢᵀβ)² by QR and a singular value decomposition.

    Args:
        X: (N, p).
        y: (N,).
        weight: (N,), all 1 when None.
        rank_tolerance: Directions whose singular value, after scaling every column to unit length,
            is below this share of the largest count as not excited; they get the smallest solution.

    Raises:
        ValueError: There are no rows, or values that are not finite.
    """
    design = np.column_stack([X, y])
    p = design.shape[1] - 1
    triangle = upper_triangle(design if weight is None else design * np.sqrt(weight)[:, None])
    if not len(design) or not np.isfinite(triangle).all():
        raise ValueError(f"least squares needs rows of finite numbers; rows: {len(design)}")
    factor, target = triangle[:, :p], triangle[:, p]
    length = np.linalg.norm(factor, axis=0)
    length[length == 0] = 1.0
    U, singular, Vt = np.linalg.svd(factor / length, full_matrices=False)
    largest = singular[0] if len(singular) and singular[0] > 0 else 1.0
    excited = singular > rank_tolerance * largest
    inverse = np.zeros_like(singular)
    inverse[excited] = 1.0 / singular[excited]
    half = (Vt.T * inverse) / length[:, None]
    coefficients = half @ (U.T @ target)
    return Weighted(
        coefficients,
        bread=half @ half.T,
        rank=int(excited.sum()),
        condition=float(largest / singular[-1] if singular[-1] > 0 else np.inf),
        squares=float(np.sum((triangle @ np.append(coefficients, -1.0)) ** 2)),
    )


def upper_triangle(matrix: FloatArray) -> FloatArray:
    """R of the QR decomposition: RᵀR = matrixᵀ matrix."""
    # numpy's stubs know the pair (Q, R) only.
    R: Any = np.linalg.qr(matrix, mode="r")
    return np.asarray(R, dtype=np.float64)


class JointwiseQR:
    """Accumulates regressor rows and targets joint by joint.

    Attributes:
        rows: (n,) rows seen per joint.
    """

    def __init__(self, n_joints: int) -> None:
        self.rows: IntArray = np.zeros(n_joints, dtype=np.int64)
        self._triangles: list[FloatArray | None] = [None] * n_joints

    def add(self, W: FloatArray, target: FloatArray) -> None:
        """Add W (N·n, p), sample-major, and the target (N, n)."""
        samples, joints = target.shape
        cube = W.reshape(samples, joints, -1)
        for j in range(joints):
            block = np.column_stack([cube[:, j], target[:, j]])
            previous = self._triangles[j]
            stacked = block if previous is None else np.vstack([previous, block])
            self._triangles[j] = _compressed(stacked)
            self.rows[j] += samples

    def add_joint(self, joint: int, rows: FloatArray, samples: int) -> None:
        """Add rows [W τ] (m, p + 1) of one joint that stand for so many samples."""
        previous = self._triangles[joint]
        self._triangles[joint] = rows if previous is None else np.vstack([previous, rows])
        self.rows[joint] += samples

    @staticmethod
    def merged(parts: Sequence[JointwiseQR]) -> JointwiseQR:
        """What one would hold that had seen the rows of all parts."""
        whole = JointwiseQR(len(parts[0].rows))
        for j in range(len(whole.rows)):
            seen = [R for part in parts if (R := part.triangle(j)) is not None]
            whole._triangles[j] = _compressed(np.vstack(seen)) if seen else None
        whole.rows = np.sum([part.rows for part in parts], axis=0)
        return whole

    def triangle(self, joint: int) -> FloatArray | None:
        """R of [W τ] of one joint; None before its first row."""
        return self._triangles[joint]

    def system(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """An equivalent small system: X (m, p), y (m,) and the joint (m,) of each row."""
        triangles = self._filled()
        joint = np.concatenate([np.full(len(R), j) for j, R in enumerate(triangles)])
        stacked = np.vstack(triangles)
        return stacked[:, :-1], stacked[:, -1], joint

    def residual_std(self, coefficients: FloatArray) -> FloatArray:
        """(n,) standard deviation per joint of target − W·coefficients (p,).

        The parameters' degrees of freedom are shared equally among the joints.
        """
        extended = np.append(coefficients, -1.0)
        squares = np.array([np.sum((R @ extended) ** 2) for R in self._filled()])
        degrees = np.maximum(self.rows - len(coefficients) / len(self.rows), 1.0)
        deviation: FloatArray = np.sqrt(squares / degrees)
        return deviation

    def _filled(self) -> list[FloatArray]:
        return [R for R in self._triangles if R is not None]


def _compressed(matrix: FloatArray) -> FloatArray:
    """R with RᵀR = matrixᵀ matrix; columns of zeros cost nothing.

    A joint feels no link before its own, so half of a base regressor's blocks are zero.
    """
    used = np.any(matrix != 0.0, axis=0)
    triangle = upper_triangle(matrix[:, used])
    R = np.zeros((len(triangle), matrix.shape[1]))
    R[:, used] = triangle
    return R


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
    system = X, y, joint = observed.system()
    fit, weight = weighted_least_squares(X, y), np.ones(len(observed.rows))
    sigma = observed.residual_std(fit.coefficients)
    if weighted:
        weight = 1.0 / at_least_rounding(sigma, y) ** 2
        fit = weighted_least_squares(X, y, weight[joint])
        sigma = observed.residual_std(fit.coefficients)
    return Solution(fit.coefficients, sigma, weight, fit.bread, fit.rank, fit.condition, system)


def at_least_rounding(sigma: FloatArray, y: FloatArray) -> FloatArray:
    """Deviations (n,) above 0 to divide by.

    Noise-free data would weight by 1/0, and so would a target y (m,) that is 0 throughout.
    """
    floor = 1e-12 * float(np.max(np.abs(y))) or 1.0
    return np.asarray(np.maximum(sigma, floor))


ALPHAS = np.concatenate([[0.0], np.geomspace(1e-9, 1e-1, 25)])
"""Penalties that are tried, as shares of a column's sum of squares."""


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """A ridge solution.

    Attributes:
        coefficients: (p,).
        alpha: Penalty of the squared coefficient of a column of length 1.
        errors: (A,) mean squares left out at every alpha of `ALPHAS`; empty if alpha was given.
    """

    coefficients: FloatArray
    alpha: float
    errors: FloatArray


def ridge(X: FloatArray, y: FloatArray, alpha: float, penalised: BoolArray) -> FloatArray:
    """(p,) minimising ‖Xβ − y‖² + alpha Σ (lengthₖ βₖ)² over the penalised columns.

    Columns are scaled to length 1 before they are penalised, so that units do not matter.

    Args:
        X: (m, p).
        y: (m,).
        alpha: At least 0.
        penalised: (p,).
    """
    length = np.linalg.norm(X, axis=0)
    length = np.where(length > 0, length, 1.0)
    pull = np.diag(np.sqrt(alpha) * penalised.astype(np.float64))
    stacked = np.vstack([X / length, pull])
    scaled = np.linalg.lstsq(stacked, np.append(y, np.zeros(len(pull))), rcond=None)[0]
    return np.asarray(scaled / length)


def left_out_ridge(parts: Sequence[tuple[FloatArray, FloatArray]], penalised: BoolArray) -> Ridge:
    """Ridge with the penalty that predicts best the trajectory that was left out.

    Args:
        parts: X (m, p) and y (m,) of every trajectory, at least two.
        penalised: (p,).
    """
    errors = np.zeros(len(ALPHAS))
    for out, (X, y) in enumerate(parts):
        others = [part for k, part in enumerate(parts) if k != out]
        kept, target = (np.concatenate(side) for side in zip(*others, strict=True))
        for i, alpha in enumerate(ALPHAS):
            errors[i] += np.sum((X @ ridge(kept, target, alpha, penalised) - y) ** 2)
    # Of penalties that do equally well the largest one: it is the most cautious.
    best = int(np.flatnonzero(errors <= errors.min() * (1.0 + 1e-9))[-1])
    X, y = (np.concatenate(side) for side in zip(*parts, strict=True))
    alpha = float(ALPHAS[best])
    return Ridge(ridge(X, y, alpha, penalised), alpha, errors)


FOLDS = 5

GROUP_PENALTIES = np.logspace(7, 0, 15)
"""Candidates, beside columns of variance 1. The first shrinks everything away, and is the one where
nothing can be held out."""

FARTHEST = 6.0
"""Standard deviations from the mean of training beyond which an input counts as no farther."""


@dataclass(frozen=True, slots=True, eq=False)
class GroupedRidge:
    """Ridge regression of one target, its penalty chosen by holding out whole groups.

    Used for what physics leaves over: with a penalty chosen so, a correction that does not carry
    over to new poses is shrunk to nothing by itself.

    Attributes:
        mean, scale: (F,) of the inputs in training.
        weights: (F,) of the standardised inputs.
        leverage: (F, F) G with xᵀGx the leverage of a standardised input x.
        penalty: The one chosen.
        residual: (N,) target less what was predicted without its own group.
    """

    mean: FloatArray
    scale: FloatArray
    weights: FloatArray
    leverage: FloatArray
    penalty: float
    residual: FloatArray

    @staticmethod
    def fit(X: FloatArray, y: FloatArray, groups: IntArray) -> GroupedRidge:
        """Fit y (N,) on X (N, F) without intercept, groups (N,) kept together.

        Every candidate predicts each group from the others; the best one is then fitted to all.
        """
        mean, scale = X.mean(axis=0), X.std(axis=0)
        scale = np.where(scale > 1e-12 * np.abs(X).max(axis=0, initial=0.0), scale, np.inf)
        Z = (X - mean) / scale
        predicted = _out_of_group(Z, y, groups)
        errors = np.mean((y[:, None] - predicted) ** 2, axis=0)
        best = int(np.argmin(errors))
        values, vectors = np.linalg.eigh(Z.T @ Z)
        inverse = (vectors / (np.maximum(values, 0.0) + GROUP_PENALTIES[best])) @ vectors.T
        return GroupedRidge(
            mean, scale, inverse @ (Z.T @ y), inverse, float(GROUP_PENALTIES[best]),
            y - predicted[:, best],
        )  # fmt: skip

    def predict(self, X: FloatArray) -> FloatArray:
        """(N,) correction for X (N, F)."""
        correction: FloatArray = self._standardised(X) @ self.weights
        return correction

    def leverages(self, X: FloatArray) -> FloatArray:
        """(N,) how much of one observation's variance a prediction at X (N, F) inherits."""
        Z = self._standardised(X)
        return np.asarray(np.einsum("nf,fg,ng->n", Z, self.leverage, Z))

    def _standardised(self, X: FloatArray) -> FloatArray:
        return np.clip((X - self.mean) / self.scale, -FARTHEST, FARTHEST)


def _out_of_group(Z: FloatArray, y: FloatArray, groups: IntArray) -> FloatArray:
    """(N, candidates) predictions of each row from the folds its group is not in."""
    predicted = np.zeros((len(y), len(GROUP_PENALTIES)))
    for rest, out in pose_folds(groups):
        values, vectors = np.linalg.eigh(Z[rest].T @ Z[rest])
        along = vectors.T @ (Z[rest].T @ y[rest])
        shrunk = along[:, None] / (np.maximum(values, 0.0)[:, None] + GROUP_PENALTIES)
        predicted[out] = Z[out] @ (vectors @ shrunk)
    return predicted


def pose_folds(groups: IntArray) -> Iterator[tuple[BoolArray, BoolArray]]:
    """Which rows (N,) to fit on and which to judge on, groups (N,) kept together.

    At most `FOLDS` pairs, the same for the same groups; none with a single group.
    """
    names = np.unique(groups)
    folds = min(FOLDS, len(names))
    order = np.random.default_rng(0).permutation(len(names))
    fold_of = dict(
        zip(names[order].tolist(), (np.arange(len(names)) % folds).tolist(), strict=True)
    )
    fold = np.array([fold_of[group] for group in groups.tolist()])
    for k in range(folds if folds > 1 else 0):
        yield fold != k, fold == k


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

    Columns known exactly (a constant) are projected out first, the others are divided by their
    noise, and the smallest right singular vector of [X y] gives the coefficients (Van Huffel &
    Vandewalle, The Total Least Squares Problem, 1991, mixed LS–TLS; in identification Gautier &
    Briot). It is consistent where the noise of the columns is independent, equal after scaling, and
    known up to a factor; motion noise in a dynamic regressor is none of these exactly. And it
    magnifies noise: with σ' the smallest singular value of X and σ that of [X y], the problem is
    like least squares with XᵀX − σ² 1, ill-posed where σ' is not well above σ.

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
    _, both, directions = np.linalg.svd(noisy)
    vector = directions[-1]
    least = np.linalg.svd(noisy[:, :-1], compute_uv=False)[-1:]
    smallest = float(least[0]) if len(least) else np.inf
    gap = smallest / float(both[-1]) if both[-1] > 0 else np.inf
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


def rough(values: FloatArray) -> FloatArray:
    """(p,) standard deviation of the noise on smooth columns (N, p), from third differences.

    White noise of deviation s has third differences of deviation √20 s; a smooth signal has almost
    none. The median over time leaves out steps.
    """
    if len(values) < 4:
        return np.zeros(values.shape[1])
    third = np.abs(np.diff(values, n=3, axis=0))
    return np.asarray(1.4826 * np.median(third, axis=0) / np.sqrt(20.0))


class Instrumental(NamedTuple):
    """Coefficients (p,) and their cluster-robust standard errors (p,), inf if not determined."""

    coefficients: FloatArray
    std_error: FloatArray


def instrumental(X: FloatArray, y: FloatArray, Z: FloatArray, clusters: IntArray) -> Instrumental:
    """β = (ZᵀX)⁻¹ Zᵀy, with as many instruments as regressors.

    Consistent when Z is independent of the noise in X and y, where least squares is not. The
    covariance is the sandwich over clusters, times G/(G−1) · (N−1)/(N−p) as `CR1` in
    `hil.estimators.covariance`.

    Args:
        X: (N, p) regressors.
        y: (N,) target.
        Z: (N, p) instruments.
        clusters: (N,) rows of one number depend on each other.
    """
    N, p = X.shape
    scale_X, scale_Z = (np.maximum(np.linalg.norm(M, axis=0), 1e-300) for M in (X, Z))
    moments = (Z / scale_Z).T @ (X / scale_X)
    if np.linalg.cond(moments) > 1e8:
        return Instrumental(np.full(p, np.nan), np.full(p, np.inf))
    inverse = np.linalg.inv(moments) / scale_X[:, None]
    coefficients = inverse @ ((Z / scale_Z).T @ y)
    _, number = np.unique(clusters, return_inverse=True)
    score = np.zeros((number.max() + 1, p))
    np.add.at(score, number, Z / scale_Z * (y - X @ coefficients)[:, None])
    G = len(score)
    factor = G / max(G - 1, 1) * (N - 1) / max(N - p, 1)
    half = score @ inverse.T
    return Instrumental(coefficients, np.sqrt(factor * np.sum(half**2, axis=0)))
