"""The correction's ridge regression, against scikit-learn's."""

import numpy as np
import pytest
from sklearn.linear_model import Ridge
from sklearn.model_selection import GridSearchCV, GroupKFold

from hil.estimators.least_squares import FARTHEST, FOLDS, GROUP_PENALTIES, GroupedRidge


def problem(noise=0.3, seed=0, groups=60, features=12):
    """Two rows per group, inputs of very different size, five of them in the target."""
    random = np.random.default_rng(seed)
    X = random.normal(size=(2 * groups, features)) * np.logspace(-4, 2, features)
    weights = np.where(np.arange(features) < 5, 1.0, 0.0) / np.logspace(-4, 2, features)
    y = X @ weights + noise * random.normal(size=2 * groups)
    return X, y, np.repeat(np.arange(groups), 2)


def standardised(X):
    return (X - X.mean(axis=0)) / X.std(axis=0)


def test_weights_are_those_of_scikit_learn_with_the_same_penalty() -> None:
    X, y, groups = problem()
    ours = GroupedRidge.fit(X, y, groups)
    theirs = Ridge(alpha=ours.penalty, fit_intercept=False).fit(standardised(X), y)
    assert ours.weights == pytest.approx(theirs.coef_, abs=1e-10)
    assert ours.predict(X) == pytest.approx(theirs.predict(standardised(X)), abs=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [0.01, 1.0, 10.0])
def test_the_penalty_is_the_one_a_grouped_grid_search_chooses(noise) -> None:
    X, y, groups = problem(noise)
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
    X, y, groups = problem()
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
    X, _, groups = problem()
    y = np.random.default_rng(9).normal(size=len(X))
    ours = GroupedRidge.fit(X, y, groups)
    assert np.std(ours.predict(X)) < 0.05 * np.std(y)


def test_leverage_is_the_variance_a_prediction_inherits() -> None:
    X, y, groups = problem()
    ours = GroupedRidge.fit(X, y, groups)
    Z = standardised(X)
    expected = np.diag(Z @ np.linalg.inv(Z.T @ Z + ours.penalty * np.eye(Z.shape[1])) @ Z.T)
    assert ours.leverages(X) == pytest.approx(expected, rel=1e-8)


def test_constant_inputs_are_ignored() -> None:
    X, y, groups = problem()
    X[:, 3] = 5.0
    ours = GroupedRidge.fit(X, y, groups)
    assert ours.weights[3] == pytest.approx(0.0, abs=1e-12)
    moved = X.copy()
    moved[:, 3] = 1e6
    assert np.array_equal(ours.predict(moved), ours.predict(X))


def test_inputs_far_outside_of_training_count_as_no_farther() -> None:
    X, y, groups = problem()
    ours = GroupedRidge.fit(X, y, groups)
    edge, beyond = (X.mean(axis=0) + far * X.std(axis=0) for far in (FARTHEST, 1e9))
    assert ours.predict(beyond[None]) == pytest.approx(ours.predict(edge[None]))


def test_a_single_group_leaves_nothing_to_choose_by_and_nothing_is_corrected() -> None:
    X, y, _ = problem()
    ours = GroupedRidge.fit(X, y, np.zeros(len(y), dtype=np.int64))
    assert ours.penalty == max(GROUP_PENALTIES)
    assert np.max(np.abs(ours.predict(X))) < 1e-3 * np.max(np.abs(y))
