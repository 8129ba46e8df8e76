"""Plans of real arms: complete, clear at every sample, within limits, and the same every time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.arms import load_arm
from hil.core.errors import PlanError, SpecError
from hil.dynamics import CollisionModel, Environment, Plane, RobotModel
from hil.planning.build import build_plan
from hil.planning.plan import Plan, Step
from hil.planning.workspace import plannable_arm, roadmap_of, workspace_of
from tests.support.plan_parts import DEGREE, plan_of, samples_between, spec_of, ur5

FOURIER = {"kind": "fourier", "trajectories": 2}


@cache
def dwell_plan() -> Plan:
    """Twelve poses with warm-up and references."""
    return plan_of(
        excitation={"kind": "dwell", "waypoints": 12},
        warm_up={"duration_s": 10},
        reference={"every": 5},
    )


@cache
def fourier_plan() -> Plan:
    return plan_of(excitation=FOURIER)


def of_kind(plan: Plan, *kinds: str) -> list[Step]:
    return [step for step in plan if step.kind in kinds]


def everything(plan: Plan) -> np.ndarray:
    return np.concatenate([np.vstack([start, q]) for start, q in samples_between(plan)])


@pytest.mark.thorough
@pytest.mark.parametrize("plan_of_kind", [dwell_plan, fourier_plan])
def test_motions_are_connected_and_steps_numbered(plan_of_kind: Any) -> None:
    plan = plan_of_kind()
    assert [step.index for step in plan] == list(range(len(plan)))
    for before, after in pairwise(plan.motions):
        np.testing.assert_allclose(after.q_start, before.q_end, atol=1e-9)


def test_every_pose_is_dwelt_at_from_both_sides() -> None:
    dwells = [(step.pose, step.approach) for step in of_kind(dwell_plan(), "dwell")]
    assert sorted(dwells) == [(pose, sign) for pose in range(12) for sign in (-1, 1)]
    assert dwell_plan().waypoints == 12


def test_the_plan_declares_the_load_then_leaves_the_current_pose() -> None:
    start = np.array([0.3, -1.4, 0.5, -1.2, -1.0, 0.2])
    plan = build_plan(spec_of(), ur5(), start_q=start)
    assert [step.kind for step in plan][:2] == ["payload", "move"]
    np.testing.assert_array_equal(plan.q_start, start)


def test_warm_up_and_reference_are_on_by_default_and_can_be_off() -> None:
    assert spec_of(warm_up={}, reference={}).warm_up.duration_s == 60
    assert spec_of(warm_up={}, reference={}).reference.every == 50
    assert sum(s.motion.duration_s for s in of_kind(dwell_plan(), "warmup") if s.motion) >= 10
    assert len(of_kind(dwell_plan(), "reference")) == 2 * 4
    assert not of_kind(fourier_plan(), "warmup", "reference")


def test_reference_visits_return_to_the_same_pose() -> None:
    ends = {tuple(s.motion.q_end) for s in of_kind(dwell_plan(), "reference") if s.motion}
    first = next(s for s in of_kind(dwell_plan(), "dwell") if s.pose == 0)
    assert first.motion is not None
    assert ends == {tuple(first.motion.q_end)}


def test_a_reference_pose_of_the_spec_is_used() -> None:
    q_deg = [10, -80, 40, -60, -70, 5]
    plan = plan_of(reference={"every": 3, "q_deg": q_deg})
    (end,) = {tuple(s.motion.q_end) for s in of_kind(plan, "reference") if s.motion}
    np.testing.assert_allclose(end, np.radians(q_deg))


@pytest.mark.parametrize("plan_of_kind", [dwell_plan, fourier_plan])
def test_every_sample_is_as_clear_as_the_margin_says(plan_of_kind: Any) -> None:
    plan = plan_of_kind()
    distances = CollisionModel(load_arm("ur5"), Environment(table_z=0.0)).clearance(
        everything(plan)
    )
    assert distances.min() == pytest.approx(plan.margins["clearance_m"])
    assert distances.min() >= 0.02


@pytest.mark.parametrize(
    ("plan_of_kind", "speed", "acceleration"), [(dwell_plan, 60, 80), (fourier_plan, 100, 300)]
)
def test_margins_are_the_distances_to_the_limits(
    plan_of_kind: Any, speed: float, acceleration: float
) -> None:
    plan = plan_of_kind()
    assert all(margin >= 0 for margin in plan.margins.values())
    rate = plan.rate_hz * 10
    fine = [motion.sample(rate) for motion in plan.motions if motion.duration_s > 0]
    fastest = max(np.abs(np.diff(s.q, axis=0)).max() * rate for s in fine if len(s) > 1)
    hardest = max(np.abs(np.diff(s.qd, axis=0)).max() * rate for s in fine if len(s) > 1)
    for key, limit, peak in (
        ("velocity_rad_s", speed * DEGREE, fastest),
        ("acceleration_rad_s2", acceleration * DEGREE, hardest),
    ):
        assert peak <= limit + 1e-9
        assert plan.margins[key] == pytest.approx(limit - peak, abs=0.01 * limit)
    q = everything(plan)
    nearest = min((2 * np.pi - q).min(), (q + 2 * np.pi).min())
    assert plan.margins["position_rad"] == pytest.approx(nearest)


def test_the_condition_number_is_that_of_the_gravity_regressor_at_the_poses() -> None:
    dwells = [step.motion.q_end for step in of_kind(dwell_plan(), "dwell") if step.motion]
    W = RobotModel.from_arm("ur5").gravity_regressor(np.unique(dwells, axis=0))
    # Independent columns by elimination from the left, scaled to length 1.
    kept: list[int] = []
    for i in range(W.shape[1]):
        if np.linalg.matrix_rank(W[:, [*kept, i]], tol=1e-9) > len(kept):
            kept.append(i)
    scaled = W[:, kept] / np.linalg.norm(W[:, kept], axis=0)
    assert dwell_plan().condition_number == pytest.approx(np.linalg.cond(scaled), rel=1e-6)


def test_one_pose_determines_no_gravity_model() -> None:
    plan = plan_of(excitation={"kind": "dwell", "waypoints": 1})
    assert plan.condition_number == np.inf
    assert json.loads(json.dumps(plan.to_dict(), allow_nan=False))["condition_number"] is None
    assert Plan.from_dict(plan.to_dict()) == plan


@pytest.mark.parametrize("plan_of_kind", [dwell_plan, fourier_plan])
def test_a_plan_survives_json_with_its_hash(plan_of_kind: Any) -> None:
    plan = plan_of_kind()
    again = Plan.from_dict(json.loads(json.dumps(plan.to_dict())))
    assert again == plan
    assert again.hash == plan.hash


@pytest.mark.thorough
def test_the_same_spec_gives_the_same_plan_in_another_process() -> None:
    code = "from tests.support.plan_parts import plan_of; print(plan_of().hash)"
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == plan_of().hash


@pytest.mark.thorough
def test_the_seed_changes_the_hash_and_the_margins_do_not() -> None:
    other = plan_of(excitation={"kind": "dwell", "waypoints": 6, "seed": 8})
    assert other.hash != plan_of().hash
    raw = plan_of().to_dict()
    assert Plan.from_dict({**raw, "margins": {}, "condition_number": 1.0}).hash == plan_of().hash


LOADS = [
    {"mass_kg": 0},
    {"mass_kg": 2, "com_m": [0, 0, 0.06], "size_m": [0.2, 0.06], "prompt": "Mount 2 kg"},
]


@cache
def loaded_plan() -> Plan:
    return plan_of(loads=LOADS)


def test_each_load_is_declared_before_its_own_pass_of_the_same_poses() -> None:
    plan = loaded_plan()
    declared = of_kind(plan, "payload")
    assert [step.load for step in declared] == [0, 1]
    assert plan.loads[1].payload.mass == 2
    assert plan.loads[1].prompt == "Mount 2 kg"
    loads = [step.load for step in plan]
    assert loads == sorted(loads)
    first, second = (
        {(s.pose, s.motion) for s in of_kind(plan, "dwell") if s.load == load} for load in (0, 1)
    )
    assert first == second


def test_the_load_is_changed_where_the_next_pass_begins() -> None:
    plan = loaded_plan()
    change = of_kind(plan, "payload")[1].index
    before, after = plan.steps[change - 1].motion, plan.steps[change + 1].motion
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before.q_end, after.q_start)


def test_the_payloads_body_is_kept_clear_of_the_table() -> None:
    plan = loaded_plan()
    poses = RobotModel.from_arm("ur5").flange_pose(everything(plan))
    tip = poses[:, :3, 3] + 0.2 * poses[:, :3, 2]
    assert tip[:, 2].min() >= 0.06 + 0.02


LOW = "0, -90, 90, -90, -90, 0\n"
"""The flange points down at the table, 42 cm above it."""


def test_a_pose_that_only_the_payload_cannot_take_is_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(LOW, "utf-8")
    excitation = {"kind": "dwell", "file": str(tmp_path / "poses.csv")}
    assert plan_of(excitation=excitation).waypoints == 1
    with pytest.raises(SpecError, match=r"poses.csv:1: payload and table are in collision"):
        plan_of(
            excitation=excitation,
            loads=[{"mass_kg": 1, "com_m": [0, 0, 0.2], "size_m": [0.45, 0.02]}],
        )


WALL = {"name": "north wall", "point_m": [0.0, 0.3, 0.0], "normal": [0.0, -1.0, 0.0]}


def test_poses_and_ways_keep_clear_of_a_planted_wall() -> None:
    wall = Plane((0.0, 0.3, 0.0), (0.0, -1.0, 0.0))
    walled = CollisionModel(load_arm("ur5"), Environment(table_z=0.0, walls=(wall,)))
    plan = plan_of(ur5(walls=[WALL]), excitation={"kind": "dwell", "waypoints": 12})
    assert walled.clearance(everything(plan)).min() >= 0.02
    assert RobotModel.from_arm("ur5").flange_pose(everything(plan))[:, 1, 3].max() < 0.3
    assert walled.clearance(everything(dwell_plan())).min() < 0


def test_a_pose_in_a_planted_box_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(LOW, "utf-8")
    q = np.radians([[float(angle) for angle in LOW.split(",")]])
    x, y, z = RobotModel.from_arm("ur5").flange_pose(q)[0, :3, 3]
    box = {"name": "crate", "centre_m": [x, y, z], "size_m": [0.1, 0.1, 0.1]}
    with pytest.raises(SpecError, match="crate"):
        plan_of(ur5(boxes=[box]), excitation={"kind": "dwell", "file": str(tmp_path / "poses.csv")})


@pytest.mark.thorough
def test_surroundings_that_leave_no_room_are_refused() -> None:
    with pytest.raises(PlanError, match=r"only \d+ of \d+ well-spread poses keep 20 mm"):
        plan_of(ur5(boxes=[{"centre_m": [0, 0, 0.5], "size_m": [2, 2, 0.4]}]))


def test_a_current_pose_too_close_to_something_is_refused_with_figures() -> None:
    with pytest.raises(PlanError, match=r"current pose safely: .* and table are in collision"):
        build_plan(spec_of(), ur5(), start_q=np.radians([0, 20, 0, 0, 0, 0]))


def test_a_current_pose_that_nothing_leads_away_from_is_refused() -> None:
    # The wrist is folded to the far side of the forearm, a turn away from everything else.
    start = np.radians([0, -90, 90, 160, -90, 0])
    with pytest.raises(PlanError, match="no collision-free path leads from it to the poses"):
        build_plan(spec_of(), ur5(), start_q=start)


@pytest.mark.parametrize("start", [[0.0] * 5, [np.nan] * 6])
def test_a_current_pose_that_is_none_is_refused(start: list[float]) -> None:
    with pytest.raises(PlanError, match="not 6 joint positions"):
        build_plan(spec_of(), ur5(), start_q=np.array(start))


def test_limits_beyond_the_robots_are_all_told_with_figures() -> None:
    with pytest.raises(SpecError) as error:
        plan_of(
            excitation={
                "kind": "dwell",
                "max_velocity_deg_s": 200,
                "max_acceleration_deg_s2": 900,
                "range_deg": [[-90, 90]] * 5 + [[-400, 400]],
            },
            reference={"q_deg": [0, 0, 0]},
            loads=[{"mass_kg": 7}],
        )
    assert error.value.message.splitlines() == [
        "excitation.max_velocity_deg_s: 200 °/s exceeds the limit of shoulder_pan_joint, 180 °/s",
        "excitation.max_acceleration_deg_s2: 900 °/s² exceeds the limit of shoulder_pan_joint, "
        "800 °/s²",
        "excitation.range_deg.5: -400° is outside the range of wrist_3_joint, -360° to 360°",
        "excitation.range_deg.5: 400° is outside the range of wrist_3_joint, -360° to 360°",
        "reference.q_deg: 3 angles, but the ur5 has 6 joints",
        "loads.0.mass_kg: 7 kg exceeds the rated payload of the ur5, 5 kg",
    ]


def test_a_rate_that_is_not_the_robots_is_refused_with_both() -> None:
    spec = spec_of(record={"rate_hz": 500})
    with pytest.raises(SpecError, match=r"record\.rate_hz: 500 Hz.* runs at 125 Hz"):
        build_plan(spec, ur5())
    assert build_plan(spec, ur5(), rate_hz=500.0).rate_hz == 500


def test_too_few_ranges_are_told() -> None:
    with pytest.raises(SpecError, match="2 ranges, but the ur5 has 6 joints"):
        plan_of(excitation={"kind": "dwell", "range_deg": [[-90, 90]] * 2})


def test_poses_stay_in_the_range_of_the_spec() -> None:
    ranges = [[-20, 30], [-100, -60], [20, 90], [-100, -30], [-100, -60], [0, 10]]
    plan = plan_of(excitation={"kind": "dwell", "waypoints": 20, "range_deg": ranges})
    q = np.degrees([s.motion.q_end for s in of_kind(plan, "dwell") if s.motion])
    low, high = np.array(ranges, dtype=float).T
    assert np.all((q >= low - 1e-9) & (q <= high + 1e-9))


def test_a_reference_pose_in_collision_is_refused() -> None:
    with pytest.raises(SpecError, match=r"reference.q_deg: .* and table"):
        plan_of(reference={"q_deg": [0, 20, 0, 0, 0, 0]})


def test_the_default_reference_pose_has_room_for_its_approach() -> None:
    """With 50 mm the roomiest pose has them, but the poses 3° around it have not."""
    station = ur5(table_z_m=0.0, clearance_m=0.05)
    plan = plan_of(
        station, excitation={"kind": "fourier", "trajectories": 1}, reference={"every": 1}
    )
    assert of_kind(plan, "reference")
    assert plan.margins["clearance_m"] >= 0


@pytest.mark.thorough
def test_the_default_reference_pose_is_home_where_that_has_room() -> None:
    excitation = {"kind": "fourier", "trajectories": 1}
    station, spec = ur5(), spec_of(excitation=excitation, reference={"every": 1})
    workspace = workspace_of(spec, station, plannable_arm(station), 125.0)
    (reference, *_) = of_kind(build_plan(spec, station), "reference")
    assert reference.motion is not None
    np.testing.assert_allclose(reference.motion.q_end, roadmap_of(workspace).home)


def test_no_room_for_a_default_reference_pose_names_the_ways_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hil.planning.build.REFERENCE_DELTA_DEG", 120.0)
    with pytest.raises(PlanError, match="the default reference pose: ") as error:
        plan_of(excitation={"kind": "fourier", "trajectories": 1}, reference={"every": 1})
    for way in ("reference.q_deg", "reference.every: 0", "clearance_m"):
        assert way in error.value.hint


@pytest.mark.thorough
def test_a_start_nearer_than_the_clearance_names_it_and_no_interlock() -> None:
    start = np.radians([0.0, -90.0, 150.0, -90.0, 0.0, 0.0])
    inside = {"kind": "workspace", "min_m": [-2, -2, -2], "max_m": [2, 2, 2]}
    with pytest.raises(PlanError, match="are required") as error:
        build_plan(spec_of(interlocks=[inside]), ur5(clearance_m=0.06), start_q=start)
    assert "jog the robot" in error.value.hint
    assert "reduce clearance_m (0.06 m)" in error.value.hint
    assert "interlock" not in error.value.hint


def test_a_robot_without_collision_bodies_is_not_moved() -> None:
    with pytest.raises(PlanError, match="collision bodies are unknown") as error:
        plan_of(ur5("somewhere/arm.urdf"))
    assert "ur5" in error.value.hint


def test_a_load_too_heavy_for_the_wrist_is_refused_by_its_torque() -> None:
    with pytest.raises(PlanError, match="effort_nm: -"):
        plan_of(loads=[{"mass_kg": 5, "com_m": [0, 0, 0.9], "size_m": [0.1, 0.02]}])


def test_the_dwell_rule_is_that_of_the_spec() -> None:
    plan = plan_of(
        excitation={
            "kind": "dwell",
            "waypoints": 2,
            "dwell_s": 0.2,
            "samples_per_dwell": 7,
            "settle_rad_s": 0.01,
            "settle_timeout_s": 1.5,
        }
    )
    rule = plan.dwell
    assert (rule.dwell_s, rule.samples, rule.settle_rad_s, rule.timeout_s) == (0.2, 7, 0.01, 1.5)


def test_runs_can_resume_before_every_pose() -> None:
    steps = list(dwell_plan())
    for pose in range(12):
        first = next(i for i, s in enumerate(steps) if s.kind == "dwell" and s.pose == pose)
        group = next(i for i in range(first, -1, -1) if steps[i].checkpoint)
        assert not any(s.measures for s in steps[group:first])


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["ur3e", "ur10"])
def test_other_arms_are_planned_for_too(name: str) -> None:
    plan = plan_of(ur5(name), robot=name, excitation={"kind": "dwell", "waypoints": 3})
    assert plan.robot_model == name
    assert plan.margins["clearance_m"] >= 0.02
