"""Weighted least squares on (X, y) with scikit-learn's contract and standard errors.

scikit-learn's `LinearRegression` takes weights but reports no standard errors. These two classes
are for pipelines, cross-validation and grid search; estimators of this package call the functions
behind them, `hil.estimators.least_squares.weighted_least_squares` and
`hil.estimators.covariance.clustered_covariance`, which load no scikit-learn.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from hil.core import FloatArray
from hil.estimators.covariance import ClusterSums, Correction, clustered_covariance, interval
from hil.estimators.least_squares import weighted_least_squares


class WeightedLeastSquares(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Minimise Σ wᵢ (yᵢ − xᵢᵀβ)² by QR, with standard errors.

    Args:
        fit_intercept: Add a constant column.
        rank_tolerance: Directions whose singular value, after scaling every column to unit
            length, is below this share of the largest count as not excited; they get the
            smallest solution.

    Attributes:
        coef_: (p,).
        intercept_: 0.0 unless `fit_intercept`.
        rank_: Number of excited directions, intercept included.
        condition_: Condition number of the column-scaled, weighted regressor.
        unscaled_covariance_: (XᵀWX)⁻¹ of the coefficients (p, p); their covariance if the
            weights are the reciprocals of the true variances.
        bread_: The same with the intercept, the last one, if there is one.
        std_error_: (p,) standard errors with the variance scale estimated from the residual.
        sigma_: Estimated standard deviation of an observation of weight 1, NaN without
            degrees of freedom.

    Examples:
        >>> import numpy as np
        >>> X, y = np.array([[1.0], [2.0], [3.0]]), np.array([2.0, 4.0, 6.0])
        >>> WeightedLeastSquares().fit(X, y).coef_.round(6)
        array([2.])
    """

    def __init__(self, *, fit_intercept: bool = False, rank_tolerance: float = 1e-9) -> None:
        self.fit_intercept = fit_intercept
        self.rank_tolerance = rank_tolerance

    def fit(self, X: Any, y: Any, sample_weight: Any = None) -> WeightedLeastSquares:
        """Fit to X (N, p) and y (N,) with weights (N,), all 1 when None."""
        X, y = validate_data(self, X, y, dtype=np.float64, y_numeric=True)
        weight = _weights(sample_weight, len(X))
        design = np.column_stack([X, np.ones(len(X))]) if self.fit_intercept else X
        solution = weighted_least_squares(design, y, weight, self.rank_tolerance)
        degrees = int(np.count_nonzero(weight)) - solution.rank
        self.sigma_ = np.sqrt(solution.squares / degrees) if degrees > 0 else np.nan
        self.rank_, self.condition_, self.bread_ = solution.rank, solution.condition, solution.bread
        self.coef_ = solution.coefficients[: X.shape[1]]
        self.intercept_ = float(solution.coefficients[-1]) if self.fit_intercept else 0.0
        self.unscaled_covariance_ = solution.bread[: X.shape[1], : X.shape[1]]
        self.std_error_ = self.sigma_ * np.sqrt(np.diag(self.unscaled_covariance_))
        return self

    def predict(self, X: Any) -> FloatArray:
        """Xβ (N,)."""
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        predicted: FloatArray = X @ self.coef_ + self.intercept_
        return predicted


def _weights(sample_weight: Any, rows: int) -> FloatArray:
    if sample_weight is None:
        return np.ones(rows)
    weight = np.broadcast_to(np.asarray(sample_weight, dtype=np.float64), (rows,))
    if not np.all(np.isfinite(weight)) or np.any(weight < 0):
        raise ValueError("sample_weight must be finite and not negative")
    if not np.any(weight):
        raise ValueError("sample_weight is zero everywhere: there is nothing to fit")
    return weight


class ClusteredLeastSquares(WeightedLeastSquares):
    """Weighted least squares with cluster-robust standard errors and intervals.

    Args:
        fit_intercept: Add a constant column; its own uncertainty is left out.
        rank_tolerance: As in `WeightedLeastSquares`.
        correction: For few clusters, `CR1` or `CR2`, see `hil.estimators.covariance`.

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
        errors = clustered_covariance(self.bread_, sums, self.correction)
        p = X.shape[1]
        self.n_clusters_ = len(sums.score)
        self.covariance_, self.degrees_ = errors.covariance[:p, :p], errors.degrees[:p]
        self.std_error_ = np.sqrt(np.diag(self.covariance_))
        return self

    def interval(self, level: float = 0.95) -> FloatArray:
        """(p, 2) lower and upper end in which a coefficient lies with probability `level`."""
        check_is_fitted(self)
        return interval(self.coef_, self.std_error_, self.degrees_, level)
