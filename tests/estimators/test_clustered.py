"""Cluster-robust standard errors are statsmodels' (CR1) and the literature's (CR2)."""

import numpy as np
import pytest
import statsmodels.api as sm
from sklearn.utils.estimator_checks import check_estimator

from hil.estimators.least_squares import instrumental
from hil.estimators.regression import ClusteredLeastSquares


@pytest.fixture(scope="module")
def problem():
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
def test_cr1_is_that_of_statsmodels(problem, weighted) -> None:
    X, y, weight, clusters = problem
    weight = weight if weighted else np.ones_like(weight)
    ours = ClusteredLeastSquares(fit_intercept=True, correction="CR1")
    ours.fit(X, y, sample_weight=weight, clusters=clusters)
    theirs = of_statsmodels(X, y, weight, clusters)
    np.testing.assert_allclose(ours.coef_, theirs.params[:-1], rtol=1e-8)
    np.testing.assert_allclose(ours.covariance_, theirs.cov_params()[:-1, :-1], rtol=1e-8)
    assert set(ours.degrees_) == {29.0}


def test_cr2_of_rows_on_their_own_is_hc2_of_statsmodels(problem) -> None:
    X, y, _, _ = problem
    ours = ClusteredLeastSquares(fit_intercept=True).fit(X, y)
    theirs = sm.OLS(y, sm.add_constant(X, prepend=False)).fit()
    np.testing.assert_allclose(ours.std_error_, theirs.HC2_se[:-1], rtol=1e-8)


def test_cr2_and_its_degrees_of_freedom_are_the_published_formulas(problem) -> None:
    X, y, weight, clusters = problem
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


def test_a_cluster_that_decides_a_coefficient_alone_does_not_break_it(problem) -> None:
    X, y, _, clusters = problem
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


def test_a_correction_nobody_knows_and_a_level_that_cannot_be_are_refused(problem) -> None:
    X, y, _, _ = problem
    with pytest.raises(ValueError, match="CR3"):
        ClusteredLeastSquares(correction="CR3").fit(X, y)
    with pytest.raises(ValueError, match="level"):
        ClusteredLeastSquares().fit(X, y).interval(95)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
def test_scikit_learns_own_checks_pass() -> None:
    check_estimator(ClusteredLeastSquares(), on_skip=None)
    check_estimator(ClusteredLeastSquares(fit_intercept=True, correction="CR1"), on_skip=None)


def test_instruments_are_those_of_statsmodels_and_undo_noise_in_the_regressor() -> None:
    from statsmodels.sandbox.regression.gmm import IV2SLS

    random = np.random.default_rng(5)
    exact = random.normal(size=(4000, 1)) * 2.0
    noisy = exact + random.normal(size=exact.shape)
    y = 3.0 * exact[:, 0] + 0.1 * random.normal(size=4000)
    ours = instrumental(noisy, y, exact, np.arange(4000))
    theirs = IV2SLS(y, noisy, exact).fit()
    np.testing.assert_allclose(ours.coefficients, theirs.params, rtol=1e-8)
    assert abs(ours.coefficients[0] - 3.0) < 3 * ours.std_error[0]
    assert np.linalg.lstsq(noisy, y)[0][0] < 2.5
