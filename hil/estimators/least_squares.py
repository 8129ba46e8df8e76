"""Least-squares methods for robot identification that libraries lack, based on numpy alone.

Observations of a robot are rows of a regressor, one row per joint and instant; a recording can have
millions of rows. `JointwiseQR` stores one small triangular factor R_j per joint j, with R_jᵀR_j =
[W τ]ⱼᵀ[W τ]ⱼ. Every solution, residual norm and joint weighting follows from these factors, so that
memory is bounded and reweighting is fast. `jointwise_least_squares` computes the solution in two
steps: ordinary least squares, then least squares weighted by each joint's residual.
`weighted_least_squares` handles parameter directions that the data do not excite.

The module also contains alternative methods as functions of X and y: ridge regression with a
penalty chosen on held-out trajectories or groups of poses, total least squares for regressors with
noise, and instrumental variables. Standard errors of correlated observations are computed in
`hil.estimators.covariance`, robust losses in `hil.estimators.robust`, and the scikit-learn
interface is in `hil.estimators.regression`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, IntArray

System = tuple[FloatArray, FloatArray, IntArray]
"""Regressor X (m, p), target y (m,) and joint (m,) of every row, from `JointwiseQR.system`."""


class Weighted(NamedTuple):
    """Solution of a weighted least-squares problem.

    Attributes:
        coefficients: (p,) coefficients.
        bread: (p, p) matrix (XᵀWX)⁻¹, the covariance if the weights are reciprocal variances.
        rank: Number of excited parameter directions.
        condition: Condition number of the column-scaled, weighted regressor.
        squares: Weighted sum of squares Σ wᵢ rᵢ² of the residual.
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
        X: (N, p) regressor.
        y: (N,) target.
        weight: (N,) weights of the rows; None for equal weights of 1.
        rank_tolerance: Relative singular value below which a parameter direction counts as not
            excited, after all columns are scaled to unit length. In directions that are not
            excited, the solution has the smallest norm.

    Raises:
        ValueError: There are no rows, or values are not finite.
    """
    design = np.column_stack([X, y])
    p = design.shape[1] - 1
    triangle = upper_triangle(design if weight is None else design * np.sqrt(weight)[:, None])
    if not len(design) or not np.isfinite(triangle).all():
        raise ValueError(f"least squares needs rows with finite values; rows: {len(design)}")
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
    """Return the factor R of the QR decomposition: RᵀR = matrixᵀ matrix."""
    # The type stubs of numpy only declare the pair (Q, R).
    R: Any = np.linalg.qr(matrix, mode="r")
    return np.asarray(R, dtype=np.float64)


class JointwiseQR:
    """Accumulator of regressor rows and targets, with one triangular factor per joint.

    Attributes:
        rows: (n,) number of rows added per joint.
    """

    def __init__(self, n_joints: int) -> None:
        self.rows: IntArray = np.zeros(n_joints, dtype=np.int64)
        self._triangles: list[FloatArray | None] = [None] * n_joints

    def add(self, W: FloatArray, target: FloatArray) -> None:
        """Add the regressor rows W (N·n, p), sample-major, and the target (N, n)."""
        samples, joints = target.shape
        cube = W.reshape(samples, joints, -1)
        for j in range(joints):
            block = np.column_stack([cube[:, j], target[:, j]])
            previous = self._triangles[j]
            stacked = block if previous is None else np.vstack([previous, block])
            self._triangles[j] = _compressed(stacked)
            self.rows[j] += samples

    def add_joint(self, joint: int, rows: FloatArray, samples: int) -> None:
        """Add rows [W τ] (m, p + 1) of one joint that stand for `samples` samples."""
        previous = self._triangles[joint]
        self._triangles[joint] = rows if previous is None else np.vstack([previous, rows])
        self.rows[joint] += samples

    @staticmethod
    def merged(parts: Sequence[JointwiseQR]) -> JointwiseQR:
        """Return one accumulator with the rows of all parts."""
        whole = JointwiseQR(len(parts[0].rows))
        for j in range(len(whole.rows)):
            seen = [R for part in parts if (R := part.triangle(j)) is not None]
            whole._triangles[j] = _compressed(np.vstack(seen)) if seen else None
        whole.rows = np.sum([part.rows for part in parts], axis=0)
        return whole

    def triangle(self, joint: int) -> FloatArray | None:
        """Return the triangular factor R of [W τ] of one joint; None before its first row."""
        return self._triangles[joint]

    def system(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return a small equivalent system: X (m, p), y (m,) and the joint (m,) of each row."""
        triangles = self._filled()
        joint = np.concatenate([np.full(len(R), j) for j, R in enumerate(triangles)])
        stacked = np.vstack(triangles)
        return stacked[:, :-1], stacked[:, -1], joint

    def residual_std(self, coefficients: FloatArray) -> FloatArray:
        """Return (n,) the standard deviation of target − W·coefficients (p,) for each joint.

        The degrees of freedom of the parameters are divided equally among the joints.
        """
        extended = np.append(coefficients, -1.0)
        squares = np.array([np.sum((R @ extended) ** 2) for R in self._filled()])
        degrees = np.maximum(self.rows - len(coefficients) / len(self.rows), 1.0)
        deviation: FloatArray = np.sqrt(squares / degrees)
        return deviation

    def _filled(self) -> list[FloatArray]:
        return [R for R in self._triangles if R is not None]


def _compressed(matrix: FloatArray) -> FloatArray:
    """Return R with RᵀR = matrixᵀ matrix; columns of zeros are skipped.

    The torque of a joint does not depend on preceding links, so half of the blocks of a base
    regressor are zero.
    """
    used = np.any(matrix != 0.0, axis=0)
    triangle = upper_triangle(matrix[:, used])
    R = np.zeros((len(triangle), matrix.shape[1]))
    R[:, used] = triangle
    return R


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Least-squares solution, with the data from which its standard errors are computed.

    Attributes:
        coefficients: (p,) coefficients.
        sigma: (n,) standard deviation of the residual of each joint.
        weight: (n,) weight of each joint: 1/σ² of the previous fit, or 1.
        bread: (p, p) matrix (XᵀWX)⁻¹.
        rank: Number of excited parameter directions.
        condition: Condition number of the column-scaled, weighted regressor.
        system: Compressed, unweighted observations.
    """

    coefficients: FloatArray
    sigma: FloatArray
    weight: FloatArray
    bread: FloatArray
    rank: int
    condition: float
    system: System

    def weighted_system(self) -> tuple[FloatArray, FloatArray]:
        """Return X (m, p) and y (m,) with each row multiplied by the root of its joint weight."""
        X, y, joint = self.system
        root = np.sqrt(self.weight)[joint]
        return X * root[:, None], y * root


def jointwise_least_squares(observed: JointwiseQR, *, weighted: bool) -> Solution:
    """Return the least-squares solution, with joints weighted by 1/σ² if `weighted` is set.

    The weights of the joints come from a first, ordinary least-squares fit.

    Source: The weighted fit is the method IDIM-WLS of Jubien, Gautier & Janot 2014.
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
    """Return standard deviations (n,) with a lower bound above 0.

    Without a bound of the standard deviation, noise-free data, or a target y (m,) of zeros, would
    have infinite weights.
    """
    floor = 1e-12 * float(np.max(np.abs(y))) or 1.0
    return np.asarray(np.maximum(sigma, floor))


ALPHAS = np.concatenate([[0.0], np.geomspace(1e-9, 1e-1, 25)])
"""Candidate penalties of the ridge regression, as shares of the sum of squares of a column."""


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """Ridge-regression solution.

    Attributes:
        coefficients: (p,) coefficients.
        alpha: Penalty of the squared coefficient of a column that has length 1.
        errors: (A,) sum of squared held-out errors for each value of `ALPHAS`.
    """

    coefficients: FloatArray
    alpha: float
    errors: FloatArray


def ridge(X: FloatArray, y: FloatArray, alpha: float, penalised: BoolArray) -> FloatArray:
    """Return (p,) the minimiser of ‖Xβ − y‖² + alpha Σ (lengthₖ βₖ)² over penalised columns.

    The penalty applies to columns scaled to length 1, so it does not depend on units.

    Args:
        X: (m, p) regressor.
        y: (m,) target.
        alpha: Penalty of the squared coefficients, at least 0.
        penalised: (p,) mask of the penalised columns.
    """
    length = np.linalg.norm(X, axis=0)
    length = np.where(length > 0, length, 1.0)
    pull = np.diag(np.sqrt(alpha) * penalised.astype(np.float64))
    stacked = np.vstack([X / length, pull])
    scaled = np.linalg.lstsq(stacked, np.append(y, np.zeros(len(pull))), rcond=None)[0]
    return np.asarray(scaled / length)


def left_out_ridge(parts: Sequence[tuple[FloatArray, FloatArray]], penalised: BoolArray) -> Ridge:
    """Return the ridge solution with the penalty that predicts held-out trajectories best.

    Args:
        parts: List of X (m, p) and y (m,) of every trajectory, at least two.
        penalised: (p,) mask of the penalised columns.
    """
    errors = np.zeros(len(ALPHAS))
    for out, (X, y) in enumerate(parts):
        others = [part for k, part in enumerate(parts) if k != out]
        kept, target = (np.concatenate(side) for side in zip(*others, strict=True))
        for i, alpha in enumerate(ALPHAS):
            errors[i] += np.sum((X @ ridge(kept, target, alpha, penalised) - y) ** 2)
    # Of equally good penalties, the largest one is used as the most cautious choice.
    best = int(np.flatnonzero(errors <= errors.min() * (1.0 + 1e-9))[-1])
    X, y = (np.concatenate(side) for side in zip(*parts, strict=True))
    alpha = float(ALPHAS[best])
    return Ridge(ridge(X, y, alpha, penalised), alpha, errors)


FOLDS = 5

GROUP_PENALTIES = np.logspace(7, 0, 15)
"""Candidate penalties for columns that have variance 1.

The first candidate penalty is so large that all coefficients are nearly 0; it is used if no group
can be held out.
"""

FARTHEST = 6.0
"""Limit of a standardised input, in standard deviations from the training mean."""


@dataclass(frozen=True, slots=True, eq=False)
class GroupedRidge:
    """Ridge regression of one target, with a penalty chosen by holding out whole groups.

    The regression is used as a correction of a physical model. Because the penalty is chosen on
    held-out groups, a correction that does not apply to new poses becomes nearly 0.

    Attributes:
        mean, scale: (F,) mean and standard deviation of each input in the training data.
        weights: (F,) weights of the standardised inputs.
        leverage: (F, F) matrix G with xᵀGx the leverage of a standardised input x.
        penalty: Chosen penalty.
        residual: (N,) target minus the prediction of a fit that left out the group of the sample.
    """

    mean: FloatArray
    scale: FloatArray
    weights: FloatArray
    leverage: FloatArray
    penalty: float
    residual: FloatArray

    @staticmethod
    def fit(X: FloatArray, y: FloatArray, groups: IntArray) -> GroupedRidge:
        """Return the ridge regression of y (N,) on X (N, F) without intercept, for groups (N,).

        With every candidate penalty, each group is predicted from the other groups. The best
        candidate penalty is then used for a fit to all rows.
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
        """Return (N,) the correction for X (N, F)."""
        correction: FloatArray = self._standardised(X) @ self.weights
        return correction

    def leverages(self, X: FloatArray) -> FloatArray:
        """Return (N,) the variance of a prediction at X (N, F), for observations of variance 1."""
        Z = self._standardised(X)
        return np.asarray(np.einsum("nf,fg,ng->n", Z, self.leverage, Z))

    def _standardised(self, X: FloatArray) -> FloatArray:
        return np.clip((X - self.mean) / self.scale, -FARTHEST, FARTHEST)


def _out_of_group(Z: FloatArray, y: FloatArray, groups: IntArray) -> FloatArray:
    """Return (N, candidates) the prediction of each row by fits that left out its group."""
    predicted = np.zeros((len(y), len(GROUP_PENALTIES)))
    for rest, out in pose_folds(groups):
        values, vectors = np.linalg.eigh(Z[rest].T @ Z[rest])
        along = vectors.T @ (Z[rest].T @ y[rest])
        shrunk = along[:, None] / (np.maximum(values, 0.0)[:, None] + GROUP_PENALTIES)
        predicted[out] = Z[out] @ (vectors @ shrunk)
    return predicted


def pose_folds(groups: IntArray) -> Iterator[tuple[BoolArray, BoolArray]]:
    """Yield the masks (N,) of training and evaluation rows, with groups (N,) kept together.

    At most `FOLDS` pairs of masks are yielded, which depend on the groups only; a single group
    yields no pair.
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
"""Ratio σ'/σ below which total least squares is rejected as ill-posed."""

NARROW_GAP = 1.5
"""Ratio σ'/σ below which a note reports strong noise amplification."""


@dataclass(frozen=True, slots=True, eq=False)
class TotalLeastSquares:
    """Solution of the mixed problem of least squares and total least squares (LS–TLS).

    Attributes:
        coefficients: (p,) coefficients.
        gap: Ratio σ'/σ, a measure of the distance from an ill-posed problem; above 1.
    """

    coefficients: FloatArray
    gap: float

    @property
    def note(self) -> str:
        """Note for the user on noise amplification; empty if the problem is well-posed."""
        if self.gap >= NARROW_GAP:
            return ""
        share = 1.0 / (1.0 - self.gap**-2)
        return (
            "total least squares is nearly ill-posed here: the least excited direction exceeds "
            f"the noise by a factor of only {self.gap:.3g}, and its estimate is magnified "
            f"{share:.3g} times"
        )


def total_least_squares(
    X: FloatArray, y: FloatArray, noise: FloatArray, target_noise: float, exact: BoolArray
) -> TotalLeastSquares:
    """Return the coefficients (p,) of y = Xβ with noise in X and y.

    Exactly known regressor columns (constants) are projected out, and the other columns are divided
    by their noise. The coefficients follow from the smallest right singular vector of [X y] (Van
    Huffel & Vandewalle, The Total Least Squares Problem, 1991, mixed LS–TLS; in identification
    Gautier & Briot). Total least squares is consistent if the noise of the columns is independent,
    equal after scaling, and known up to a factor. Motion noise in a dynamic regressor satisfies
    these conditions only approximately. Total least squares also amplifies noise. Let σ' be the
    smallest singular value of X and σ that of [X y]. Total least squares then behaves like least
    squares with XᵀX − σ² 1, and is ill-posed if σ' is not well above σ.

    Args:
        X: (m, p) regressor.
        y: (m,) target.
        noise: (p,) standard deviation of the noise in each column.
        target_noise: Standard deviation of the noise in the target.
        exact: (p,) mask of the columns that have no noise.

    Raises:
        FitError: The problem is ill-posed, because σ' is not well above σ.
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
    """Return (p,) the noise standard deviation of smooth columns (N, p).

    The noise is computed from third differences.

    White noise with the standard deviation s has third differences with the standard deviation √20
    s, whereas a smooth signal has nearly no third differences. The median over time excludes steps
    in the signal.
    """
    if len(values) < 4:
        return np.zeros(values.shape[1])
    third = np.abs(np.diff(values, n=3, axis=0))
    return np.asarray(1.4826 * np.median(third, axis=0) / np.sqrt(20.0))


class Instrumental(NamedTuple):
    """Coefficients (p,) and cluster-robust standard errors (p,); infinite if not determined."""

    coefficients: FloatArray
    std_error: FloatArray


def instrumental(X: FloatArray, y: FloatArray, Z: FloatArray, clusters: IntArray) -> Instrumental:
    """Return β = (ZᵀX)⁻¹ Zᵀy, with as many instruments as regressors.

    The instrumental-variable estimate is consistent if Z is independent of the noise in X and y,
    whereas least squares is not. The covariance of the estimate is the sandwich estimator over
    clusters, times G/(G−1) · (N−1)/(N−p) as for `CR1` in `hil.estimators.covariance`.

    Args:
        X: (N, p) regressors.
        y: (N,) target.
        Z: (N, p) instruments.
        clusters: (N,) index of the cluster of each row; errors within a cluster may be correlated.
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
