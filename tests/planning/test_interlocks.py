"""A plan that would trip its own interlocks is refused; what will watch is shown with it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hil.arms import load_arm
from hil.core.errors import PlanError, SpecError
from hil.dynamics import RobotModel
from hil.planning.checks import interlock_margins
from hil.planning.experiment import Experiment, mock_bench
from hil.planning.plan import Plan
from hil.workflow.preview import preview_experiment
from tests.support.plan_parts import plan_of, spec_of

TIP_M = 0.12


@cache
def usual_plan() -> Plan:
    return plan_of()


def flange_heights(plan: Plan) -> tuple[float, float]:
    """Lowest flange and lowest tip over all set-points [m], by Pinocchio."""
    q = np.concatenate([motion.sample(125.0).q for motion in plan.motions])
    poses = RobotModel.from_arm("ur5").flange_pose(q)
    return float(poses[:, 2, 3].min()), float((poses[:, 2, 3] + TIP_M * poses[:, 2, 2]).min())


@pytest.mark.thorough
def test_the_margin_to_the_workspace_is_the_least_over_every_set_point() -> None:
    entry = {"kind": "workspace", "min_m": [-2, -2, -1]}
    loads = [{"mass_kg": 1.0, "com_m": [0, 0, 0.05], "size_m": [TIP_M, 0.03]}]
    plan = plan_of(interlocks=[entry], loads=loads)
    assert plan.margins["workspace_m"] == pytest.approx(1.0 + min(flange_heights(plan)), abs=1e-6)


@pytest.mark.thorough
def test_a_plan_without_a_workspace_has_no_margin_to_it() -> None:
    assert "workspace_m" not in usual_plan().margins


def test_a_motion_outside_the_workspace_is_refused_with_step_and_by_how_much() -> None:
    """Whatever an excitation did: plug-ins draw their own motions."""
    plan = usual_plan()
    height, _ = flange_heights(plan)
    spec = spec_of(interlocks=[{"kind": "workspace", "min_m": [-2, -2, height + 0.0123]}])
    with pytest.raises(PlanError, match=r"\(workspace\): step \d+ \((move|dwell)\) ") as caught:
        interlock_margins(spec.interlocks, load_arm("ur5"), [], plan.steps, 125.0, 0.02)
    assert "flange 12.3 mm beyond z of min_m" in caught.value.message


@pytest.mark.thorough
def test_a_plan_that_comes_closer_than_the_clearance_interlock_allows_is_refused() -> None:
    closest = usual_plan().margins["clearance_m"]
    plan_of(interlocks=[{"kind": "clearance", "least_m": closest - 0.001}])
    with pytest.raises(PlanError, match="smallest distance of the plan to an obstacle"):
        plan_of(interlocks=[{"kind": "clearance", "least_m": closest + 0.001}])


def experiment(**changes: object) -> Experiment:
    station = mock_bench()
    return Experiment(spec_of(**changes), station, station.robots["ur5"], "", "", "", Path())


@pytest.mark.thorough
def test_the_preview_shows_what_will_watch_and_what_will_not() -> None:
    entries = [{"kind": "temperature", "limit_c": 70, "action": "pause"}]
    plan, shown = preview_experiment(experiment(interlocks=entries))
    assert shown.hash == plan.hash
    watching = {one["name"]: one for one in shown.to_dict()["interlocks"]}
    assert watching["temperature"] == {"name": "temperature", "action": "pause", "limit": "70 °C"}
    assert watching["clearance"]["limit"] == "10 mm"
    assert watching["torque"]["limit"].endswith("N·m")
    assert watching["stale"]["limit"] == "0.5 s"
    assert watching["recorder"]["action"] == "off"
    assert "virtual clock" in watching["recorder"]["why"]


@pytest.mark.thorough
def test_an_interlock_that_cannot_be_judged_is_refused_with_the_preview() -> None:
    with pytest.raises((PlanError, SpecError), match="2 limits for 6 joints"):
        preview_experiment(experiment(interlocks=[{"kind": "current", "limit_a": [1, 2]}]))
