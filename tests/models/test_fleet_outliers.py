"""Who stands out of a fleet: at the stated rate among equals, and who is really different."""

from __future__ import annotations

import numpy as np
import pytest

from hil.models.fleet_outliers import FAMILY_WISE, FEWEST, compare_robots, huber

YEARS, JOINTS = np.linspace(1.0, 10.0, 40), 6
TREND = np.array([0.02, 0.03, 0.0, 0.01, 0.02, 0.02])


def fleet(seed: int, spread: float = 0.03) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, spread, (len(YEARS), JOINTS))
    return np.exp(np.log(5.0) + YEARS[:, None] * TREND + noise)


def test_a_trend_with_age_is_found_and_explains_itself() -> None:
    found = compare_robots(fleet(1), {"age": YEARS})
    assert found is not None
    assert np.all(np.abs(found.slopes[0] - TREND) < 4 * found.errors[0])
    assert np.all(found.errors[0] < 0.005)
    assert not found.outlying.any()


def test_one_joint_with_more_friction_stands_out_and_nobody_else() -> None:
    values = fleet(2)
    values[17, 2] *= 1.3
    found = compare_robots(values, {"age": YEARS})
    assert found is not None
    assert [tuple(at) for at in np.argwhere(found.outlying)] == [(17, 2)]
    assert found.expected[17, 2] == pytest.approx(5.0, rel=0.05)


@pytest.mark.thorough
def test_equals_stand_out_in_as_many_fleets_as_is_said() -> None:
    alarms = 0
    for seed in range(200):
        found = compare_robots(fleet(1000 + seed)[:12], {"age": YEARS[:12]})
        assert found is not None
        alarms += bool(found.outlying.any())
    # 200 fleets at 1 %: 2 are expected, 8 or more in one of 900 such tests
    assert 200 * FAMILY_WISE == 2
    assert alarms < 8


def test_three_wrong_robots_of_twelve_do_not_hide_one_another() -> None:
    values = fleet(3)[:12] / np.exp(YEARS[:12, None] * TREND)
    values[:3, 0] *= 2.0
    found = compare_robots(values, {})
    assert found is not None
    assert set(np.flatnonzero(found.outlying[:, 0])) == {0, 1, 2}


def test_of_few_robots_or_none_with_a_model_nothing_is_said() -> None:
    assert compare_robots(fleet(4)[: FEWEST - 1], {"age": YEARS[: FEWEST - 1]}) is None
    assert compare_robots(np.empty((40, 0)), {"age": YEARS}) is None


def test_who_does_not_tell_its_age_is_left_out_and_the_others_still_explained() -> None:
    values, age = fleet(5), YEARS.copy()
    age[3] = np.nan
    values[7, 1] = np.nan
    found = compare_robots(values, {"age": age, "same": np.ones(len(age))})
    assert found is not None
    assert (found.names, found.left_out, found.unused) == (("age",), {"age": (3,)}, ())
    assert np.isnan(found.z[[3, 7]]).all()
    assert np.isfinite(np.delete(found.z, [3, 7], axis=0)).all()


def test_what_few_tell_explains_nothing_and_leaves_nobody_out() -> None:
    age = np.where(np.arange(len(YEARS)) < 15, YEARS, np.nan)
    found = compare_robots(fleet(5), {"age": age, "temperature": np.full(age.shape, np.nan)})
    assert found is not None
    assert (found.names, found.left_out, found.unused) == ((), {}, ("age",))
    assert np.isfinite(found.z).all()


@pytest.mark.thorough
def test_the_limit_is_crossed_by_one_fleet_of_a_hundred() -> None:
    found = compare_robots(fleet(1), {})
    assert found is not None
    dice, columns = np.random.default_rng(9), np.ones((len(YEARS), 1))
    noise = dice.standard_normal((len(YEARS), 4000 * JOINTS))
    beta, scale = huber(columns, noise)
    largest = np.max(np.abs(noise - beta) / scale, axis=0).reshape(4000, JOINTS).max(axis=1)
    # at 1 %, and with a limit that was itself simulated with 1500 fleets
    assert 0.004 < np.mean(largest > found.limit) < 0.02


def test_robust_regression_is_that_of_statsmodels() -> None:
    statsmodels = pytest.importorskip("statsmodels.api")
    y = np.log(fleet(6)[:, 0])
    y[5] += 1.0
    X = np.column_stack([np.ones(len(y)), YEARS])
    beta, scale = huber(X, y[:, None])
    peer = statsmodels.RLM(y, X, M=statsmodels.robust.norms.HuberT(1.345)).fit(maxiter=200)
    assert beta[:, 0] == pytest.approx(peer.params, rel=1e-3, abs=1e-4)
    assert scale[0] == pytest.approx(peer.scale, rel=0.05)
