"""rigid-diffnea: links that can exist, whatever the data; the truth where data tell it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.core.typing import FloatArray
from hil.data import Dataset
from hil.dynamics import base_parameters
from hil.dynamics.inertial import is_consistent
from hil.estimators import estimator
from hil.estimators.base import load_model_file
from hil.estimators.diffnea import RigidDiffnea
from hil.estimators.rigid_linear import RigidWls
from tests.support.synthetic_motion import (
    COULOMB,
    GAINS,
    LOAD,
    OFFSET,
    VISCOUS,
    moving,
    nominal,
    plant,
)

SEEDS = (1, 2, 3)


@cache
def noisy() -> Dataset:
    return moving(*SEEDS, noise_a=0.05)


@cache
def linear() -> RigidDiffnea:
    """Coulomb–viscous friction, as the tests' plant has it."""
    return RigidDiffnea(friction="coulomb-viscous").fit(noisy(), nominal())


@cache
def quiet() -> tuple[RigidDiffnea, RigidWls]:
    """Both estimators on data so good that hardly a bound is touched."""
    data = moving(*SEEDS, noise_a=0.002)
    ours = RigidDiffnea(friction="coulomb-viscous", prior=1e-3).fit(data, nominal())
    return ours, RigidWls().fit(data, nominal())


def links(model: RigidDiffnea) -> FloatArray:
    return model.inertial_[:60].reshape(6, 10)


def slow(data: Dataset, share: float) -> Dataset:
    """Hardly any motion: the same arm about its first pose, torques by its true dynamics."""
    q, qd, qdd = (data[name] * share for name in ("q", "qd", "qdd_f"))
    torque = plant().inverse_dynamics(q, qd, qdd)
    torque += COULOMB * np.tanh(qd / 0.01) + VISCOUS * qd + OFFSET
    current = torque / GAINS
    return data.with_columns(
        q=q, qd=qd, effort=current, q_f=q, qd_f=qd, qdd_f=qdd, effort_f=current
    )


def stribeck(data: Dataset, speed: float, exponent: float) -> Dataset:
    """The same motion with a peak of friction at low speed on top."""
    qd = data["qd_f"]
    peak = 0.5 * COULOMB * np.exp(-((np.abs(qd) / speed) ** exponent)) * np.tanh(qd / 0.01)
    effort = data["effort"] + peak / GAINS
    return data.with_columns(effort=effort, effort_f=effort)


def with_dahl(data: Dataset, length: float = 5e-3) -> Dataset:
    """The same motion with Coulomb friction that comes round over `length` [rad], by a loop."""
    state, friction = np.zeros(6), np.zeros_like(data["q"])
    for _, rows in data.slices():
        state = np.zeros(6)
        for k in range(rows.start + 1, rows.stop):
            step = data["q"][k] - data["q"][k - 1]
            sign = np.sign(step)
            state = sign + (state - sign) * np.exp(-np.abs(step) / length)
            friction[k] = state
    memoryless = np.tanh(data["qd_f"] / 0.01)
    effort = data["effort"] + COULOMB * (friction - memoryless) / GAINS
    return data.with_columns(effort=effort, effort_f=effort)


def test_exact_data_give_the_true_base_parameters() -> None:
    found = RigidDiffnea(friction="coulomb-viscous", prior=1e-5).fit(moving(*SEEDS), nominal())
    base = base_parameters(nominal(), rotor=True)
    truth = base.combine(plant().parameters(rotor=True))
    friction = np.stack([COULOMB, VISCOUS, OFFSET], axis=1).ravel()
    np.testing.assert_allclose(found.coefficients_[: base.rank], truth, atol=2e-3)
    np.testing.assert_allclose(found.coefficients_[base.rank :], friction, atol=5e-3)


def test_where_no_bound_is_touched_the_estimate_is_weighted_least_squares() -> None:
    ours, wls = quiet()
    away = (ours.coefficients_ - wls.coefficients_) / wls.std_error_
    assert np.max(np.abs(away)) < 0.7


def test_the_semidefinite_program_finds_the_same_torques() -> None:
    pytest.importorskip("cvxpy")
    lmi = estimator("rigid-lmi", weighted=True).fit(noisy(), nominal())
    theirs, ours = lmi.predict(noisy()).effort, linear().predict(noisy()).effort
    assert np.sqrt(np.mean((theirs - ours) ** 2)) < 0.15 * 0.05


def test_standard_errors_are_those_of_least_squares_where_no_bound_is_touched() -> None:
    ours, wls = quiet()
    ratio = ours.std_error_ / wls.std_error_
    assert np.all(ratio < 1.05)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)


def test_inertia_matrices_are_positive_definite_at_every_pose() -> None:
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 6))
    still = np.zeros_like(q)
    without = nominal().regressor(q, still, still) @ linear().inertial_
    columns = [
        nominal().regressor(q, still, still + unit) @ linear().inertial_ - without
        for unit in np.eye(6)
    ]
    M = np.stack([column.reshape(q.shape) for column in columns], axis=-1)
    assert np.min(np.linalg.eigvalsh(0.5 * (M + M.transpose(0, 2, 1)))) > 0


def test_full_parameters_have_the_base_parameters_that_were_found() -> None:
    base = base_parameters(nominal(), rotor=True)
    folded = base.combine(linear().inertial_)
    np.testing.assert_allclose(folded, linear().coefficients_[: base.rank], rtol=1e-9, atol=1e-12)


def test_links_weigh_what_links_weigh() -> None:
    mass = nominal().parameters(rotor=False).reshape(6, 10)[:, 0]
    assert np.all(links(linear())[:, 0] < 4 * mass)


def test_poor_excitation_leaves_links_that_can_exist_and_a_note() -> None:
    still = slow(moving(4, samples=200), 2e-2)
    found = RigidDiffnea(friction="coulomb-viscous").fit(still, nominal())
    mass = nominal().parameters(rotor=False).reshape(6, 10)[:, 0]
    assert np.all(is_consistent(links(found)))
    assert np.all(links(found)[:, 0] < 10 * mass)
    assert "directions of the parameters" in found.notes_[-1]


def test_no_link_gets_heavier_than_allowed_whatever_the_data_say() -> None:
    carried = moving(*SEEDS, noise_a=0.05, load=replace(LOAD, mass=15.0))
    undeclared = tuple(replace(c, payload=type(LOAD)()) for c in carried.conditions)
    found = RigidDiffnea(friction="coulomb-viscous", mass_factor=1.5).fit(
        replace(carried, conditions=undeclared), nominal()
    )
    mass = nominal().parameters(rotor=False).reshape(6, 10)[:, 0]
    assert np.all(links(found)[:, 0] <= 1.5 * np.maximum(mass, 0.1 * mass.sum()))


def test_a_load_nobody_declared_makes_the_last_link_heavier_not_impossible() -> None:
    carried = moving(*SEEDS, noise_a=0.05, load=LOAD)
    undeclared = tuple(replace(c, payload=type(LOAD)()) for c in carried.conditions)
    found = RigidDiffnea(friction="coulomb-viscous").fit(
        replace(carried, conditions=undeclared), nominal()
    )
    assert np.all(is_consistent(links(found)))
    assert links(found)[5, 0] > 1.0


def test_what_the_data_tell_does_not_depend_on_the_nominal_arm() -> None:
    heavier = RigidDiffnea(friction="coulomb-viscous").fit(
        noisy(), nominal().with_payload(replace(LOAD, mass=0.5))
    )
    away = heavier.predict(noisy()).effort - linear().predict(noisy()).effort
    assert np.sqrt(np.mean(away**2)) < 0.1 * 0.05


@pytest.mark.thorough
def test_currents_and_torques_give_the_same_parameters() -> None:
    torque = moving(*SEEDS, kind="torque")
    current = moving(*SEEDS)
    one, other = (
        RigidDiffnea(friction="coulomb-viscous").fit(d, nominal()) for d in (torque, current)
    )
    np.testing.assert_allclose(one.coefficients_, other.coefficients_, rtol=1e-6, atol=1e-6)


@pytest.mark.thorough
def test_stribeck_shapes_are_found() -> None:
    data = stribeck(moving(*SEEDS, noise_a=0.01), 0.08, 1.3)
    found = RigidDiffnea(friction="stribeck").fit(data, nominal())
    shapes = found.coefficients_[-12:].reshape(6, 2)
    np.testing.assert_allclose(shapes[:, 0], 0.08, rtol=0.1)
    np.testing.assert_allclose(shapes[:, 1], 1.3, rtol=0.15)


def test_a_peak_at_low_speed_is_fitted_down_to_the_noise() -> None:
    data = stribeck(noisy(), 0.08, 1.3)
    found = RigidDiffnea(friction="stribeck-power").fit(data, nominal())
    error = found.predict(data).effort - data["effort"]
    assert np.sqrt(np.mean(error**2)) < 1.03 * 0.05


def test_true_shapes_lie_within_three_standard_errors() -> None:
    data = stribeck(noisy(), 0.08, 1.3)
    found = RigidDiffnea(friction="stribeck").fit(data, nominal())
    truth = np.tile([0.08, 1.3], 6)
    away = (found.coefficients_[-12:] - truth) / found.std_error_[-12:]
    assert np.max(np.abs(away)) < 3.0


def test_friction_that_is_not_there_sits_at_its_bound_and_is_told() -> None:
    data = moving(*SEEDS)
    more = np.zeros(6)
    more[2] = VISCOUS[2] + 1.0
    effort = data["effort"] - data["qd_f"] * more / GAINS
    data = data.with_columns(effort=effort, effort_f=effort)
    found = RigidDiffnea(friction="coulomb-viscous").fit(data, nominal())
    assert "elbow_joint.viscous is at its bound 0" in found.notes_


def test_one_sample_at_a_time_is_predicted_alike() -> None:
    data = noisy().take([0])
    whole, stream = linear().predict(data).effort, linear().stream()
    motion = (data["q_f"], data["qd_f"], data["qdd_f"])
    for k in range(0, 50, 7):
        np.testing.assert_allclose(stream.step(*(m[k] for m in motion)), whole[k], atol=1e-9)


@cache
def remembering() -> tuple[RigidDiffnea, Dataset]:
    """Friction that comes round over 5 mrad, fitted."""
    data = with_dahl(moving(1, 2, noise_a=0.02))
    return RigidDiffnea(friction="memory").fit(data, nominal()), data


@pytest.mark.thorough
def test_friction_memory_is_carried_from_sample_to_sample() -> None:
    found, data = remembering()
    first = data.take([0])
    whole, stream = found.predict(first).effort, found.stream()
    motion = [first[name] for name in ("q_f", "qd_f", "qdd_f")]
    told = np.array([stream.step(*(m[k] for m in motion)) for k in range(len(first))])
    # The path is the integral of the velocity for the one, differences of positions for the other.
    assert np.sqrt(np.mean((told - whole) ** 2)) < 0.02


def test_friction_with_memory_survives_a_model_file(tmp_path) -> None:
    found, data = remembering()
    again = load_model_file(found.save(tmp_path / "model"))
    np.testing.assert_array_equal(again.predict(data).effort, found.predict(data).effort)


def test_reversals_with_memory_are_predicted_better_than_without() -> None:
    found, data = remembering()
    fresh = with_dahl(moving(4))
    without = RigidDiffnea(friction="stribeck").fit(data, nominal())
    errors = [np.mean((m.predict(fresh).effort - fresh["effort"]) ** 2) for m in (found, without)]
    assert errors[0] < 0.2 * errors[1]


def test_a_model_file_gives_back_predictions_and_inertial_parameters(tmp_path) -> None:
    data = stribeck(moving(1, noise_a=0.01), 0.08, 1.3)
    found = RigidDiffnea(friction="stribeck").fit(data, nominal())
    again = load_model_file(found.save(tmp_path / "model"))
    np.testing.assert_array_equal(again.predict(data).effort, found.predict(data).effort)
    np.testing.assert_array_equal(again.inertial_, found.inertial_)


@pytest.mark.thorough
def test_the_same_data_give_the_same_bytes() -> None:
    one, other = (RigidDiffnea().fit(moving(5, noise_a=0.05), nominal()) for _ in range(2))
    np.testing.assert_array_equal(one.coefficients_, other.coefficients_)
    np.testing.assert_array_equal(one.inertial_, other.inertial_)


def test_components_add_up_to_the_effort() -> None:
    found = linear().predict(noisy())
    np.testing.assert_allclose(sum(found.components.values()), found.effort, atol=1e-9)


def test_an_unknown_friction_law_is_refused() -> None:
    with pytest.raises(SpecError, match="friction is 'stribek'"):
        RigidDiffnea(friction="stribek")
