"""Weighing by generalised least squares, against simulated friction and gain errors."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.typing import FloatArray
from hil.dynamics import RobotModel
from hil.dynamics.weighing import GAIN_SHARE, Balance, static_columns, static_parameters

POSES = np.radians([[42, -31, 8, -106, 94, -139], [-150, -76, 63, -36, -77, 55]])
LOAD = Payload(3.0, (0.02, -0.01, 0.05))
FRICTION = np.tile([0.4, 0.5, 0.3, 0.08, 0.08, 0.07], (2, 1))


@cache
def model() -> RobotModel:
    return RobotModel.from_arm("ur5")


def torques(load: Payload) -> FloatArray:
    return np.asarray(model().with_payload(load).gravity(POSES) - model().gravity(POSES))


def balance(**changes: object) -> Balance:
    facts = {
        "columns": static_columns(model(), POSES),
        "torque": torques(LOAD),
        "deviation": FRICTION,
        "com": LOAD.com,
    }
    return Balance(**(facts | changes))  # type: ignore[arg-type]


def test_columns_and_parameters_give_the_torques_of_a_load() -> None:
    columns = static_columns(model(), POSES)
    np.testing.assert_allclose(columns @ static_parameters(LOAD), torques(LOAD), atol=1e-9)


def test_a_lighter_load_with_the_same_centre_is_lighter_and_nothing_else() -> None:
    light = Payload(1.0, LOAD.com)
    found = balance().weigh(torques(light) - torques(LOAD))
    assert found.mass == pytest.approx(-2.0)
    assert found.free_mass == pytest.approx(-2.0)
    np.testing.assert_allclose(found.moment, 0.0, atol=1e-9)


def test_a_shifted_centre_is_a_moment_and_no_mass() -> None:
    shifted = Payload(3.0, (-0.02, 0.01, 0.05))
    found = balance().weigh(torques(shifted) - torques(LOAD))
    np.testing.assert_allclose(found.moment, [3 * -0.04, 3 * 0.02, 0.0], atol=1e-9)
    assert found.free_mass == pytest.approx(0.0, abs=1e-9)
    assert found.moment_deviation < 0.02


@pytest.mark.thorough
def test_errors_are_as_large_as_stated() -> None:
    """1000 weighings of the right load; χ² quantiles bound what may come of it."""
    rng = np.random.default_rng(11)
    mass, free, moment = [], [], []
    for _ in range(1000):
        gains = GAIN_SHARE * rng.standard_normal(6)
        surplus = gains * torques(LOAD) + FRICTION * rng.standard_normal(FRICTION.shape)
        found = balance().weigh(surplus)
        mass.append(found.mass / found.mass_deviation)
        free.append(found.free_mass / found.free_mass_deviation)
        moment.append((np.linalg.norm(found.moment) / found.moment_deviation) ** 2)
    assert np.mean(np.square(mass)) == pytest.approx(1.0, abs=0.15)
    assert np.mean(np.square(free)) == pytest.approx(1.0, abs=0.15)
    assert np.mean(moment) == pytest.approx(3.0, abs=0.3)


def test_a_wrong_gain_counts_for_less_than_an_error_that_no_gain_explains() -> None:
    same_size = np.zeros((2, 6))
    same_size[:, 1] = 0.1 * np.linalg.norm(torques(LOAD)[:, 1]) * np.array([0.0, 1.0])
    gain = np.zeros((2, 6))
    gain[:, 1] = 0.1 * torques(LOAD)[:, 1]
    assert np.linalg.norm(gain) == pytest.approx(np.linalg.norm(same_size))
    significance = [
        np.linalg.norm(found.moment) / found.moment_deviation
        for found in (balance().weigh(gain), balance().weigh(same_size))
    ]
    assert significance[0] < significance[1]


def test_what_a_single_pose_does_not_show_is_not_made_up() -> None:
    one = Balance(static_columns(model(), POSES[:1]), torques(LOAD)[:1], FRICTION[:1], LOAD.com)
    down = -model().flange_pose(POSES[:1])[0, 2, :3]
    shifted = Payload(3.0, tuple(np.array(LOAD.com) + 0.1 * down))
    found = one.weigh(torques(shifted)[:1] - torques(LOAD)[:1])
    np.testing.assert_allclose(found.moment, 0.0, atol=1e-6)
    assert np.isfinite(found.mass_deviation)


def test_without_a_surplus_nothing_is_found() -> None:
    found = balance().weigh(np.zeros((2, 6)))
    assert found.mass == 0.0
    assert np.isinf(found.moment_deviation)
