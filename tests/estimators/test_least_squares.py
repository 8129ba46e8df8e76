"""Least squares of every kind against scikit-learn, statsmodels and published formulas."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm
from scipy.optimize import minimize
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.linear_model import Ridge as SkRidge
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.utils.estimator_checks import check_estimator
from statsmodels.sandbox.regression.gmm import IV2SLS

from hil.core.errors import FitError
from hil.estimators.least_squares import (
    ALPHAS,
    FARTHEST,
    FOLDS,
    GROUP_PENALTIES,
    GroupedRidge,
    JointwiseQR,
    instrumental,
    left_out_ridge,
    ridge,
    rough,
    total_least_squares,
    weighted_least_squares,
)
from hil.estimators.regression import ClusteredLeastSquares, WeightedLeastSquares

# Weighted


@pytest.fixture
def weighted():
    random = np.random.default_rng(0)
    X = random.normal(size=(200, 5)) * [1, 10, 0.1, 1, 1000]
    weight = random.uniform(0.1, 10, 200)
    y = X @ [1.0, -2.0, 3.0, 0.5, 0.01] + random.normal(size=200) / np.sqrt(weight)
    return X, y, weight


@pytest.mark.parametrize("intercept", [False, True])
def test_coefficients_are_those_of_scikit_learn(weighted, intercept) -> None:
    X, y, weight = weighted
    ours = WeightedLeastSquares(fit_intercept=intercept).fit(X, y, sample_weight=weight)
    theirs = LinearRegression(fit_intercept=intercept).fit(X, y, sample_weight=weight)
    assert ours.coef_ == pytest.approx(theirs.coef_, rel=1e-9)
    assert ours.intercept_ == pytest.approx(theirs.intercept_, abs=1e-9)
    assert ours.predict(X) == pytest.approx(theirs.predict(X), rel=1e-9)


def test_standard_errors_follow_the_normal_equations(weighted) -> None:
    X, y, weight = weighted
    fitted = WeightedLeastSquares().fit(X, y, sample_weight=weight)
    inverse = np.linalg.inv(X.T @ (weight[:, None] * X))
    beta = inverse @ X.T @ (weight * y)
    variance = np.sum(weight * (y - X @ beta) ** 2) / (len(y) - X.shape[1])
    assert fitted.unscaled_covariance_ == pytest.approx(inverse, rel=1e-6)
    assert fitted.std_error_ == pytest.approx(np.sqrt(variance * np.diag(inverse)), rel=1e-6)


def test_standard_errors_cover_the_scatter_of_repeated_experiments(weighted) -> None:
    X, _, weight = weighted
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
def test_weights_that_cannot_be_are_refused(weighted, weight) -> None:
    X, y, _ = weighted
    with pytest.raises(ValueError, match="sample_weight"):
        WeightedLeastSquares().fit(X, y, sample_weight=weight)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
def test_weighted_least_squares_passes_scikit_learns_checks() -> None:
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
    with pytest.raises(ValueError, match=f"needs rows with finite values; rows: {rows}"):
        weighted_least_squares(np.full((rows, 2), np.nan), np.ones(rows))


# With errors that clusters share


@pytest.fixture(scope="module")
def clustered():
    """Rows in 30 clusters of unequal size that share an error and a column's level."""
    random = np.random.default_rng(3)
    clusters = np.repeat(np.arange(30), random.integers(2, 12, 30))
    N = len(clusters)
    X = random.normal(size=(N, 3)) * [1.0, 50.0, 0.02]
    X[:, 0] += random.normal(size=30)[clusters]
    weight = random.uniform(0.2, 5.0, N)
    noise = random.normal(size=30)[clusters] + 0.5 * random.normal(size=N)
    y = X @ [1.0, -0.02, 30.0] + 0.7 + noise
    # Cluster numbers in no order: rows of a cluster need not stand together.
    order = random.permutation(N)
    return X[order], y[order], weight[order], 7 * clusters[order] - 3


def of_statsmodels(X, y, weight, clusters):
    model = sm.WLS(y, sm.add_constant(X, prepend=False), weights=weight)
    return model.fit(
        cov_type="cluster", cov_kwds={"groups": np.unique(clusters, return_inverse=True)[1]}
    )


def dense_cr2(X, y, weight, clusters):
    """The formula of Bell & McCaffrey with every matrix written out: covariance, degrees."""
    root = np.sqrt(weight)
    Z, e = X * root[:, None], (y * root)[:, None]
    bread = np.linalg.inv(Z.T @ Z)
    M = np.eye(len(y)) - Z @ bread @ Z.T
    residual, meat, G = M @ e, np.zeros_like(bread), []
    for number in np.unique(clusters):
        rows = clusters == number
        values, vectors = np.linalg.eigh(M[np.ix_(rows, rows)])
        A = vectors @ np.diag(values**-0.5) @ vectors.T
        score = Z[rows].T @ A @ residual[rows]
        meat += score @ score.T
        G.append(M[:, rows] @ A @ Z[rows] @ bread)
    degrees = []
    for k in range(X.shape[1]):
        columns = np.column_stack([g[:, k] for g in G])
        own = np.linalg.eigvalsh(columns.T @ columns)
        degrees.append(np.sum(own) ** 2 / np.sum(own**2))
    return bread @ meat @ bread, np.array(degrees)


@pytest.mark.parametrize("weighted", [False, True])
def test_cr1_is_that_of_statsmodels(clustered, weighted) -> None:
    X, y, weight, clusters = clustered
    weight = weight if weighted else np.ones_like(weight)
    ours = ClusteredLeastSquares(fit_intercept=True, correction="CR1")
    ours.fit(X, y, sample_weight=weight, clusters=clusters)
    theirs = of_statsmodels(X, y, weight, clusters)
    np.testing.assert_allclose(ours.coef_, theirs.params[:-1], rtol=1e-8)
    np.testing.assert_allclose(ours.covariance_, theirs.cov_params()[:-1, :-1], rtol=1e-8)
    assert set(ours.degrees_) == {29.0}


def test_cr2_of_rows_on_their_own_is_hc2_of_statsmodels(clustered) -> None:
    X, y, _, _ = clustered
    ours = ClusteredLeastSquares(fit_intercept=True).fit(X, y)
    theirs = sm.OLS(y, sm.add_constant(X, prepend=False)).fit()
    np.testing.assert_allclose(ours.std_error_, theirs.HC2_se[:-1], rtol=1e-8)


def test_cr2_and_its_degrees_of_freedom_are_the_published_formulas(clustered) -> None:
    X, y, weight, clusters = clustered
    ours = ClusteredLeastSquares().fit(X, y, sample_weight=weight, clusters=clusters)
    covariance, degrees = dense_cr2(X, y, weight, clusters)
    np.testing.assert_allclose(ours.covariance_, covariance, rtol=1e-8)
    np.testing.assert_allclose(ours.degrees_, degrees, rtol=1e-8)


def test_two_groups_have_the_degrees_of_freedom_of_imbens_and_kolesar() -> None:
    """Review of Economics and Statistics 2016, for the difference of two means."""
    n0, n1 = 27, 3
    X = np.column_stack([np.ones(n0 + n1), np.repeat([0.0, 1.0], [n0, n1])])
    ours = ClusteredLeastSquares().fit(X, np.random.default_rng(0).normal(size=n0 + n1))
    above = (n0 + n1) ** 2 * (n0 - 1) * (n1 - 1)
    assert ours.degrees_[1] == pytest.approx(above / (n1**2 * (n1 - 1) + n0**2 * (n0 - 1)))


@pytest.mark.thorough
def test_intervals_of_few_clusters_hold_what_they_promise() -> None:
    random = np.random.default_rng(1)
    clusters = np.repeat(np.arange(12), 5)
    X = np.column_stack([random.normal(size=(12, 2))[clusters], np.ones(60)])
    hits, naive = [], []
    for _ in range(150):
        y = random.normal(size=12)[clusters] + 0.1 * random.normal(size=60)
        low, high = ClusteredLeastSquares().fit(X, y, clusters=clusters).interval(0.95).T
        hits.append((low <= 0) & (high >= 0))
        low, high = ClusteredLeastSquares().fit(X, y).interval(0.95).T
        naive.append((low <= 0) & (high >= 0))
    assert 0.91 < np.mean(hits) < 0.99
    assert np.mean(naive) < 0.75


def test_a_cluster_that_decides_a_coefficient_alone_does_not_break_it(clustered) -> None:
    X, y, _, clusters = clustered
    own = np.column_stack([X, clusters == clusters[0]])
    fitted = ClusteredLeastSquares().fit(own, y, clusters=clusters)
    assert np.all(np.isfinite(fitted.covariance_))
    assert fitted.degrees_[-1] >= 1.0


@pytest.mark.parametrize(
    ("given", "message"),
    [({"clusters": np.zeros(3)}, "shape"), ({"clusters": np.zeros((5, 1))}, "shape")],
)
def test_clusters_of_another_length_are_refused(given, message) -> None:
    X = np.arange(10.0).reshape(5, 2) ** 2
    with pytest.raises(ValueError, match=message):
        ClusteredLeastSquares().fit(X, X[:, 0], **given)


def test_a_correction_nobody_knows_and_a_level_that_cannot_be_are_refused(clustered) -> None:
    X, y, _, _ = clustered
    with pytest.raises(ValueError, match="CR3"):
        ClusteredLeastSquares(correction="CR3").fit(X, y)
    with pytest.raises(ValueError, match="level"):
        ClusteredLeastSquares().fit(X, y).interval(95)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
def test_clustered_least_squares_passes_scikit_learns_checks() -> None:
    check_estimator(ClusteredLeastSquares(), on_skip=None)
    check_estimator(ClusteredLeastSquares(fit_intercept=True, correction="CR1"), on_skip=None)


def test_instruments_are_those_of_statsmodels_and_undo_noise_in_the_regressor() -> None:
    random = np.random.default_rng(5)
    exact = random.normal(size=(4000, 1)) * 2.0
    noisy = exact + random.normal(size=exact.shape)
    y = 3.0 * exact[:, 0] + 0.1 * random.normal(size=4000)
    ours = instrumental(noisy, y, exact, np.arange(4000))
    theirs = IV2SLS(y, noisy, exact).fit()
    np.testing.assert_allclose(ours.coefficients, theirs.params, rtol=1e-8)
    assert abs(ours.coefficients[0] - 3.0) < 3 * ours.std_error[0]
    assert np.linalg.lstsq(noisy, y)[0][0] < 2.5


# With a penalty, and with noise in the regressor


def penalised(seed=0, N=120):
    random = np.random.default_rng(seed)
    X = random.normal(size=(N, 4)) * [1.0, 30.0, 0.02, 5.0]
    return X, X @ [1.0, -0.1, 40.0, 0.3] + random.normal(size=N)


@pytest.mark.parametrize("alpha", [1e-6, 0.01, 3.0])
def test_ridge_is_scikit_learns_on_columns_of_length_one(alpha) -> None:
    X, y = penalised()
    length = np.linalg.norm(X, axis=0)
    wanted = SkRidge(alpha=alpha, fit_intercept=False).fit(X / length, y).coef_ / length
    assert ridge(X, y, alpha, np.ones(4, bool)) == pytest.approx(wanted, rel=1e-8)


def test_a_column_left_alone_is_not_pulled_to_zero() -> None:
    X, y = penalised()
    free = np.array([True, True, True, False])
    assert ridge(X, y, 1e9, free)[3] == pytest.approx(
        np.linalg.lstsq(X[:, 3:], y, rcond=None)[0][0], rel=1e-6
    )


def hard_to_tell_apart(seed):
    random = np.random.default_rng(seed)
    X = random.normal(size=(12, 1)) + 0.2 * random.normal(size=(12, 4))
    return X, X.sum(axis=1) + 2.0 * random.normal(size=12)


def test_the_penalty_is_the_one_that_predicts_a_trajectory_left_out_best() -> None:
    parts = [hard_to_tell_apart(seed) for seed in range(4)]
    best = left_out_ridge(parts, np.ones(4, bool))
    by_hand = []
    for alpha in ALPHAS:
        squares = 0.0
        for out in range(4):
            X, y = (
                np.concatenate([parts[k][side] for k in range(4) if k != out]) for side in (0, 1)
            )
            length = np.linalg.norm(X, axis=0)
            fitted = SkRidge(alpha=alpha, fit_intercept=False, solver="svd").fit(X / length, y)
            squares += np.sum((parts[out][0] / length @ fitted.coef_ - parts[out][1]) ** 2)
        by_hand.append(squares)
    assert best.errors == pytest.approx(by_hand, rel=1e-6)
    assert best.alpha == ALPHAS[int(np.argmin(by_hand))] > 0


def noisy_line(N=20000, share=0.5):
    random = np.random.default_rng(2)
    true = random.normal(size=(N, 2))
    X = np.column_stack([true + share * random.normal(size=true.shape), np.ones(N)])
    y = true @ [2.0, -1.0] + 0.7 + 0.4 * random.normal(size=N)
    return X, y, np.array([share, share, 0.0]), 0.4


def test_noise_in_the_regressor_biases_least_squares_and_not_total_least_squares() -> None:
    X, y, noise, target = noisy_line()
    plain = np.linalg.lstsq(X, y, rcond=None)[0]
    assert plain[:2] == pytest.approx([1.6, -0.8], abs=0.03)
    found = total_least_squares(X, y, noise, target, noise == 0)
    assert found.coefficients == pytest.approx([2.0, -1.0, 0.7], abs=0.03)


def test_total_least_squares_is_orthogonal_distance_regression() -> None:
    X, y, noise, target = noisy_line(N=300)
    found = total_least_squares(X, y, noise, target, noise == 0)

    def distance(beta):
        """Squared distances of the points from the plane, in their own deviations."""
        return np.sum((y - X @ beta) ** 2) / (target**2 + np.sum((noise * beta) ** 2))

    wanted = minimize(distance, np.zeros(3), method="BFGS", options={"gtol": 1e-6}).x
    assert found.coefficients == pytest.approx(wanted, rel=1e-4)


def test_a_regressor_that_is_mostly_noise_is_ill_posed_and_says_so() -> None:
    random = np.random.default_rng(0)
    X, y = random.normal(size=(40_000, 3)), random.normal(size=40_000)
    with pytest.raises(FitError, match="ill-posed") as caught:
        total_least_squares(X, y, np.ones(3), 1.0, np.zeros(3, bool))
    assert "method: wls" in caught.value.hint


def test_a_narrow_gap_is_noted_and_a_wide_one_is_not() -> None:
    X, y, noise, target = noisy_line(share=0.5)
    assert total_least_squares(X, y, noise, target, noise == 0).note == ""
    X, y, noise, target = noisy_line(share=1.2)
    assert "magnified" in total_least_squares(X, y, noise, target, noise == 0).note


def test_noise_on_smooth_columns_is_told_from_their_steps() -> None:
    random, t = np.random.default_rng(1), np.arange(4000) / 100.0
    smooth = np.column_stack([np.sin(t), np.sign(np.sin(t))])
    assert rough(smooth + 0.03 * random.normal(size=smooth.shape)) == pytest.approx(0.03, rel=0.05)
    assert rough(smooth) == pytest.approx(0.0, abs=1e-5)


# The correction's ridge regression over groups


def grouped(noise=0.3, seed=0, groups=60, features=12):
    """Two rows per group, inputs of very different size, five of them in the target."""
    random = np.random.default_rng(seed)
    X = random.normal(size=(2 * groups, features)) * np.logspace(-4, 2, features)
    weights = np.where(np.arange(features) < 5, 1.0, 0.0) / np.logspace(-4, 2, features)
    y = X @ weights + noise * random.normal(size=2 * groups)
    return X, y, np.repeat(np.arange(groups), 2)


def standardised(X):
    return (X - X.mean(axis=0)) / X.std(axis=0)


def test_weights_are_those_of_scikit_learn_with_the_same_penalty() -> None:
    X, y, groups = grouped()
    ours = GroupedRidge.fit(X, y, groups)
    theirs = Ridge(alpha=ours.penalty, fit_intercept=False).fit(standardised(X), y)
    assert ours.weights == pytest.approx(theirs.coef_, abs=1e-10)
    assert ours.predict(X) == pytest.approx(theirs.predict(standardised(X)), abs=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [0.01, 1.0, 10.0])
def test_the_penalty_is_the_one_a_grouped_grid_search_chooses(noise) -> None:
    X, y, groups = grouped(noise)
    ours = GroupedRidge.fit(X, y, groups)
    search = GridSearchCV(
        Ridge(fit_intercept=False),
        {"alpha": GROUP_PENALTIES},
        cv=GroupKFold(FOLDS, shuffle=True, random_state=4),
        scoring="neg_mean_squared_error",
    )
    search.fit(standardised(X), y, groups=groups)
    chosen = np.log10([ours.penalty, search.best_params_["alpha"]])
    assert abs(chosen[0] - chosen[1]) <= 0.5 + 1e-9  # other folds, a neighbour on the grid


def test_residuals_are_of_predictions_that_had_not_seen_the_group() -> None:
    X, y, groups = grouped()
    ours = GroupedRidge.fit(X, y, groups)
    changed = y.copy()
    changed[groups == 7] += 1000.0
    again = GroupedRidge.fit(X, changed, groups)
    if again.penalty == ours.penalty:
        told = (changed - again.residual)[groups == 7]
        assert told == pytest.approx((y - ours.residual)[groups == 7], abs=1e-9)
    assert np.mean(ours.residual**2) > np.mean((y - ours.predict(X)) ** 2)


def test_rows_of_one_group_are_never_apart() -> None:
    # Both rows of a group are the same, so whoever tore them apart could predict pure noise.
    random = np.random.default_rng(2)
    X, y = random.normal(size=(40, 60)), random.normal(size=40)
    groups = np.arange(40)
    together = GroupedRidge.fit(np.tile(X, (2, 1)), np.tile(y, 2), np.tile(groups, 2))
    torn = GroupedRidge.fit(np.tile(X, (2, 1)), np.tile(y, 2), np.arange(80))
    assert np.std(together.residual) > 0.9 * np.std(y)
    assert np.std(torn.residual) < 0.7 * np.std(y)


def test_pure_noise_is_shrunk_to_nothing() -> None:
    X, _, groups = grouped()
    y = np.random.default_rng(9).normal(size=len(X))
    ours = GroupedRidge.fit(X, y, groups)
    assert np.std(ours.predict(X)) < 0.05 * np.std(y)


def test_leverage_is_the_variance_a_prediction_inherits() -> None:
    X, y, groups = grouped()
    ours = GroupedRidge.fit(X, y, groups)
    Z = standardised(X)
    expected = np.diag(Z @ np.linalg.inv(Z.T @ Z + ours.penalty * np.eye(Z.shape[1])) @ Z.T)
    assert ours.leverages(X) == pytest.approx(expected, rel=1e-8)


def test_constant_inputs_are_ignored() -> None:
    X, y, groups = grouped()
    X[:, 3] = 5.0
    ours = GroupedRidge.fit(X, y, groups)
    assert ours.weights[3] == pytest.approx(0.0, abs=1e-12)
    moved = X.copy()
    moved[:, 3] = 1e6
    assert np.array_equal(ours.predict(moved), ours.predict(X))


def test_inputs_far_outside_of_training_count_as_no_farther() -> None:
    X, y, groups = grouped()
    ours = GroupedRidge.fit(X, y, groups)
    edge, beyond = (X.mean(axis=0) + far * X.std(axis=0) for far in (FARTHEST, 1e9))
    assert ours.predict(beyond[None]) == pytest.approx(ours.predict(edge[None]))


def test_a_single_group_leaves_nothing_to_choose_by_and_nothing_is_corrected() -> None:
    X, y, _ = grouped()
    ours = GroupedRidge.fit(X, y, np.zeros(len(y), dtype=np.int64))
    assert ours.penalty == max(GROUP_PENALTIES)
    assert np.max(np.abs(ours.predict(X))) < 1e-3 * np.max(np.abs(y))
