"""Weighted least squares on (X, y) with standard errors and the interface of scikit-learn.

`LinearRegression` of scikit-learn accepts weights but reports no standard errors. The two classes
of this module are for pipelines, cross-validation and grid search. Estimators of this package use
the underlying functions `hil.estimators.least_squares.weighted_least_squares` and
`hil.estimators.covariance.clustered_covariance`, which do not import scikit-learn.
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
    """Estimator that minimises Σ wᵢ (yᵢ − xᵢᵀβ)² by QR and computes standard errors.

    Args:
        fit_intercept: Whether a constant column is added.
        rank_tolerance: Relative singular value below which a direction counts as not excited, after
            all columns are scaled to unit length. In directions that are not excited, the solution
            has the smallest norm.

    Attributes:
        coef_: (p,) coefficients.
        intercept_: Fitted intercept; 0.0 if `fit_intercept` is not set.
        rank_: Number of excited directions, with the intercept counted.
        condition_: Condition number of the weighted regressor after scaling of its columns.
        unscaled_covariance_: (p, p) matrix (XᵀWX)⁻¹ of the coefficients; their covariance if the
            weights are the reciprocals of the true variances.
        bread_: Matrix (XᵀWX)⁻¹ including the intercept, if any, as the last row and column.
        std_error_: (p,) standard errors with the variance scale estimated from the residual.
        sigma_: Estimated standard deviation of an observation of weight 1; NaN if there are no
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
        """Fit the coefficients to X (N, p) and y (N,) with weights (N,); equal weights if None."""
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
        """Return the prediction Xβ (N,)."""
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
        fit_intercept: Whether a constant column is added; its uncertainty is not reported.
        rank_tolerance: Relative singular value below which a direction is not excited, as in
            `WeightedLeastSquares`.
        correction: Correction for few clusters, `CR1` or `CR2`, see `hil.estimators.covariance`.

    Attributes:
        covariance_: (p, p) covariance of `coef_`.
        std_error_: (p,) standard errors: square roots of the diagonal of `covariance_`.
        degrees_: (p,) degrees of freedom of Student's t distribution for each coefficient.
        n_clusters_: Number of clusters in the data.

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
        """Fit the coefficients to X (N, p) and y (N,) with weights (N,) and cluster numbers (N,).

        If no cluster numbers are passed, every row is a separate cluster.
        """
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
        """Return (p, 2) the confidence intervals of the coefficients at `level`."""
        check_is_fitted(self)
        return interval(self.coef_, self.std_error_, self.degrees_, level)
