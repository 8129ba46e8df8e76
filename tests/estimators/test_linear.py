"""Weighted least squares keeps scikit-learn's contract and the textbook's formulas."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.utils.estimator_checks import check_estimator

from hil.estimators.least_squares import JointwiseQR, weighted_least_squares
from hil.estimators.regression import WeightedLeastSquares


@pytest.fixture
def problem():
    random = np.random.default_rng(0)
    X = random.normal(size=(200, 5)) * [1, 10, 0.1, 1, 1000]
    weight = random.uniform(0.1, 10, 200)
    y = X @ [1.0, -2.0, 3.0, 0.5, 0.01] + random.normal(size=200) / np.sqrt(weight)
    return X, y, weight


@pytest.mark.parametrize("intercept", [False, True])
def test_coefficients_are_those_of_scikit_learn(problem, intercept) -> None:
    X, y, weight = problem
    ours = WeightedLeastSquares(fit_intercept=intercept).fit(X, y, sample_weight=weight)
    theirs = LinearRegression(fit_intercept=intercept).fit(X, y, sample_weight=weight)
    assert ours.coef_ == pytest.approx(theirs.coef_, rel=1e-9)
    assert ours.intercept_ == pytest.approx(theirs.intercept_, abs=1e-9)
    assert ours.predict(X) == pytest.approx(theirs.predict(X), rel=1e-9)


def test_standard_errors_follow_the_normal_equations(problem) -> None:
    X, y, weight = problem
    fitted = WeightedLeastSquares().fit(X, y, sample_weight=weight)
    inverse = np.linalg.inv(X.T @ (weight[:, None] * X))
    beta = inverse @ X.T @ (weight * y)
    variance = np.sum(weight * (y - X @ beta) ** 2) / (len(y) - X.shape[1])
    assert fitted.unscaled_covariance_ == pytest.approx(inverse, rel=1e-6)
    assert fitted.std_error_ == pytest.approx(np.sqrt(variance * np.diag(inverse)), rel=1e-6)


def test_standard_errors_cover_the_scatter_of_repeated_experiments(problem) -> None:
    X, _, weight = problem
    random = np.random.default_rng(1)
    clean = X @ np.ones(5)
    fits = [
        WeightedLeastSquares().fit(X, clean + random.normal(size=200) / np.sqrt(weight), weight)
        for _ in range(300)
    ]
    scatter = np.std([f.coef_ for f in fits], axis=0)
    assert np.mean([f.std_error_ for f in fits], axis=0) == pytest.approx(scatter, rel=0.15)


def test_redundant_columns_get_the_smallest_solution_and_a_short_rank() -> None:
    X = np.random.default_rng(0).normal(size=(50, 3))
    doubled = np.column_stack([X, X[:, 0]])
    fitted = WeightedLeastSquares().fit(doubled, X @ [2.0, 1.0, 1.0])
    assert fitted.rank_ == 3
    assert fitted.condition_ > 1e9
    assert fitted.coef_ == pytest.approx([1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("weight", [-np.ones(200), np.full(200, np.nan), np.zeros(200)])
def test_weights_that_cannot_be_are_refused(problem, weight) -> None:
    X, y, _ = problem
    with pytest.raises(ValueError, match="sample_weight"):
        WeightedLeastSquares().fit(X, y, sample_weight=weight)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
def test_scikit_learns_own_checks_pass() -> None:
    check_estimator(WeightedLeastSquares(), on_skip=None)
    check_estimator(WeightedLeastSquares(fit_intercept=True), on_skip=None)


def test_compressed_observations_give_the_same_fit_and_residuals() -> None:
    random = np.random.default_rng(2)
    W, target = random.normal(size=(300 * 3, 4)), random.normal(size=(300, 3))
    observed = JointwiseQR(3)
    for rows in (slice(0, 100), slice(100, 101), slice(101, 300)):
        observed.add(W.reshape(300, 3, 4)[rows].reshape(-1, 4), target[rows])
    X, y, joint = observed.system()
    weights = np.array([1.0, 4.0, 0.25])
    small = WeightedLeastSquares().fit(X, y, sample_weight=weights[joint])
    whole = WeightedLeastSquares().fit(W, target.ravel(), sample_weight=np.tile(weights, 300))
    assert len(X) == 3 * 5
    assert small.coef_ == pytest.approx(whole.coef_, rel=1e-9)
    assert small.unscaled_covariance_ == pytest.approx(whole.unscaled_covariance_, rel=1e-9)
    residual = (target.ravel() - W @ whole.coef_).reshape(300, 3)
    expected = np.sqrt(np.sum(residual**2, axis=0) / (300 - 4 / 3))
    assert observed.residual_std(whole.coef_) == pytest.approx(expected)


@pytest.mark.parametrize("rows", [0, 3])
def test_rows_that_are_no_numbers_are_refused(rows) -> None:
    with pytest.raises(ValueError, match=f"needs rows of finite numbers; rows: {rows}"):
        weighted_least_squares(np.full((rows, 2), np.nan), np.ones(rows))
