"""The parts of rigid-diffnea: minimisation, divergence, coordinates, bending columns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import rosen, rosen_der, rosen_hess

from hil.core.typing import FloatArray
from hil.dynamics import base_parameters
from hil.dynamics.inertial import divergence, is_consistent
from hil.estimators.diffnea import Bodies, Local, Problem, Unknowns, folding, minimise
from hil.estimators.diffnea_friction import FORMS, ArmMotion, BendingRows, sign_of, spread
from hil.estimators.friction_memory import Pieces, dahl_states
from hil.estimators.least_squares import JointwiseQR
from tests.support.synthetic_motion import nominal

BENDING = [name for name, form in FORMS.items() if form.shapes]
BASE = base_parameters(nominal(), rotor=True)


def unknowns(law: str) -> Unknowns:
    form = FORMS[law]
    scale = np.linspace(0.5, 2.0, 6 * len(form.terms)).reshape(6, -1)
    return Unknowns(Bodies.nominal(nominal()), folding(BASE), form, scale)


def somewhere(sought: Unknowns, seed: int) -> FloatArray:
    return sought.start() + np.random.default_rng(seed).normal(0.0, 0.3, len(sought.start()))


def numeric(function, u: FloatArray, step: float = 1e-6) -> FloatArray:
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
    found = numeric(lambda v: np.array(sought.divergence(v).cost), u)
    np.testing.assert_allclose(sought.divergence(u).gradient, found, rtol=1e-5, atol=1e-5)


def test_divergence_curvature_is_exact_at_the_nominal_arm() -> None:
    bodies = Bodies.nominal(nominal())
    found = numeric(lambda v: bodies.divergence(v).gradient, bodies.start, 1e-5)
    expected = bodies.divergence(bodies.start).curvature
    np.testing.assert_allclose(expected, found, rtol=1e-4, atol=1e-3 * np.abs(found).max())


@pytest.mark.parametrize("law", FORMS)
def test_values_change_with_coordinates_as_differences_say(law: str) -> None:
    sought = unknowns(law)
    u = somewhere(sought, 4)
    slope = sought.at(u)[1]
    np.testing.assert_allclose(
        slope, numeric(lambda v: sought.at(v)[0], u), rtol=1e-5, atol=1e-6 * np.abs(slope).max()
    )


@pytest.mark.parametrize("law", BENDING)
def test_columns_bend_with_shapes_as_differences_say(law: str) -> None:
    form, motion = FORMS[law], arm_motion().joint(2)
    shapes = np.array([shape.start for shape in form.shapes])
    found = numeric(lambda logs: form.columns(motion, np.exp(logs))[0], np.log(shapes))
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
