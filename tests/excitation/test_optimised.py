"""Optimised trajectories of a spec for a real arm on a table: within all limits, complementary."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from hil.arms import load_arm
from hil.core.errors import PlanError
from hil.dynamics.build import model_from_arm
from hil.excitation.motion import FourierSeries
from hil.planning.plan import Plan
from hil.planning.workspace import workspace_of
from hil.spec.experiment import ExperimentSpec
from tests.support.plan_parts import plan_of, ur5

ARM = load_arm("ur5")
ASKED = {"kind": "fourier", "trajectories": 2, "harmonics": 2, "fundamental_hz": 0.2}
LOAD_KG = 4.0
LOAD = {"mass_kg": LOAD_KG}
TORQUE = 0.4


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> Plan:
    asked = {"starts": 1, "torque_percent": 100 * TORQUE}
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("HIL_CACHE", str(tmp_path_factory.mktemp("cache")))
        return plan_of(excitation=ASKED | {"optimise": asked}, loads=[LOAD])


def series_of(plan: Plan) -> list[FourierSeries]:
    return [motion for motion in plan.motions if isinstance(motion, FourierSeries)]


@pytest.mark.thorough
def test_limits_and_clearance_hold_on_a_grid_ten_times_denser(plan: Plan) -> None:
    spec = ExperimentSpec.model_validate(
        {
            "hil": 1,
            "name": "x",
            "robot": "ur5",
            "excitation": ASKED,
            "loads": [{"mass_kg": LOAD_KG}],
        }
    )
    workspace = workspace_of(spec, ur5(), ARM, plan.rate_hz)
    for series in series_of(plan):
        dense = series.sample(10 * plan.rate_hz)
        assert np.abs(dense.qd).max() <= np.radians(100) + 1e-9
        assert np.abs(dense.qdd).max() <= np.radians(300) + 1e-9
        assert np.all((dense.q >= ARM.excite_min - 1e-9) & (dense.q <= ARM.excite_max + 1e-9))
        assert workspace.clearance(dense.q).min() >= workspace.clearance_m - 1e-5
        assert np.abs(dense.qd[-1]).max() < 1e-9
        assert np.abs(dense.qdd[-1]).max() < 1e-9


def test_torques_with_the_load_stay_below_their_share(plan: Plan) -> None:
    model = model_from_arm(ARM)
    frame = model.frames[model.getFrameId("flange")]
    body = pin.Inertia(LOAD_KG, np.zeros(3), np.zeros((3, 3)))
    model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    data = model.createData()
    for series in series_of(plan):
        samples = series.sample(plan.rate_hz)
        rows = zip(samples.q, samples.qd, samples.qdd, strict=True)
        largest = np.max([np.abs(pin.rnea(model, data, *row)) for row in rows], axis=0)
        assert np.all(largest <= TORQUE * ARM.effort_max * (1 + 1e-3))


def test_the_second_complements_the_first(plan: Plan) -> None:
    first, second = series_of(plan)
    assert condition(first, second) < 0.8 * min(condition(first), condition(second))


def test_a_plan_holds_its_trajectories_and_needs_no_cache(
    plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HIL_CACHE", "off")
    assert series_of(Plan.from_dict(plan.to_dict())) == series_of(plan)


@pytest.mark.thorough
def test_what_cannot_be_done_names_the_trajectory_and_what_is_in_the_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HIL_CACHE", "off")
    hopeless = {"starts": 1, "budget_s": 0.1, "torque_percent": 1}
    with pytest.raises(PlanError, match=r"trajectory 1: .* N·m where 1.5 are allowed") as error:
        plan_of(excitation=ASKED | {"optimise": hopeless})
    assert error.value.hint


def condition(*motions: FourierSeries) -> float:
    """Of the raw regressor with rotor inertias: largest over smallest singular value above zero."""
    model = model_from_arm(ARM)
    data, rows = model.createData(), []
    for motion in motions:
        samples = motion.sample(20.0)
        for q, qd, qdd in zip(samples.q, samples.qd, samples.qdd, strict=True):
            body = pin.computeJointTorqueRegressor(model, data, q, qd, qdd)
            rows.append(np.hstack([body, np.diag(qdd)]))
    W = np.vstack(rows)
    lengths = np.linalg.norm(W, axis=0)
    values = np.linalg.svd(W / np.where(lengths > 0, lengths, 1.0), compute_uv=False)
    return float(values[0] / values[values > 1e-9 * values[0]][-1])
