"""Condition reports name the worst directions; essential parameters are those that matter."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm

from hil.estimators.identifiability import condition_report, essential_parameters


def test_condition_numbers_are_numpys_raw_and_scaled() -> None:
    X = np.random.default_rng(0).normal(size=(50, 3)) * [1.0, 100.0, 1e-3]
    report = condition_report(X, "abc")
    assert report.raw == pytest.approx(np.linalg.cond(X))
    assert report.scaled == pytest.approx(np.linalg.cond(X / np.linalg.norm(X, axis=0)))


def test_two_columns_that_nearly_agree_are_the_worst_direction() -> None:
    random = np.random.default_rng(0)
    X = random.normal(size=(400, 4))
    X[:, 2] = 50.0 * X[:, 0] + 0.05 * random.normal(size=400)
    report = condition_report(X, ["mass", "friction", "gravity", "offset"])
    parts = dict(report.worst[0].parts)
    assert set(parts) == {"mass", "gravity"}
    assert parts["mass"] == pytest.approx(-parts["gravity"], rel=1e-3)
    assert report.worst[0].gain == pytest.approx(1.0 / report.scaled, rel=1e-6)
    assert report.worst[1].gain > 100 * report.worst[0].gain
    assert "mass" in str(report.worst[0])


def test_a_column_of_zeros_is_not_determined_at_all() -> None:
    X = np.eye(3)[:, [0, 1, 1]] * [1.0, 0.0, 2.0]
    report = condition_report(X, "abc")
    assert report.scaled == np.inf
    assert report.worst[0].gain == 0.0
    assert dict(report.worst[0].parts) == {"b": pytest.approx(1.0)}


@pytest.fixture(scope="module")
def sparse():
    random = np.random.default_rng(4)
    X = random.normal(size=(300, 8))
    return X, X @ [3.0, 0.0, -1.0, 0.0, 0.5, 0.0, 0.0, 0.02] + random.normal(size=300)


def test_parameters_that_are_zero_go_and_the_others_stay(sparse) -> None:
    X, y = sparse
    found = essential_parameters(X, y, "abcdefgh", len(X))
    assert found.kept.tolist() == [0, 2, 4]
    assert set(found.dropped) == set("bdfgh")
    assert found.coefficients[found.kept] == pytest.approx(
        np.linalg.lstsq(X[:, found.kept], y, rcond=None)[0]
    )
    assert not found.coefficients[[1, 3, 5, 6, 7]].any()


def test_the_test_is_statsmodels_f_test_of_nested_models(sparse) -> None:
    X, y = sparse
    found = essential_parameters(X, y, "abcdefgh", len(X))
    whole, left = sm.OLS(y, X).fit(), sm.OLS(y, X[:, found.kept]).fit()
    assert found.p_value == pytest.approx(whole.compare_f_test(left)[1])
    assert found.relative_std[found.kept] == pytest.approx(left.bse / np.abs(left.params))


def test_the_first_to_go_has_the_largest_relative_error(sparse) -> None:
    X, y = sparse
    whole = sm.OLS(y, X).fit()
    worst = int(np.argmax(whole.bse / np.abs(whole.params)))
    assert essential_parameters(X, y, "abcdefgh", len(X)).dropped[0] == "abcdefgh"[worst]


def test_samples_that_repeat_each_other_prove_less(sparse) -> None:
    X, y = sparse
    y = X @ [3.0, 0.0, -1.0, 0.0, 0.25, 0.0, 0.0, 0.0] + (y - X @ np.linalg.lstsq(X, y)[0])
    all_independent = essential_parameters(X, y, "abcdefgh", len(X))
    a_tenth = essential_parameters(X, y, "abcdefgh", len(X) / 10)
    assert "e" not in all_independent.dropped
    assert "e" in a_tenth.dropped
