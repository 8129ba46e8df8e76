"""Loads from motion: MuJoCo's torques, friction that depends on the load, a convex peer."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError, FitError, SpecError
from hil.data import Conditions, Dataset
from hil.dynamics import payload_parameters
from hil.dynamics.inertial import is_consistent, pseudo_inertia
from hil.estimators.payload import (
    central,
    central_jacobian,
    estimate_payload,
    nearest_body,
    payload_halves,
    payload_of,
    true_values,
    with_identified,
)
from hil.estimators.rigid_linear import RigidWls
from tests.support.dynamics_arms import mjcf, mujoco_torques
from tests.support.load_parts import OFF_AXIS, recorded
from tests.support.synthetic_motion import (
    COULOMB,
    GAINS,
    LOAD,
    ROTORS,
    VISCOUS,
    fourier,
    moving,
    nominal,
    plant,
)

NOISE_A = 0.02
SHARE = 0.07


class GrowingFriction(RigidWls):
    """Knows that Coulomb friction grows by a share of the rigid torque, the load's included."""

    def predict(self, dataset):
        found = super().predict(dataset)
        parts = dict(found.components)
        rigid = sum(parts[name] for name in ("gravity", "inertia", "payload"))
        parts["friction"] = parts["friction"] + grown(rigid, dataset["qd_f"])
        return replace(found, effort=sum(parts.values()), components=parts)


def grown(rigid, qd):
    return SHARE * np.abs(rigid) * np.tanh(qd / 0.01)


def bare(kind=RigidWls):
    return kind().fit(moving(1, 2, 3, noise_a=NOISE_A), nominal())


@cache
def model() -> RigidWls:
    return bare()


def under_load(*seeds, load=LOAD, noise_a=NOISE_A) -> Dataset:
    """Recordings with the load mounted, which nobody declared."""
    data = moving(*seeds, noise_a=noise_a, load=load)
    conditions = tuple(replace(c, payload=Payload()) for c in data.conditions)
    return replace(data, conditions=conditions)


def test_a_load_in_mujoco_is_found() -> None:
    mujoco = pytest.importorskip("mujoco")
    t, q, qd, qdd = fourier(5, 500)
    peer = mujoco.MjModel.from_xml_string(mjcf("ur5", ROTORS, LOAD))
    effort = (
        mujoco_torques(peer, q, qd, qdd) + COULOMB * np.tanh(qd / 0.01) + VISCOUS * qd
    ) / GAINS
    data = under_load(5)
    columns = {"t": t, "q": q, "qd": qd, "effort": effort}
    columns |= {"q_f": q, "qd_f": qd, "qdd_f": qdd, "effort_f": effort}
    data = Dataset(
        "ur5", data.joint_names, "current", columns, np.array([0, 500]),
        (Conditions("loaded", "trajectory"),), GAINS,
    )  # fmt: skip
    exact = RigidWls().fit(moving(1, 2, 3), nominal())
    found = estimate_payload(exact, data, friction="offset")
    assert found.values == pytest.approx(true_values(LOAD), abs=1e-6)
    assert found.correction.offset == pytest.approx(
        -np.array([0.3, -0.2, 0.1, 0.05, -0.05, 0.02]) / GAINS
    )


def test_what_the_motion_tells_is_called_determined() -> None:
    found = estimate_payload(model(), under_load(5, 6, 7))
    assert np.all(np.abs(found.values - true_values(LOAD)) < 4 * found.std_error)
    known = [name for name, told in found.determined.items() if told]
    assert known == ["mass", "com_x", "com_y", "com_z"]


def test_friction_that_grows_with_the_load_is_asked_of_the_model() -> None:
    data = under_load(5)
    motion = tuple(data[name] for name in ("q", "qd", "qdd_f"))
    more = grown(plant().with_payload(LOAD).inverse_dynamics(*motion) / GAINS, data["qd"])
    data = data.with_columns(effort=data["effort"] + more, effort_f=data["effort"] + more)
    knowing, plain = bare(GrowingFriction), model()
    found = estimate_payload(knowing, data)
    assert found.payload.mass == pytest.approx(LOAD.mass, rel=0.005)
    assert found.payload.com == pytest.approx(LOAD.com, abs=2e-3)
    assert np.mean(estimate_payload(plain, data, friction="model").residual) > 3 * np.mean(
        found.residual
    )


def test_an_offset_of_another_day_can_be_freed() -> None:
    data = under_load(5, 6)
    shift = np.array([0.2, 0.5, -0.4, 0.2, 0.1, -0.1])
    moved = data.with_columns(effort=data["effort"] + shift, effort_f=data["effort_f"] + shift)
    freed = estimate_payload(model(), moved, friction="offset")
    assert freed.payload.mass == pytest.approx(LOAD.mass, rel=0.01)
    assert freed.correction.offset == pytest.approx(shift, abs=0.02)
    kept = estimate_payload(model(), moved, friction="model")
    assert abs(kept.payload.com[0] - LOAD.com[0]) > 3 * abs(freed.payload.com[0] - LOAD.com[0])


def test_a_recording_frees_no_more_than_it_needs() -> None:
    data = under_load(5)
    shifted = {name: data[name] + 0.3 for name in ("effort", "effort_f")}
    assert estimate_payload(model(), data).friction == "model"
    assert estimate_payload(model(), data.with_columns(**shifted)).friction == "offset"


def test_warmer_friction_can_be_freed() -> None:
    data = under_load(5)
    friction = (COULOMB * np.tanh(data["qd"] / 0.01) + VISCOUS * data["qd"]) / GAINS
    colder = data["effort"] + 0.3 * friction
    found = estimate_payload(model(), data.with_columns(effort=colder, effort_f=colder))
    assert found.friction == "scale"
    assert found.correction.scale == pytest.approx(0.3, abs=0.05)
    assert found.payload.mass == pytest.approx(LOAD.mass, rel=0.01)


@pytest.mark.thorough
def test_a_load_settles_however_wrong_the_gains_are() -> None:
    arm = RigidWls().fit(recorded(105, 1, 2, 3), nominal())
    found = estimate_payload(arm, recorded(105, 7, 8, load=OFF_AXIS[1]), friction="model")
    assert found.payload.mass == pytest.approx(3.0, rel=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("joint", [1, 2, 4])
def test_a_load_is_as_much_too_light_as_gains_say(joint: int) -> None:
    wide = replace(LOAD, inertia=(0.05, 0.06, 0.04, 0.0, 0.0, 0.0))  # no limit of bodies is near
    data, arm = under_load(5, 6, load=wide), moving(5, 6, noise_a=NOISE_A)
    larger = np.where(np.arange(6) == joint, 1.002, 1.0)
    effort = arm["effort"] + (data["effort"] - arm["effort"]) / larger
    short = data.with_columns(effort=effort, effort_f=effort)
    true, found = (estimate_payload(model(), one, friction="model") for one in (data, short))
    told = 0.002 * found.by_gain[:, joint]
    assert true.values - found.values == pytest.approx(told, rel=0.03, abs=3e-5)
    assert np.max(np.abs(told[:4])) > 1e-4


@pytest.mark.thorough
def test_a_load_that_cannot_be_told_is_still_a_body() -> None:
    small = Payload(0.3, (0.0, 0.0, 0.02), (1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0))
    found = [estimate_payload(model(), under_load(s, load=small, noise_a=0.3)) for s in (5, 6, 7)]
    assert any(one.bounded for one in found)
    assert all(is_consistent(payload_parameters(one.payload)) for one in found)


@pytest.mark.thorough
def test_rows_left_out_are_not_looked_at() -> None:
    data = under_load(5)
    first = np.arange(len(data)) < 300
    spoilt = {name: np.where(first[:, None], data[name], 9.9) for name in ("effort", "effort_f")}
    ours = estimate_payload(model(), data.with_columns(**spoilt), rows=first)
    assert ours.payload == estimate_payload(model(), data, rows=first).payload


@pytest.mark.thorough
def test_halves_are_tested_on_each_other() -> None:
    one, two = payload_halves(model(), under_load(5))
    assert (one.fitted, two.fitted) == ("first", "second")
    assert one.rmse_raw == pytest.approx(np.full(6, NOISE_A), rel=0.2)
    assert np.all(two.rmse_ignored[1:4] > 3 * two.rmse_raw[1:4])


@pytest.mark.thorough
def test_a_declared_load_does_not_count() -> None:
    declared = moving(5, noise_a=NOISE_A, load=LOAD)
    assert estimate_payload(model(), declared).payload == (
        estimate_payload(model(), under_load(5)).payload
    )


def test_a_recording_of_two_loads_is_refused() -> None:
    data = under_load(5, 6)
    first, second = data.conditions
    mixed = replace(data, conditions=(first, replace(second, load=1, payload=LOAD)))
    with pytest.raises(DataError, match="2 loads"):
        estimate_payload(model(), mixed)


def test_an_identified_load_is_what_a_model_predicts_with() -> None:
    data = under_load(5)
    found = estimate_payload(model(), data).payload
    error = model().predict(with_identified(data, found)).effort - data["effort"]
    assert np.sqrt(np.mean(error**2)) < 1.1 * NOISE_A


def test_what_cannot_tell_a_load_is_refused() -> None:
    data = under_load(5)
    with pytest.raises(FitError, match="50 rows are too few"):
        estimate_payload(model(), data, rows=np.arange(len(data)) < 50)
    with pytest.raises(SpecError, match="friction is 'free'"):
        estimate_payload(model(), data, friction="free")  # type: ignore[arg-type]
    with pytest.raises(DataError, match="predicts a current"):
        estimate_payload(model(), moving(5, kind="torque"))


def test_the_load_of_parameters_is_the_load_they_came_from() -> None:
    again = payload_of(payload_parameters(LOAD))
    assert (again.mass, *again.com) == pytest.approx((LOAD.mass, *LOAD.com))
    assert again.inertia == pytest.approx(LOAD.inertia)


def test_errors_of_centre_and_inertia_follow_by_the_chain_rule() -> None:
    parameters = payload_parameters(replace(LOAD, inertia=(0.01, 0.02, 0.015, 1e-3, -2e-3, 5e-4)))
    h = 1e-6

    def values(p):
        mass, com, inertia = central(p)
        return np.array([mass, *com, *inertia])

    differences = [
        (values(parameters + h * unit) - values(parameters - h * unit)) / (2 * h)
        for unit in np.eye(10)
    ]
    assert central_jacobian(parameters) == pytest.approx(np.transpose(differences), abs=1e-8)


@pytest.mark.parametrize("spread", [0.0, 1.5], ids=["alike", "columns-of-all-sizes"])
@pytest.mark.parametrize("seed", range(4))
def test_the_nearest_body_is_that_of_a_semidefinite_program(seed: int, spread: float) -> None:
    cp = pytest.importorskip("cvxpy")
    random = np.random.default_rng(seed)
    truth = payload_parameters(LOAD)
    X = random.normal(size=(30, 10)) * 10 ** random.uniform(-spread, spread, 10)
    y = X @ (truth * np.where(np.arange(10) < 4, 1.0, -1.0))
    ours = nearest_body(X, y)
    J = cp.Variable((4, 4), PSD=True)
    trace = cp.trace(J[:3, :3])
    phi = cp.hstack([
        J[3, 3], J[3, 0], J[3, 1], J[3, 2], trace - J[0, 0], -J[0, 1], trace - J[1, 1],
        -J[0, 2], -J[1, 2], trace - J[2, 2],
    ])  # fmt: skip
    peer = cp.Problem(cp.Minimize(cp.sum_squares(X @ phi - y)))
    peer.solve(solver=cp.CLARABEL)
    assert np.sum((X @ ours - y) ** 2) == pytest.approx(peer.value, rel=1e-3)
    assert np.linalg.eigvalsh(pseudo_inertia(ours))[0] > 0


def test_errors_of_gains_widen_the_intervals_that_know_of_them() -> None:
    found = estimate_payload(model(), under_load(5, 6, 7))
    aware, in_torques = found.with_gains(0.05), replace(found, unit="N·m").with_gains(0.05)
    alone = 0.05 * np.sqrt(np.sum(found.by_gain**2, axis=1))
    assert aware.std_error == pytest.approx(np.hypot(found.std_error, alone))
    assert np.all(np.diff(aware.interval) > np.diff(found.interval))
    assert aware.values is found.values
    assert in_torques.interval == pytest.approx(found.interval)
