"""Plans stay inside the box of their workspace interlock, or say what cannot be met and why."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hil.core.errors import HilError, PlanError, SpecError
from hil.core.typing import FloatArray
from hil.dynamics import RobotModel
from hil.excitation.program import Program, pose_visit
from hil.excitation.roadmap import Roadmap
from hil.excitation.sequencing import Arrangement
from hil.excitation.workspace import Workspace, roomy_poses
from hil.planning.build import build_plan
from hil.planning.plan import Plan
from hil.planning.workspace import Approach, checked_start, roadmap_of
from hil.spec.experiment import ExperimentSpec
from hil.spec.station import StationRobot
from tests.support.paths import ROOT
from tests.support.plan_parts import plan_of, spec_of, toy_workspace, ur5

TUTORIAL = ROOT / "docs/tutorial/first-real-ur5.md"
CLEARANCE_M = 0.02
TIP_M = 0.12
LOADS = [
    {"mass_kg": 0.0, "size_m": [0.02, 0.02]},
    {"mass_kg": 2.0, "com_m": [0, 0, 0.05], "size_m": [TIP_M, 0.03], "prompt": "x"},
]
FOURIER = {"kind": "fourier", "trajectories": 2}
BOXES: dict[str, tuple[list[float], list[float]]] = {
    "around the base": ([-0.6, -0.6, 0.05], [0.6, 0.6, 0.8]),
    "in front": ([0.1, -0.5, 0.05], [0.8, 0.5, 0.8]),
    "cube": ([0.25, -0.2, 0.2], [0.65, 0.2, 0.6]),
    "behind and flat": ([-0.8, -0.4, 0.2], [0.0, 0.4, 0.45]),
}


def box(low: list[float], high: list[float]) -> dict[str, Any]:
    return {"kind": "workspace", "min_m": low, "max_m": high}


def depth(plan: Plan, low: list[float], high: list[float], tip_m: float = 0.0) -> float:
    """Least distance of flange and tip to the faces of a box [m], by Pinocchio."""
    q = np.concatenate([motion.sample(plan.rate_hz).q for motion in plan.motions])
    poses = RobotModel.from_arm("ur5").flange_pose(q)
    flange = poses[:, :3, 3]
    points = np.concatenate([flange, flange + tip_m * poses[:, :3, 2]])
    return float(min((points - low).min(), (high - points).min()))


def tutorial() -> tuple[ExperimentSpec, dict[str, Any]]:
    """The spec of the page and the robot of its station."""
    files = re.findall(
        r"<!-- file: (\S+) -->\n```yaml\n(.*?)```", TUTORIAL.read_text("utf-8"), re.S
    )
    spec, station = (yaml.safe_load(dict(files)[name]) for name in ("first.yaml", "station.yaml"))
    return ExperimentSpec.model_validate(spec), station["robots"]["ur5"]


@pytest.mark.thorough
@pytest.mark.parametrize("bare", [False, True], ids=["with the shelf", "on a bare table"])
def test_the_tutorials_spec_plans(bare: bool) -> None:
    spec, robot = tutorial()
    if bare:
        robot["surroundings"]["boxes"] = []
    plan = build_plan(spec, StationRobot.model_validate(robot))
    (space,) = (one for one in spec.interlocks if one.kind == "workspace")
    assert depth(plan, space.min_m, space.max_m) >= 0.05 - 1e-9
    assert plan.margins["workspace_m"] >= 0.05 - 1e-9


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("kind", "name", "seed"),
    [
        ("dwell", "around the base", 1),
        ("dwell", "in front", 2),
        ("dwell", "cube", 2),
        ("fourier", "cube", 1),
        ("fourier", "behind and flat", 2),
    ],
)
def test_every_motion_of_a_plan_stays_inside_the_box(kind: str, name: str, seed: int) -> None:
    """Warm-up, payload check, references, the program with either load, and all ways between."""
    sides = BOXES[name]
    chosen = FOURIER if kind == "fourier" else {"kind": "dwell", "waypoints": 5}
    plan = plan_of(
        excitation=chosen | {"seed": seed},
        interlocks=[box(*sides)],
        warm_up={"duration_s": 20},
        reference={"every": 2},
        loads=LOADS,
        weigh={"poses": 3},
    )
    assert {"warmup", "weigh", "reference"} < {step.kind for step in plan}
    assert depth(plan, *sides, TIP_M) >= CLEARANCE_M - 1e-9
    assert plan.margins["clearance_m"] >= CLEARANCE_M


@pytest.mark.thorough
def test_optimised_trajectories_stay_inside_the_box_and_are_kept_under_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HIL_CACHE", str(tmp_path))
    asked = {"trajectories": 1, "harmonics": 2, "fundamental_hz": 0.2, "optimise": {"starts": 1}}
    sides = BOXES["in front"]
    plan_of(excitation=FOURIER | asked)
    plan = plan_of(excitation=FOURIER | asked, interlocks=[box(*sides)])
    assert depth(plan, *sides) >= CLEARANCE_M - 1e-5
    assert plan.condition_number < 100
    assert len(list(tmp_path.rglob("*.json"))) == 2


@pytest.mark.thorough
def test_planes_confine_as_the_sides_of_a_box_do() -> None:
    curtain = {"point_m": [0, 0.1, 0], "normal": [0, 1, 0], "name": "curtain"}
    plan = plan_of(interlocks=[{"kind": "workspace", "planes": [curtain]}])
    assert depth(plan, [-9, 0.1, -9], [9, 9, 9]) >= CLEARANCE_M - 1e-9


def test_a_box_that_is_switched_off_changes_no_plan() -> None:
    off = box(*BOXES["cube"]) | {"enabled": False}
    assert plan_of(interlocks=[off]).hash == plan_of().hash


@pytest.mark.thorough
def test_a_resumed_run_comes_back_inside_the_box() -> None:
    sides = BOXES["in front"]
    spec = spec_of(interlocks=[box(*sides)])
    plan = build_plan(spec, ur5())
    first, last = plan.motions[0].q_start, plan.motions[-1].q_end
    ends = np.array([motion.q_end for motion in plan.motions])
    approach = Approach(spec, ur5(), rate_hz=plan.rate_hz, here=last, targets=ends)
    q = np.concatenate([line.sample(125.0).q for line in approach.way(last, first)])
    places = RobotModel.from_arm("ur5").flange_pose(q)[:, :3, 3]
    assert min((places - sides[0]).min(), (sides[1] - places).min()) >= CLEARANCE_M - 1e-9


# What cannot be met.


def refusal(**changes: Any) -> HilError:
    with pytest.raises((PlanError, SpecError)) as caught:
        plan_of(**changes)
    assert caught.value.hint
    return caught.value


def test_a_box_out_of_reach_is_refused_with_how_far_it_is() -> None:
    error = refusal(interlocks=[box([1.2, -0.4, 0.2], [1.9, 0.4, 0.9])])
    found = re.search(r"the flange is (\d+\.\d) mm beyond x of min_m", error.message)
    assert found
    assert 200 < float(found[1]) < 400  # a UR5 reaches 0.95 m with its wrist


def test_boxes_that_leave_nothing_between_them_are_refused() -> None:
    error = refusal(
        interlocks=[
            box([0.3, -0.4, 0.1], [0.9, 0.4, 0.9]),
            {"kind": "workspace", "max_m": [0.33, 1, 1]},
        ]
    )
    assert "interlocks.1.max_m.0: leaves 30 mm to min_m on x" in error.message


def test_too_small_a_box_names_poses_side_and_excess() -> None:
    error = refusal(interlocks=[box([0.3, -0.1, 0.3], [0.45, 0.05, 0.45])])
    assert re.search(r"poses to travel over: only \d+ of \d+ ", error.message)
    assert re.search(r"mm (beyond|inside) [xyz] of (min|max)_m \(interlocks.0\)", error.message)
    assert "move that side of the workspace interlock outwards" in error.hint


@pytest.mark.thorough
def test_dwell_poses_that_cannot_be_reached_name_the_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.excitation.dwell.MOST_TRIES", 50)
    error = refusal(interlocks=[box([-2, -2, 0.4], [2, 2, 0.445])])
    assert re.search(r"dwell poses: only \d+ of \d+ clear poses", error.message)
    assert re.search(r"mm (beyond|inside) z of (min|max)_m \(interlocks.0\)", error.message)


@pytest.mark.thorough
def test_trajectories_without_room_name_the_side() -> None:
    error = refusal(
        excitation=FOURIER | {"range_deg": [[-90, 90]] * 6, "fundamental_hz": 0.02},
        interlocks=[box([-2, -2, 0.4], [2, 2, 0.46])],
    )
    assert "random Fourier series keep 20 mm" in error.message
    assert re.search(r"mm (beyond|inside) z of (min|max)_m \(interlocks.0\)", error.message)


@pytest.mark.thorough
def test_optimised_trajectories_without_room_name_the_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HIL_CACHE", "off")
    hopeless = {"optimise": {"starts": 1, "budget_s": 0.01, "clearance_mm": 120}}
    error = refusal(excitation=FOURIER | hopeless, interlocks=[box(*BOXES["behind and flat"])])
    assert re.search(r"trajectory 1: .*the flange .* z of (min|max)_m", error.message)


def test_a_current_pose_outside_the_box_is_refused_with_how_far() -> None:
    upright = np.radians([0, -90, 0, -90, 0, 0])
    with pytest.raises(PlanError, match=r"current pose .*the flange is 501.1 mm beyond z of max_m"):
        build_plan(spec_of(interlocks=[box([-2, -2, -1], [2, 2, 0.5])]), ur5(), start_q=upright)


def test_a_reference_pose_outside_the_box_is_refused_before_anything_is_planned() -> None:
    error = refusal(
        reference={"every": 5, "q_deg": [0, -90, 0, -90, 0, 0]},
        interlocks=[box([-2, -2, -1], [2, 2, 0.5])],
    )
    assert "reference.q_deg: the flange is 501.1 mm beyond z of max_m" in error.message


FOUR_POSES = "".join(f"{8 * i},-90,{80 + 4 * i},-80,-90,0\n" for i in range(4))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "sides",
    [([-0.55, -0.35, 0.34], [-0.32, -0.02, 0.62]), ([-0.51, -0.31, 0.38], [-0.36, -0.06, 0.58])],
    ids=["drawn poses are in another configuration", "hardly any drawn pose is inside"],
)
def test_a_file_in_a_small_box_is_planned_from_a_pose_of_it(
    tmp_path: Path, sides: tuple[list[float], list[float]]
) -> None:
    file = tmp_path / "poses.csv"
    file.write_text(FOUR_POSES, "utf-8")
    excitation = {"kind": "dwell", "file": str(file), "file_unit": "deg", "approach": "positive"}
    spec = spec_of(excitation=excitation, interlocks=[box(*sides)], weigh={"poses": 0})
    plan = build_plan(spec, ur5(), start_q=np.radians([0, -90, 80, -80, -90, 0]))
    assert sum(step.kind == "dwell" for step in plan) == 4
    assert depth(plan, *sides) >= CLEARANCE_M - 1e-9


@pytest.mark.thorough
@pytest.mark.parametrize(("top_m", "lower"), [(0.51, True), (0.4, False)])
def test_the_hint_for_poses_too_near_to_a_side_names_every_way_out(
    tmp_path: Path, top_m: float, lower: bool
) -> None:
    file = tmp_path / "poses.csv"
    file.write_text("0,-90,80,-80,-90,0\n", "utf-8")  # the flange is at 0.50 m
    error = refusal(
        excitation={"kind": "dwell", "file": str(file), "file_unit": "deg"},
        interlocks=[box([-2, -2, -1], [2, 2, top_m])],
    )
    words = "correct or remove these poses, or move that side of the workspace"
    assert error.hint.startswith(words)
    assert ("or lower the station's clearance_m" in error.hint) is lower


def test_poses_of_a_file_outside_the_box_are_listed(tmp_path: Path) -> None:
    file = tmp_path / "poses.csv"
    file.write_text("0,-90,0,-90,0,0\n0,-60,90,-90,0,0\n", "utf-8")
    error = refusal(
        excitation={"kind": "dwell", "file": str(file), "file_unit": "deg"},
        interlocks=[box([-2, -2, -1], [2, 2, 0.5])],
    )
    assert re.search(r"poses.csv:1: the flange is 501.1 mm beyond z of max_m", error.message)


class Corridor:
    """A space in joint space: the flange leaves it where two joints are far from each other."""

    names = (("flange", "x of max_m (interlocks.0)"),)
    reach = np.ones((1, 2))

    def distances(self, q: FloatArray) -> FloatArray:
        return np.asarray(0.4 - np.abs(q[:, 0] * q[:, 1]))[None]


def corridor() -> Workspace:
    return toy_workspace(space=Corridor())


def test_a_way_that_is_missing_names_both_poses_and_the_side() -> None:
    workspace = toy_workspace(lambda q: np.abs(q[:, 0] - 0.5) - 0.1, space=Corridor())
    roadmap = Roadmap(workspace, roomy_poses(workspace, 16, seed=0))
    visits = [
        pose_visit(workspace, np.array(q), "free", 0.05, label=f"pose {i}", pose=i)
        for i, q in enumerate([(0.0, 0.1), (1.4, 0.0)])
    ]
    words = "pose 1: no collision-free path leads there from pose 0; on the"
    with pytest.raises(PlanError, match=words):
        list(Arrangement(roadmap, every=9).measure(Program(visits), roadmap.home))


class TwoRooms:
    """A space in joint space: no way leads from small to large angles of the first joint."""

    names = (("flange", "x of max_m (interlocks.0)"),)
    reach = np.ones((1, 2))

    def distances(self, q: FloatArray) -> FloatArray:
        return np.asarray(np.minimum(np.abs(q[:, 0] - 0.6) - 0.1, 0.05))[None]


LARGE_ROOM, SMALL_ROOM = np.array([-0.5, 0.0]), np.array([1.2, 0.0])


def test_a_confined_program_is_planned_in_the_room_where_the_robot_stands() -> None:
    workspace = toy_workspace(space=TwoRooms())
    assert checked_start(LARGE_ROOM, roadmap_of(workspace, start=LARGE_ROOM)) is LARGE_ROOM
    assert checked_start(SMALL_ROOM, roadmap_of(workspace, start=SMALL_ROOM)) is SMALL_ROOM


def test_a_confined_program_is_planned_in_the_room_of_its_poses() -> None:
    workspace = toy_workspace(space=TwoRooms())
    roadmap = roadmap_of(workspace, wanted=np.array([[1.1, 0.2], [1.3, -0.2], [-0.5, 0.0]]))
    assert (roadmap.poses[:, 0] > 0.7).all()


def test_a_robot_in_another_room_of_the_box_than_the_program_names_the_side() -> None:
    workspace = toy_workspace(space=TwoRooms())
    roadmap = roadmap_of(workspace, wanted=SMALL_ROOM[None], start=LARGE_ROOM)
    words = r"no collision-free path leads from it .* x of max_m"
    with pytest.raises(PlanError, match=words) as caught:
        checked_start(LARGE_ROOM, roadmap)
    assert "move that side of the workspace interlock" in caught.value.hint


def test_ways_lead_around_what_is_outside() -> None:
    workspace = corridor()
    roadmap = Roadmap(workspace, roomy_poses(workspace, 32, seed=0))
    way = roadmap.way(np.array([1.4, 0.1]), np.array([0.1, 1.4]))
    assert way
    assert len(way) > 1
    q = np.concatenate([line.sample(100.0).q for line in way])
    assert workspace.depth(q).min() >= workspace.clearance_m


def test_a_warm_up_without_room_says_what_is_in_the_way() -> None:
    workspace = corridor()
    roadmap = Roadmap(workspace, roomy_poses(workspace, 16, seed=0))
    roadmap.poses = np.array([[1.4, 1.4], [1.3, 1.4]])
    words = r"no collision-free warm-up .*mm beyond x of max_m"
    with pytest.raises(PlanError, match=words) as caught:
        Arrangement(roadmap).warm_up(np.array([0.0, 0.0]), 5.0)
    assert "move that side" in caught.value.hint


def test_payload_check_poses_without_room_are_named() -> None:
    loads = [{"mass_kg": 0.0}, {"mass_kg": 2.0, "prompt": "x"}]
    flat = [box([-2, -2, 0.4], [2, 2, 0.445])]
    error = refusal(loads=loads, weigh={"poses": 3}, interlocks=flat)
    assert "payload-check poses" in error.message
