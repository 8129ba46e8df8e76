"""The inner (X, y) regressor: weighted least squares with scikit-learn's contract.

scikit-learn has no weighted least squares with standard errors; `LinearRegression` takes weights
but reports none.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from hil.core import FloatArray
from hil.estimators.compress import upper_triangle


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
        root = np.sqrt(weight)[:, None]
        triangle = upper_triangle(np.column_stack([design, y]) * root)
        coefficients = self._solve(triangle, design.shape[1])
        degrees = int(np.count_nonzero(weight)) - self.rank_
        residual = float(np.sum((triangle @ np.append(coefficients, -1.0)) ** 2))
        self.sigma_ = np.sqrt(residual / degrees) if degrees > 0 else np.nan
        self.coef_ = coefficients[: X.shape[1]]
        self.intercept_ = float(coefficients[-1]) if self.fit_intercept else 0.0
        self.std_error_ = self.sigma_ * np.sqrt(np.diag(self.unscaled_covariance_))
        return self

    def predict(self, X: Any) -> FloatArray:
        """Xβ (N,)."""
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        predicted: FloatArray = X @ self.coef_ + self.intercept_
        return predicted

    def _solve(self, triangle: FloatArray, columns: int) -> FloatArray:
        """Least squares on the triangular factor of [X y]; sets rank and covariance."""
        factor, target = triangle[:, :columns], triangle[:, columns]
        length = np.linalg.norm(factor, axis=0)
        length[length == 0] = 1.0
        U, singular, Vt = np.linalg.svd(factor / length, full_matrices=False)
        largest = singular[0] if len(singular) and singular[0] > 0 else 1.0
        kept = singular > self.rank_tolerance * largest
        self.rank_ = int(kept.sum())
        self.condition_ = largest / singular[-1] if singular[-1] > 0 else np.inf
        inverse = np.zeros_like(singular)
        inverse[kept] = 1.0 / singular[kept]
        half = (Vt.T * inverse) / length[:, None]
        features = columns - self.fit_intercept
        self.bread_ = half @ half.T
        self.unscaled_covariance_ = self.bread_[:features, :features]
        coefficients: FloatArray = half @ (U.T @ target)
        return coefficients


def _weights(sample_weight: Any, rows: int) -> FloatArray:
    if sample_weight is None:
        return np.ones(rows)
    weight = np.broadcast_to(np.asarray(sample_weight, dtype=np.float64), (rows,))
    if not np.all(np.isfinite(weight)) or np.any(weight < 0):
        raise ValueError("sample_weight must be finite and not negative")
    if not np.any(weight):
        raise ValueError("sample_weight is zero everywhere: there is nothing to fit")
    return weight
