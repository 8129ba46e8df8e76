"""rigid-diffnea: its parts; links that can exist, whatever the data; the truth where they tell."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import rosen, rosen_der, rosen_hess

from hil.core.typing import FloatArray
from hil.data import Dataset
from hil.dynamics import base_parameters
from hil.dynamics.inertial import divergence, is_consistent
from hil.estimators import estimator
from hil.estimators.diffnea import Bodies, Local, Problem, RigidDiffnea, Unknowns, folding, minimise
from hil.estimators.diffnea_friction import FORMS, ArmMotion, BendingRows, sign_of, spread
from hil.estimators.friction_memory import Pieces, dahl_states
from hil.estimators.least_squares import JointwiseQR
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


@pytest.mark.thorough
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


@cache
def remembering() -> tuple[RigidDiffnea, Dataset]:
    """Friction that comes round over 5 mrad, fitted."""
    data = with_dahl(moving(1, 2, samples=400, noise_a=0.02))
    return RigidDiffnea(friction="memory").fit(data, nominal()), data


@pytest.mark.thorough
def test_reversals_with_memory_are_predicted_better_than_without() -> None:
    found, data = remembering()
    fresh = with_dahl(moving(4, samples=400))
    without = RigidDiffnea(friction="stribeck").fit(data, nominal())
    errors = [np.mean((m.predict(fresh).effort - fresh["effort"]) ** 2) for m in (found, without)]
    assert errors[0] < 0.2 * errors[1]


# Minimisation, divergence, coordinates, columns that bend

BENDING = [name for name, form in FORMS.items() if form.shapes]
BASE = base_parameters(nominal(), rotor=True)


def unknowns(law: str) -> Unknowns:
    form = FORMS[law]
    scale = np.linspace(0.5, 2.0, 6 * len(form.terms)).reshape(6, -1)
    return Unknowns(Bodies.nominal(nominal()), folding(BASE), form, scale)


def somewhere(sought: Unknowns, seed: int) -> FloatArray:
    return sought.start() + np.random.default_rng(seed).normal(0.0, 0.3, len(sought.start()))


def differences(function, u: FloatArray, step: float = 1e-6) -> FloatArray:
    """Central differences by every coordinate, last axis."""
    rows = [function(u + step * e) - function(u - step * e) for e in np.eye(len(u))]
    return np.moveaxis(np.array(rows), 0, -1) / (2 * step)


def arm_motion(samples: int = 200) -> ArmMotion:
    """Two series of random motion under random torques."""
    random = np.random.default_rng(3)
    qd, load = random.normal(0.0, 0.4, (samples, 6)), random.normal(0.0, 9.0, (samples, 6))
    series = (slice(0, samples // 2), slice(samples // 2, samples))
    return ArmMotion(qd, sign_of(qd, 0.01), load, 1e-3 * qd, series)


def regressor_and_target(samples: int = 200) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(4)
    return random.normal(size=(samples, 6, BASE.rank)), random.normal(size=(samples, 6))


def bending_rows(law: str) -> BendingRows:
    return BendingRows(*regressor_and_target(), arm_motion(), FORMS[law])


def test_a_valley_is_followed_to_its_minimum() -> None:
    def cost(u: FloatArray) -> Local:
        values, vectors = np.linalg.eigh(rosen_hess(u))
        curvature = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return Local(float(rosen(u)) + 1.0, rosen_der(u), curvature)

    found = minimise(cost, np.array([-1.2, 1.0, 0.5]))
    assert found.converged
    np.testing.assert_allclose(found.u, 1.0, atol=1e-4)


def test_steps_that_run_out_are_told() -> None:
    def cost(u: FloatArray) -> Local:
        return Local(float(rosen(u)), rosen_der(u), np.abs(rosen_hess(u)) + 10 * np.eye(2))

    assert not minimise(cost, np.array([-1.2, 1.0]), iterations=3).converged


def test_divergence_is_that_of_the_pseudo_inertias_and_rotors() -> None:
    bodies = Bodies.nominal(nominal())
    u = bodies.start + np.random.default_rng(1).normal(0.0, 0.4, 66)
    now, then = (bodies.parameters(v) for v in (u, bodies.start))
    of_links = divergence(now[:60].reshape(6, 10), then[:60].reshape(6, 10)).sum()
    ratio = now[60:] / then[60:]
    expected = of_links + np.sum(ratio - np.log(ratio) - 1.0)
    assert bodies.divergence(u).cost == pytest.approx(expected)


@pytest.mark.parametrize("law", FORMS)
def test_divergence_gradient_is_what_differences_give(law: str) -> None:
    sought = unknowns(law)
    u = somewhere(sought, 2)
    found = differences(lambda v: np.array(sought.divergence(v).cost), u)
    np.testing.assert_allclose(sought.divergence(u).gradient, found, rtol=1e-5, atol=1e-5)


def test_divergence_curvature_is_exact_at_the_nominal_arm() -> None:
    bodies = Bodies.nominal(nominal())
    found = differences(lambda v: bodies.divergence(v).gradient, bodies.start, 1e-5)
    expected = bodies.divergence(bodies.start).curvature
    np.testing.assert_allclose(expected, found, rtol=1e-4, atol=1e-3 * np.abs(found).max())


@pytest.mark.parametrize("law", FORMS)
def test_values_change_with_coordinates_as_differences_say(law: str) -> None:
    sought = unknowns(law)
    u = somewhere(sought, 4)
    slope = sought.at(u)[1]
    np.testing.assert_allclose(
        slope, differences(lambda v: sought.at(v)[0], u), rtol=1e-5, atol=1e-6 * np.abs(slope).max()
    )


@pytest.mark.parametrize("law", BENDING)
def test_columns_bend_with_shapes_as_differences_say(law: str) -> None:
    form, motion = FORMS[law], arm_motion().joint(2)
    shapes = np.array([shape.start for shape in form.shapes])
    found = differences(lambda logs: form.columns(motion, np.exp(logs))[0], np.log(shapes))
    slope = form.columns(motion, shapes)[1] * shapes
    np.testing.assert_allclose(slope, found, atol=1e-7)


@pytest.mark.parametrize("law", FORMS)
def test_cost_gradient_is_what_differences_give(law: str) -> None:
    sought = unknowns(law)
    cost = Problem(sought, np.linspace(0.5, 1.5, 6), 2.0).bending_cost(bending_rows(law))
    u = somewhere(sought, 5)
    for seed in range(8):
        way = 1e-5 * np.random.default_rng(seed).normal(size=len(u))
        rise = 0.5 * (cost(u + way).cost - cost(u - way).cost)
        assert rise == pytest.approx(float(cost(u).gradient @ way), rel=1e-5, abs=1e-6)


def test_bending_rows_are_the_rows_themselves_compressed() -> None:
    sought, rows = unknowns("memory"), bending_rows("memory")
    values = sought.at(somewhere(sought, 6))[0]
    Y, target = regressor_and_target()
    C, _ = FORMS["memory"].evaluate(arm_motion(), values[-18:].reshape(6, 3))
    whole = JointwiseQR(6)
    whole.add(np.hstack([Y.reshape(1200, -1), spread(C)]), target)
    sigma = whole.residual_std(values[: sought.linear])
    degrees = 200 / (200 - sought.linear / 6)
    np.testing.assert_allclose(rows.deviation(values) * np.sqrt(degrees), sigma, rtol=1e-6)


@pytest.mark.parametrize("length", [3e-5, 1e-3, 1.0])
def test_state_piece_by_piece_is_the_state_sample_by_sample(length: float) -> None:
    random = np.random.default_rng(8)
    steps = 1e-3 * random.normal(size=400).cumsum() * (random.random(400) < 0.7)
    pieces = Pieces.of(steps, (slice(0, 150), slice(150, 400)))
    state = pieces.state(length)[0]
    whole = np.array([length])
    for rows in (slice(0, 150), slice(150, 400)):
        theirs = dahl_states(steps[rows, None], whole)
        np.testing.assert_allclose(state[rows], theirs[:, 0], atol=1e-12)
    np.testing.assert_array_equal(pieces.every(3).state(length)[0], state[::3])


def test_memory_starts_afresh_with_every_series() -> None:
    whole = arm_motion()
    half = slice(100, 200)
    alone = ArmMotion(
        whole.qd[half], whole.sign[half], whole.transmitted[half], whole.steps[half],
        (slice(0, 100),),
    )  # fmt: skip
    shapes = np.tile([2e-4, 0.1, 0.4], (6, 1))
    together, apart = (FORMS["memory"].evaluate(m, shapes)[0] for m in (whole, alone))
    np.testing.assert_allclose(together[half], apart, atol=1e-9)


def test_any_coordinates_are_links_that_can_exist_and_rotors_that_turn() -> None:
    bodies = Bodies.nominal(nominal())
    for seed in range(20):
        found = bodies.parameters(np.random.default_rng(seed).normal(0.0, 2.0, 66))
        assert np.all(is_consistent(found[:60].reshape(6, 10)))
        assert np.all(found[60:] > 0)


def test_coordinates_start_at_the_nominal_links() -> None:
    bodies = Bodies.nominal(nominal())
    np.testing.assert_allclose(
        bodies.parameters(bodies.start)[:60], nominal().parameters(rotor=False), atol=1e-9
    )
