"""Eq. 16 both ways, and a drive that bends, found from currents and predicted without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.data import Dataset
from hil.estimators.drive_curve import has_current, nearest_current
from hil.estimators.static_inverse import LINEAR, NO_GRAVITY, StaticInverse
from hil.estimators.static_linear import StaticLinear
from hil.evaluation import evaluate
from tests.support.synthetic_motion import (
    GAINS,
    K2,
    LOAD,
    OFFSET,
    bent_currents,
    dwelling,
    nominal,
    plant,
)


def bent(poses=150, *, noise_a=0.0, k2=K2, load=None, seed=0, stiction_nm=0.0) -> Dataset:
    """Dwells whose currents obey eq. 16."""
    straight = dwelling(poses, noise_a=0.0, load=load, seed=seed, stiction_nm=stiction_nm)
    currents = bent_currents(straight["effort"], k2)
    noise = noise_a * np.random.default_rng(seed).normal(size=currents.shape)
    return straight.with_columns(effort=currents + noise)


@pytest.fixture(scope="module")
def model() -> StaticInverse:
    return StaticInverse().fit(bent(noise_a=0.002), nominal())


def test_currents_are_the_inverse_of_torques() -> None:
    current = np.linspace(-9, 9, 37)[:, None]
    k1, k2, k0 = np.array([10.0, 8.0, 6.0]), np.array([-0.3, 0.0, 0.4]), np.array([0.5, -1.0, 0.0])
    torque = k2 * current * np.abs(current) + k1 * current + k0
    found = nearest_current(torque, k1, k2, k0)
    np.testing.assert_allclose(found, np.broadcast_to(current, (37, 3)))


def test_torques_beyond_the_turning_point_have_no_current() -> None:
    most = 10.0**2 / (4 * 0.5)
    torque = np.array([most - 1e-9, most + 1e-6, -most - 1.0])
    assert has_current(torque, 10.0, -0.5).tolist() == [True, False, False]
    assert nearest_current(torque, 10.0, -0.5) == pytest.approx([10.0, 10.0, -10.0], rel=1e-4)


def test_drive_constants_and_gravity_come_back_from_exact_data() -> None:
    found = StaticInverse(square="free").fit(bent(), nominal())
    k1, k2, k0 = found.constants_
    assert k1 == pytest.approx(GAINS)
    assert k2[1:4] == pytest.approx(K2[1:4], rel=1e-6)
    assert k0 == pytest.approx(-OFFSET, abs=1e-6)
    test = bent(30, seed=5)
    assert found.predict(test).effort == pytest.approx(test["effort"], abs=1e-6)


@pytest.mark.parametrize("form", ["paper", "shared"])
def test_new_poses_are_predicted_where_a_linear_model_fails(form) -> None:
    train, test = bent(60, noise_a=0.002), bent(20, seed=5)
    models = StaticInverse(form=form), StaticLinear(form=form)
    bends, straight = (
        np.sqrt(
            np.mean((m.fit(train, nominal()).predict(test).effort - test["effort"]) ** 2, axis=0)
        )
        for m in models
    )
    assert np.max(bends) < 0.002
    assert np.max(straight) > 0.05


def test_noise_does_not_pull_the_curve_as_it_does_with_the_current_among_the_inputs() -> None:
    squares, printed = [], []
    for seed in range(6):
        data = bent(80, seed=seed, stiction_nm=4.0)
        squares.append(StaticInverse(square="free").fit(data, nominal()).constants_[1][1])
        paper = StaticLinear(current_term=True).fit(data, nominal())
        at = paper.parameter_names_.index("shoulder_lift_joint.current_squared")
        printed.append(-paper.coefficients_[at])
    error = np.std(squares) / np.sqrt(len(squares))
    assert np.mean(squares) == pytest.approx(K2[1], abs=4 * error)
    assert np.abs(np.mean(printed) - K2[1]) > 8 * np.std(printed) / np.sqrt(len(printed))


@pytest.mark.thorough
def test_intervals_hold_the_true_constant_as_often_as_they_say() -> None:
    hits = []
    for seed in range(16):
        found = StaticInverse(square="free").fit(bent(80, seed=seed, stiction_nm=1.0), nominal())
        at = found.parameter_names_.index("shoulder_lift_joint.square")
        low, high = found.interval(0.8)[at]
        hits.append(low <= K2[1] <= high)
    assert 8 <= np.sum(hits) <= 15


def test_the_model_says_what_there_is_to_know_of_each_joint(model) -> None:
    words = model.fitted_facts()["joints"]
    assert words["shoulder_pan_joint"] == words["wrist_3_joint"] == NO_GRAVITY
    assert words["shoulder_lift_joint"] == ""
    linear = StaticInverse().fit(bent(noise_a=0.002, k2=np.zeros(6)), nominal())
    assert set(linear.joint_notes_[1:5]) == {LINEAR}
    assert not np.any(linear.constants_[1])


def test_joints_without_gravity_have_an_intercept_only(model) -> None:
    effort = model.predict(bent(40, seed=5)).effort
    assert np.ptp(effort[:, [0, 5]], axis=0) == pytest.approx([0, 0])
    assert effort[0, [0, 5]] == pytest.approx((OFFSET / GAINS)[[0, 5]], abs=0.001)


def test_parts_add_up_and_a_new_load_is_predicted(model) -> None:
    loaded = bent(20, load=LOAD, seed=3)
    prediction = model.predict(loaded)
    assert set(prediction.components) == {"gravity", "offset", "payload"}
    assert sum(prediction.components.values()) == pytest.approx(prediction.effort)
    assert prediction.effort == pytest.approx(loaded["effort"], abs=0.01)


def test_a_load_beyond_the_drive_is_not_valid(model) -> None:
    heavy = bent(20, seed=3)
    conditions = tuple(replace(c, payload=replace(LOAD, mass=400.0)) for c in heavy.conditions)
    prediction = model.predict(replace(heavy, conditions=conditions))
    assert np.all(np.isfinite(prediction.effort))
    assert not prediction.valid[:, 1].all()
    assert evaluate(model, heavy).coverage == 1.0


def test_without_gains_the_curve_is_in_amperes_and_predicts_the_same(model) -> None:
    plain = StaticInverse().fit(replace(bent(noise_a=0.002), drive_gains=None), nominal())
    test = bent(10, seed=7)
    assert plain.constants_[1][1] == pytest.approx(K2[1] / GAINS[1], rel=0.02)
    assert plain.predict(test).effort == pytest.approx(model.predict(test).effort, abs=1e-6)


def test_the_currents_of_the_tests_obey_eq_16_and_bend_visibly() -> None:
    current, straight = bent(150)["effort"], dwelling(150, noise_a=0.0)["effort"]
    torque = K2 * current * np.abs(current) + GAINS * current
    assert torque / GAINS == pytest.approx(straight, abs=1e-9)
    largest = np.max(np.abs(plant().gravity(bent(150)["q"])), axis=0) / GAINS
    assert np.all(np.abs(K2 / GAINS * largest)[[1, 2]] > 0.02)
