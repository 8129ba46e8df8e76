"""Dwell programs: well-spread poses, both approaches, a random order, and the lab's own poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.core.errors import PlanError, SpecError
from hil.core.typing import FloatArray
from hil.excitation.dwell import AngleUnit, DwellProgram, read_waypoints
from hil.excitation.motion import Hold, Line
from hil.excitation.program import Action, Program, Visit, pose_visit
from hil.excitation.roadmap import Roadmap
from hil.excitation.sequencing import Arrangement
from hil.excitation.workspace import Workspace, roomy_poses
from hil.spec.experiment import Dwell
from tests.support.plan_parts import DEGREE, toy_workspace


def disc(q: FloatArray) -> FloatArray:
    return np.hypot(q[:, 0], q[:, 1]) - 0.5


def roadmap_in(workspace: Workspace) -> Roadmap:
    return Roadmap(workspace, roomy_poses(workspace, 24, seed=0))


def program_of(workspace: Workspace, folder: Path = Path(), **changes: Any) -> Program:
    facts: dict[str, Any] = {"kind": "dwell", "waypoints": 20}
    return DwellProgram(Dwell.model_validate(facts | changes), folder).program(
        roadmap_in(workspace)
    )


def measured(workspace: Workspace, program: Program) -> list[Action]:
    roadmap = roadmap_in(workspace)
    return list(Arrangement(roadmap).measure(program, roadmap.home))


def poses_of(program: Program) -> FloatArray:
    return np.array([visit.exit for visit in program.visits])


def test_both_approaches_dwell_twice_at_every_pose() -> None:
    visits = program_of(toy_workspace()).visits
    for number, visit in enumerate(visits):
        dwells = [action for action in visit.actions if action.kind == "dwell"]
        assert [(a.pose, a.approach) for a in dwells] == [(number, 1), (number, -1)]
        assert dwells[0].motion == dwells[1].motion
    assert len(visits) == 20


def test_every_joint_arrives_from_below_then_from_above() -> None:
    for visit in program_of(toy_workspace(n=3)).visits:
        for before, dwell in zip(visit.actions, visit.actions[1:], strict=False):
            if dwell.kind == "dwell":
                qd = before.motion.sample(1000.0).qd[:-1]
                assert np.all(np.sign(qd) == dwell.approach)


@pytest.mark.parametrize(("approach", "signs"), [("positive", [1]), ("negative", [-1])])
def test_one_approach_dwells_once(approach: str, signs: list[int]) -> None:
    for visit in program_of(toy_workspace(), approach=approach).visits:
        assert [a.approach for a in visit.actions if a.kind == "dwell"] == signs


def test_a_free_approach_goes_straight_to_the_pose() -> None:
    for visit in program_of(toy_workspace(), approach="free").visits:
        assert [(a.kind, a.approach) for a in visit.actions] == [("dwell", 0)]


def test_the_last_stretch_is_as_long_as_asked() -> None:
    visit = program_of(toy_workspace(), approach="positive", approach_deg=5.0).visits[0]
    np.testing.assert_allclose(visit.exit - visit.entry, 5.0 * DEGREE)


def test_poses_approaches_and_the_ways_between_are_clear() -> None:
    workspace = toy_workspace(disc)
    actions = measured(workspace, program_of(workspace, waypoints=60))
    assert sum(action.kind == "dwell" for action in actions) == 120
    for action in actions:
        assert disc(action.motion.sample(100.0).q).min() >= 0.02


def test_every_motion_begins_where_the_last_one_ended() -> None:
    workspace = toy_workspace(disc)
    actions = measured(workspace, program_of(workspace))
    here = roadmap_in(workspace).home
    for action in actions:
        np.testing.assert_array_equal(action.motion.q_start, here)
        here = action.motion.q_end


def test_the_order_does_not_follow_the_joint_angles() -> None:
    workspace = toy_workspace()
    actions = measured(workspace, program_of(workspace, waypoints=150))
    order = [a.motion.q_end for a in actions if a.kind == "dwell" and a.approach == 1]
    for angles in np.array(order).T:
        ranks = np.argsort(np.argsort(angles))
        # By chance a rank correlation over 150 poses has a standard deviation of 0.08.
        assert abs(np.corrcoef(ranks, np.arange(150))[0, 1]) < 0.3


def test_every_pose_is_visited_once() -> None:
    workspace = toy_workspace(disc)
    actions = measured(workspace, program_of(workspace))
    visited = [a.pose for a in actions if a.kind == "dwell" and a.approach == 1]
    assert sorted(visited) == list(range(20))


def test_the_seed_decides() -> None:
    first, again, other = (program_of(toy_workspace(), seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(poses_of(first), poses_of(again))
    assert not np.array_equal(poses_of(first), poses_of(other))


@pytest.mark.thorough
def test_an_approach_without_room_is_said() -> None:
    reason = "can be reached and approached; on the way to a rejected one: joint .* its range"
    with pytest.raises(PlanError, match=reason):
        program_of(toy_workspace(), approach_deg=120.0)


@pytest.mark.parametrize(("clearance_m", "said"), [(1.0, "joint 1 at 143.2°"), (0.01, "arm and")])
def test_what_is_wrong_with_a_motion_may_be_an_end_beyond_the_limits(
    clearance_m: float, said: str
) -> None:
    """The motion begins with the least room; the end is named only where that room is enough."""
    workspace = toy_workspace(lambda q: clearance_m + np.abs(q).sum(axis=1))
    line = workspace.line(np.zeros(2), np.array([2.5, 0.0]))
    assert workspace.obstacle([line]).startswith(said)


def test_an_unreachable_visit_is_replaced_by_a_spare() -> None:
    workspace = toy_workspace(lambda q: np.abs(q[:, 0] - 1.0) - 0.1)
    behind, before = np.array([1.4, 0.0]), np.array([0.5, 0.5])
    lost, spare = (
        pose_visit(workspace, q, "free", 0.05, label=f"pose {i}", pose=i)
        for i, q in enumerate((behind, before))
    )
    actions = measured(workspace, Program([lost], [spare], shuffle_seed=0))
    assert [a.pose for a in actions if a.kind == "dwell"] == [1]
    with pytest.raises(PlanError, match="pose 0: no collision-free path leads there"):
        measured(workspace, Program([lost], [], shuffle_seed=0))


def test_the_reference_is_seen_first_last_and_every_so_many_poses() -> None:
    workspace = toy_workspace(disc)
    roadmap = roadmap_in(workspace)
    reference = pose_visit(
        workspace, roadmap.home, "free", 0.05, label="reference", kind="reference"
    )
    program = program_of(workspace, approach="free")
    kinds = [
        action.kind
        for action in Arrangement(roadmap, reference, 8).measure(program, roadmap.home)
        if action.kind != "move"
    ]
    seen = [i for i, kind in enumerate(kinds) if kind == "reference"]
    assert seen == [0, 9, 18, 23]


def test_warming_up_moves_every_joint_far_for_as_long_as_asked() -> None:
    workspace = toy_workspace(disc, n=3)
    roadmap = roadmap_in(workspace)
    actions = Arrangement(roadmap).warm_up(roadmap.home, 60.0)
    assert sum(action.motion.duration_s for action in actions) >= 60.0
    assert sum(action.motion.duration_s for action in actions[:-1]) < 60.0
    travelled = sum(np.abs(a.motion.q_end - a.motion.q_start) for a in actions)
    assert np.all(travelled > 5 * (workspace.high - workspace.low))


def file_program(tmp_path: Path, text: str, workspace: Workspace, **changes: Any) -> list[Visit]:
    (tmp_path / "poses.csv").write_text(text, "utf-8")
    facts: dict[str, Any] = {"file": "poses.csv", "file_unit": "rad", "approach": "free"}
    return list(program_of(workspace, tmp_path, **(facts | changes)).visits)


def test_poses_of_a_file_keep_their_rows(tmp_path: Path) -> None:
    text = "# two poses\n0.5, 0.6\n\n-0.7, 0.8\n"
    visits = file_program(tmp_path, text, toy_workspace())
    np.testing.assert_allclose([visit.exit for visit in visits], [[0.5, 0.6], [-0.7, 0.8]])
    assert [visit.actions[0].pose for visit in visits] == [0, 1]


def test_degrees_are_the_default(tmp_path: Path) -> None:
    visits = file_program(tmp_path, "90, -45\n", toy_workspace(), file_unit="deg")
    np.testing.assert_allclose(visits[0].exit, [np.pi / 2, -np.pi / 4])


def test_columns_follow_the_names_in_the_first_line(tmp_path: Path) -> None:
    visits = file_program(tmp_path, "joint 2, joint 1\n0.6, 0.5\n", toy_workspace())
    np.testing.assert_allclose(visits[0].exit, [0.5, 0.6])


@pytest.mark.parametrize(
    ("header", "stated", "unit"),
    [
        ("q1,q2", None, "deg"),
        ("q1,q2", "rad", "rad"),
        ("q1_deg,q2_deg", None, "deg"),
        ("q1_rad,q2_rad", None, "rad"),
        ("q1_rad,q2_rad", "rad", "rad"),
        ("joint 1_rad,joint 2_rad", None, "rad"),
    ],
)
def test_a_first_line_may_number_the_joints_and_name_the_unit(
    header: str, stated: AngleUnit | None, unit: str, tmp_path: Path
) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(f"{','.join(reversed(header.split(',')))}\n20, 10\n", "utf-8")
    file = read_waypoints(path, ("joint 1", "joint 2"), stated)
    q = [10.0, 20.0] if unit == "rad" else np.radians([10.0, 20.0])
    np.testing.assert_allclose(file.q, [q])
    assert file.unit == unit
    assert not file.problems


@pytest.mark.parametrize("header", ["q1,q3", "q1_deg,q2_rad", "q1,q2_rad", "q1,q1", "q0,q1"])
def test_a_first_line_that_is_not_of_these_joints_is_refused(header: str, tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(f"{header}\n0.5, 0.6\n", "utf-8")
    with pytest.raises(SpecError, match="neither a pose nor the joints' names") as error:
        read_waypoints(tmp_path / "poses.csv", ("joint 1", "joint 2"))
    assert "q1 to q2; all of them may end in _deg or all in _rad" in error.value.hint


def test_two_units_for_one_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"the first line says deg, excitation\.file_unit says rad"):
        file_program(tmp_path, "q1_deg,q2_deg\n45, 30\n", toy_workspace())


def test_small_angles_without_a_unit_are_not_taken_for_degrees(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("0.5, 1.2\n-6.2, 0\n", "utf-8")
    (problem,) = read_waypoints(path, ("joint 1", "joint 2")).problems
    assert "no angle is beyond 2π" in problem
    assert not read_waypoints(path, ("joint 1", "joint 2"), "deg").problems


def test_all_mistakes_of_a_file_are_told_with_their_lines(tmp_path: Path) -> None:
    text = (
        "0.5, 0.6\n"
        "0.5, north\n"
        "0.5\n"
        "nan, 0.6\n"
        "0.5, 2.5\n"
        "0.1, 0.1\n"
        "0.5, inf\n"
    )  # fmt: skip
    with pytest.raises(SpecError) as error:
        file_program(tmp_path, text, toy_workspace(disc))
    told = {
        line.split(":")[1]: line.partition(":")[2].partition(": ")[2]
        for line in error.value.message.splitlines()
    }
    assert told["2"] == "column 2 is 'north', not a number"
    assert told["3"] == "1 columns, but the robot has 2 joints"
    assert told["4"] == "column 1 is nan, not a finite number"
    assert told["5"] == "joint 2 at 143.2° is beyond its range of -114.6° to 114.6°"
    assert told["6"] == "arm and drawing are in collision (358.6 mm deep)"
    assert told["7"] == "column 2 is inf, not a finite number"
    assert set(told) == {"2", "3", "4", "5", "6", "7"}


def test_a_pose_that_cannot_be_reached_is_told(tmp_path: Path) -> None:
    workspace = toy_workspace(lambda q: np.abs(q[:, 0] - 1.0) - 0.1)
    with pytest.raises(SpecError, match=r"poses.csv:2: no collision-free path leads there"):
        file_program(tmp_path, "0.5, 0.6\n1.4, 0.0\n", workspace)


def test_a_pose_whose_approach_collides_is_told(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"poses.csv:1: at the start of its approach"):
        file_program(tmp_path, "0.53, 0.1\n", toy_workspace(disc), approach="both")


def test_degrees_read_as_radians_are_suspected(tmp_path: Path) -> None:
    with pytest.raises(SpecError) as error:
        file_program(tmp_path, "45, 30\n-20, 60\n", toy_workspace())
    assert "file_unit: deg" in error.value.hint


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("elbow, joint 1\n0.5, 0.5\n", "neither a pose nor the joints' names: elbow, joint 1"),
        ("# nothing\n", "there is no pose in this file"),
    ],
)
def test_a_file_without_poses_is_refused(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(SpecError, match=told):
        file_program(tmp_path, text, toy_workspace())


def test_a_missing_or_binary_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match=r"poses\.csv cannot be read: No such file"):
        program_of(toy_workspace(), tmp_path, file="poses.csv")
    (tmp_path / "poses.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SpecError, match="not UTF-8"):
        program_of(toy_workspace(), tmp_path, file="poses.csv")


def test_a_long_list_of_mistakes_is_cut(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="… and 30 more") as error:
        file_program(tmp_path, "1, x\n" * 50, toy_workspace())
    assert len(error.value.message.splitlines()) == 21


def test_moves_are_lines_and_dwells_hold() -> None:
    for visit in program_of(toy_workspace()).visits:
        for action in visit.actions:
            assert isinstance(action.motion, Hold if action.kind == "dwell" else Line)
