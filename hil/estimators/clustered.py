"""Least squares whose standard errors know which rows belong together.

The ten samples of a dwell share what its approach left in the gears; they are one observation, not
ten, and so, nearly, are all dwells of a pose. The covariance is therefore the sandwich
B (Σ_g s_g s_gᵀ) B with B = (XᵀWX)⁻¹ and one score s_g = X_gᵀ W_g r_g per cluster g (Liang & Zeger,
Biometrika 1986; Cameron & Miller, J. Human Resources 2015). Whatever the errors of one cluster have
to do with each other, it holds; clusters must be independent. Few clusters make it too small:

- `CR1` multiplies by G/(G−1) · (N−1)/(N−p), with Student's t at G−1 degrees of freedom;
- `CR2` (Bell & McCaffrey, Survey Methodology 2002) multiplies each cluster's residual by
  (I − H_gg)^(−1/2), which is unbiased for errors of equal variance, with Student's t at
  Satterthwaite's degrees of freedom, one number per coefficient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from sklearn.utils.validation import check_is_fitted

from hil.core import FloatArray, IntArray
from hil.estimators.linear import WeightedLeastSquares

Correction = Literal["CR1", "CR2"]

MOST_LEVERAGE = 1.0 - 1e-9
"""A cluster with all the leverage there is in some direction leaves no residual there."""


class Clustered(NamedTuple):
    """What clusters leave of the coefficients' certainty.

    Attributes:
        covariance: (p, p) of the coefficients.
        degrees: (p,) degrees of freedom of Student's t for each coefficient's interval.
    """

    covariance: FloatArray
    degrees: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ClusterSums:
    """All that the covariance needs to know of the rows.

    Attributes:
        gram: (G, p, p) X_gᵀ W_g X_g.
        score: (G, p) X_gᵀ W_g r_g.
        rows: Rows with a weight above zero, N.
    """

    gram: FloatArray
    score: FloatArray
    rows: int

    @staticmethod
    def of(
        X: FloatArray, residual: FloatArray, weight: FloatArray, clusters: IntArray
    ) -> ClusterSums:
        """Sums over the clusters that are numbered, in any way, by `clusters` (N,)."""
        _, number = np.unique(clusters, return_inverse=True)
        order = np.argsort(number, kind="stable")
        ends = np.flatnonzero(np.diff(number[order])) + 1
        pieces = np.split(order, ends)
        weighted = X * weight[:, None]
        gram = np.stack([X[rows].T @ weighted[rows] for rows in pieces])
        score = np.stack([residual[rows] @ weighted[rows] for rows in pieces])
        return ClusterSums(gram, score, int(np.count_nonzero(weight)))


def clustered_covariance(
    bread: FloatArray, sums: ClusterSums, correction: Correction = "CR2"
) -> Clustered:
    """Covariance of weighted least-squares coefficients, robust to what clusters share.

    Args:
        bread: (p, p) (XᵀWX)⁻¹ over all rows.
        sums: Of the clusters.
        correction: For few clusters, see the module.
    """
    if correction == "CR1":
        count, p = sums.score.shape
        factor = count / max(count - 1, 1) * (sums.rows - 1) / max(sums.rows - p, 1)
        half = sums.score @ bread
        return Clustered(factor * half.T @ half, np.full(p, max(count - 1, 1.0)))
    return _bell_mccaffrey(bread, sums)


def _bell_mccaffrey(bread: FloatArray, sums: ClusterSums) -> Clustered:
    """CR2 in the coordinates Z = W^½ X L with B = L Lᵀ, in which H_gg = Z_g Z_gᵀ.

    There Z_gᵀ (I − H_gg)^(−½) = V (1 − λ)^(−½) Vᵀ Z_gᵀ with Z_gᵀ Z_g = V λ Vᵀ: p × p is enough.
    """
    L = _root(bread)
    share, V = np.linalg.eigh(L.T @ sums.gram @ L)
    # No residual is left along a direction that one cluster decides alone: nothing to scale up.
    grown = np.where(share < MOST_LEVERAGE, 1.0 / np.sqrt(1.0 - np.minimum(share, 1 - 1e-12)), 1.0)
    adjust = (V * grown[:, None, :]) @ V.transpose(0, 2, 1)
    score = np.einsum("gij,gj->gi", adjust, sums.score @ L)
    half = score @ L.T
    # Column k of `to` is F_g l_k, that of `seen` is G_g F_g l_k, for coefficient k = l_kᵀ z.
    to = adjust @ L.T
    seen = ((V * share[:, None, :]) @ V.transpose(0, 2, 1)) @ to
    degrees = [_satterthwaite(to[:, :, k], seen[:, :, k]) for k in range(bread.shape[0])]
    return Clustered(half.T @ half, np.array(degrees))


def _satterthwaite(to: FloatArray, seen: FloatArray) -> float:
    """Degrees of freedom for errors of equal variance; `to`, `seen` (G, p) of a coefficient.

    The variance estimate is a quadratic form in the errors with the G × G matrix
    P = diag(d) − U Uᵀ; its degrees of freedom are tr(P)² / tr(P²).
    """
    diagonal = np.einsum("gi,gi->g", to, seen)
    length = np.einsum("gi,gi->g", seen, seen)
    trace = float(np.sum(diagonal - length))
    inner = seen.T @ seen
    square = float(np.sum(diagonal**2) - 2 * diagonal @ length + np.sum(inner**2))
    return max(trace**2 / square, 1.0) if square > 0 else 1.0


def _root(bread: FloatArray) -> FloatArray:
    """L (p, p) with L Lᵀ = bread, also where directions are not determined."""
    length = np.sqrt(np.diag(bread))
    length[length == 0] = 1.0
    values, vectors = np.linalg.eigh(bread / np.outer(length, length))
    root: FloatArray = length[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


class ClusteredLeastSquares(WeightedLeastSquares):
    """Weighted least squares with cluster-robust standard errors and intervals.

    Args:
        fit_intercept: Add a constant column; its own uncertainty is not told.
        rank_tolerance: As in `WeightedLeastSquares`.
        correction: For few clusters, `CR1` or `CR2`, see the module.

    Attributes:
        covariance_: (p, p) of `coef_`.
        std_error_: (p,) its diagonal's square roots.
        degrees_: (p,) of Student's t.
        n_clusters_: How many clusters there were.

    Examples:
        >>> import numpy as np
        >>> X, y = np.array([[1.0], [2.0], [3.0], [4.0]]), np.array([1.1, 1.9, 3.2, 3.8])
        >>> fitted = ClusteredLeastSquares().fit(X, y, clusters=np.array([0, 0, 1, 1]))
        >>> fitted.interval(0.9).shape
        (1, 2)
    """

    def __init__(
        self,
        *,
        fit_intercept: bool = False,
        rank_tolerance: float = 1e-9,
        correction: Correction = "CR2",
    ) -> None:
        super().__init__(fit_intercept=fit_intercept, rank_tolerance=rank_tolerance)
        self.correction = correction

    def fit(
        self, X: Any, y: Any, sample_weight: Any = None, clusters: Any = None
    ) -> ClusteredLeastSquares:
        """Fit to X (N, p) and y (N,), weights (N,) and cluster numbers (N,), each row its own."""
        if self.correction not in ("CR1", "CR2"):
            raise ValueError(f"correction is {self.correction!r}, but must be 'CR1' or 'CR2'")
        super().fit(X, y, sample_weight)
        X, y = np.asarray(X, dtype=np.float64), np.asarray(y, dtype=np.float64).ravel()
        groups = np.arange(len(X)) if clusters is None else np.asarray(clusters)
        if groups.shape != (len(X),):
            raise ValueError(f"clusters has the shape {groups.shape}, but must be ({len(X)},)")
        weight = np.ones(len(X)) if sample_weight is None else np.asarray(sample_weight)
        weight = np.broadcast_to(weight.astype(np.float64), (len(X),))
        residual = y - X @ self.coef_ - self.intercept_
        design = np.column_stack([X, np.ones(len(X))]) if self.fit_intercept else X
        sums = ClusterSums.of(design, residual, weight, groups)
        found = clustered_covariance(self.bread_, sums, self.correction)
        p = X.shape[1]
        self.n_clusters_ = len(sums.score)
        self.covariance_, self.degrees_ = found.covariance[:p, :p], found.degrees[:p]
        self.std_error_ = np.sqrt(np.diag(self.covariance_))
        return self

    def interval(self, level: float = 0.95) -> FloatArray:
        """(p, 2) lower and upper end in which a coefficient lies with probability `level`."""
        check_is_fitted(self)
        return interval(self.coef_, self.std_error_, self.degrees_, level)


def interval(
    coefficients: FloatArray, std_error: FloatArray, degrees: FloatArray, level: float
) -> FloatArray:
    """(p, 2) intervals of Student's t; NaN where the standard error is.

    Raises:
        ValueError: `level` is no share between 0 and 1.
    """
    from scipy.stats import t

    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level!r}, but must be between 0 and 1")
    reach = t.ppf(0.5 + level / 2, degrees) * std_error
    return np.stack([coefficients - reach, coefficients + reach], axis=1)
