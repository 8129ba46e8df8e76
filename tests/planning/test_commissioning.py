"""Commissioning: the same program, slower and shorter, without warm-up, and said so."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import PlanError, SpecError
from hil.excitation.motion import FourierSeries, Hold, Line
from hil.planning.commissioning import Commissioning, commissioning_of
from hil.planning.plan import LoadStep, Plan, Step, read_plan
from hil.planning.plan_preview import preview
from hil.planning.swept_space import swept
from hil.recording.mcap_reader import read_topic
from tests.support.command import hil
from tests.support.plan_parts import spec_of, ur5
from tests.support.plans_once import planned_once
from tests.support.recorded import DWELL

RATE_HZ = 125.0


def plan_of(*steps):
    return Plan("p", "ur5", ("j1", "j2"), RATE_HZ, steps, (LoadStep(Payload()),))


def line(a=0.0, b=1.0):
    return Line((a, a), (b, b / 2), 1.0, 2.0, 20.0, RATE_HZ)


SERIES = FourierSeries((0.0, 0.5), ((0.2, -0.2), (0.1, -0.1)), ((0.2, -0.1), (0.0, 0.0)), 0.2)


def dwells(poses=3):
    """A payload, then for every pose a move and two dwells, one from either side."""
    steps = [Step(0, "payload")]
    for pose in range(poses):
        for approach in (1, -1):
            steps.append(Step(len(steps), "move", line(), pose=pose))
            steps.append(Step(len(steps), "dwell", Hold((0.0, 0.0)), pose=pose, approach=approach))
    steps.append(Step(len(steps), "move", line()))
    steps.append(Step(len(steps), "reference", Hold((0.0, 0.0)), pose=99))
    return plan_of(*steps)


def slowly(motion, speed):
    return Commissioning(speed=speed).of(plan_of(Step(0, "trajectory", motion))).steps[0].motion


@pytest.mark.thorough
@pytest.mark.parametrize("motion", [line(), SERIES])
def test_a_slower_motion_has_the_same_path(motion):
    slow = slowly(motion, 0.1)
    fast, slower = motion.sample(1000.0), slow.sample(100.0)
    same = np.array([np.abs(fast.q - q).max(axis=1).min() for q in slower.q])
    assert same.max() < 2e-3
    assert slow.q_start == pytest.approx(motion.q_start)
    assert slow.q_end == pytest.approx(motion.q_end)


def test_a_slower_trajectory_is_the_same_one_in_longer_time():
    slow = slowly(SERIES, 0.5)
    assert slow.duration_s == pytest.approx(2 * SERIES.duration_s)
    fast, slower = SERIES.sample(1000.0), slow.sample(1000.0)
    assert np.abs(slower.qd).max() == pytest.approx(0.5 * np.abs(fast.qd).max(), rel=1e-3)
    assert np.abs(slower.qdd).max() == pytest.approx(0.25 * np.abs(fast.qdd).max(), rel=1e-3)


def test_a_slower_move_keeps_to_the_share_of_speed_and_acceleration():
    slow = slowly(line(), 0.1).sample(1000.0)
    assert np.abs(slow.qd).max() == pytest.approx(0.1 * 1.0)
    assert np.abs(slow.qdd).max() <= 0.1 * 2.0 + 1e-9


def test_a_short_slow_move_starts_and_stops_as_quickly_as_at_full_speed():
    fast, slow = line(b=3.0), slowly(line(b=3.0), 0.1)
    # At 1 rad/s starting and stopping cost 0.6 s; stretched ten times they would cost 6 s.
    assert slow.duration_s - 3.0 / 0.1 == pytest.approx(fast.duration_s - 3.0, abs=0.02)


def test_the_first_poses_are_measured_from_all_sides_and_nothing_after_them():
    plan = dwells(3)
    cut = Commissioning(first=2).of(plan)
    assert {s.pose for s in cut if s.kind == "dwell"} == {0, 1}
    assert sum(s.kind == "dwell" for s in cut) == 4
    assert cut.steps[-1].kind == "dwell"
    assert cut.steps == plan.steps[: len(cut)]


def test_more_than_there_is_is_all_of_it():
    plan = dwells(3)
    assert Commissioning(first=30).of(plan) == plan
    assert Commissioning(first=30).of(plan).hash == plan.hash


def test_the_first_seconds_end_with_a_measurement():
    plan = dwells(3)
    one_pose_s = sum(plan.step_duration_s(step) for step in plan.steps[1:5])
    cut = Commissioning(first_s=one_pose_s * 1.4).of(plan)
    assert cut.steps[-1].kind == "dwell"
    assert cut.duration_s <= one_pose_s * 1.4
    assert len(cut) == 5


def test_seconds_are_those_of_the_slower_plan():
    plan = dwells(3)
    whole_s = plan.duration_s
    assert len(Commissioning(speed=0.5, first_s=whole_s).of(plan)) < len(plan)


def test_the_plan_that_was_changed_is_another_one():
    plan = dwells(3)
    assert Commissioning(first=2).of(plan).hash != plan.hash
    assert Commissioning(speed=0.5).of(plan).hash != plan.hash


def test_nothing_to_measure_is_refused():
    with pytest.raises(PlanError, match="nothing would be measured"):
        Commissioning(first_s=0.01).of(dwells(3))


@pytest.mark.parametrize(
    ("speed", "first", "meant"),
    [
        ("10%", "", Commissioning(speed=0.1)),
        ("0.1", "10", Commissioning(speed=0.1, first=10)),
        ("", "30s", Commissioning(first_s=30.0)),
        ("", "30 s", Commissioning(first_s=30.0)),
        ("100%", "", Commissioning()),
        ("", "", None),
    ],
)
def test_what_is_typed_is_understood(speed, first, meant):
    assert commissioning_of(speed, first) == meant


@pytest.mark.parametrize(
    ("speed", "first"),
    [("0%", ""), ("110%", ""), ("2", ""), ("fast", ""), ("nan", ""), ("-1", "")]
    + [("", text) for text in ("0", "-3", "2.5", "s", "many", "0s", "-2s", "inf")],
)
def test_what_cannot_be_is_refused(speed, first):
    with pytest.raises(SpecError) as caught:
        commissioning_of(speed, first)
    assert caught.value.hint


def test_it_says_itself():
    assert Commissioning(0.1, first=10).to_dict() == {
        "speed": 0.1,
        "first": 10,
        "text": "at 10 % of the speed, only the first 10 measured",
    }


def test_it_knows_how_much_there_is_in_all():
    for first, text in (
        (2, "only the first 2 of 3 measured"),
        (9, "only the first 3 of 3 measured"),
    ):
        part = Commissioning(first=first)
        assert str(part.within(part.of(dwells(3)))) == text


def test_it_is_read_back_as_it_was_written():
    part = Commissioning(0.1, first_s=30.0)
    assert Commissioning.from_dict(part.to_dict()) == part


LOADS = [{"mass_kg": 0.0}, {"mass_kg": 2.0, "com_m": [0, 0, 0.05], "size_m": [0.1, 0.05]}]
MEASURED_WELL = {
    "warm_up": {"duration_s": 60}, "reference": {"every": 2}, "weigh": {"poses": 2},
    "loads": LOADS,
}  # fmt: skip


def built(part, start_q=None, **changes):
    return planned_once(spec_of(**changes), ur5(), part=part, start_q=start_q)


def kinds(plan):
    return {step.kind for step in plan}


@pytest.mark.thorough
def test_a_slow_run_has_no_warm_up_and_is_otherwise_the_whole_program():
    plan = built(Commissioning(speed=0.1), **MEASURED_WELL)
    assert kinds(plan) == {"payload", "weigh", "move", "dwell", "reference"}
    assert plan.waypoints == 6
    assert {step.load for step in plan} == {0, 1}


@pytest.mark.thorough
def test_a_short_run_has_neither_warm_up_nor_reference_nor_payload_check():
    plan = built(Commissioning(first=2), **MEASURED_WELL)
    assert kinds(plan) == {"payload", "move", "dwell"}
    assert plan.waypoints == 2
    assert plan.whole == 12  # six poses with each of two loads


@pytest.mark.thorough
def test_a_short_run_begins_with_the_pose_that_is_nearest_to_the_arm():
    here = np.radians([0, -90, 0, -90, 0, 0])
    whole = built(None, start_q=here)
    ways = [
        (np.abs(step.motion.q_end - here).max(), step.pose)
        for step in whole
        if step.kind == "dwell"
    ]
    short = built(Commissioning(first=1), start_q=here)
    assert {step.pose for step in short if step.kind == "dwell"} == {min(ways)[1]}
    assert short.duration_s < 5.0


@pytest.mark.thorough
def test_a_run_at_full_speed_that_is_cut_after_some_seconds_is_as_short():
    here = np.radians([0, -90, 0, -90, 0, 0])
    plan = built(Commissioning(first_s=12.0), start_q=here, warm_up={"duration_s": 60})
    assert 1 <= plan.waypoints < 6
    assert plan.duration_s <= 12.0


@pytest.mark.thorough
def test_every_motion_of_a_commissioning_plan_begins_where_the_one_before_it_ended():
    for part in (Commissioning(speed=0.1), Commissioning(first=3)):
        motions = built(part, **MEASURED_WELL).motions
        for one, next_ in pairwise(motions):
            assert one.q_end == pytest.approx(next_.q_start, abs=1e-9)


@pytest.mark.thorough
def test_margins_are_those_of_the_motions_that_are_executed():
    whole, slow = built(None), built(Commissioning(speed=0.1))
    assert slow.margins["robot_velocity_rad_s"] > whole.margins["robot_velocity_rad_s"]


@pytest.mark.thorough
def test_a_commissioning_plan_is_not_blamed_for_what_only_a_fit_needs():
    shown = preview(built(Commissioning(first=1), **MEASURED_WELL))
    assert shown.warnings == ()


@pytest.mark.usefixtures("plans_once")
@pytest.mark.thorough
def test_plan_shows_exactly_what_the_run_with_the_same_options_does(tmp_path):
    options = ("--speed-scale", "50%", "--limit", "2", "--set", "excitation.seed=5")
    picture = ("--picture", tmp_path / "plan.svg")
    planned = json.loads(hil("plan", DWELL, *options, *picture, "--json").stdout)
    done = hil("run", DWELL, *options, "--runs", tmp_path)
    assert done.returncode == 0, done.stderr
    (start,) = tmp_path.glob("*/ur5/*/start.json")
    assert json.loads(start.read_text())["plan_hash"] == planned["hash"]
    assert planned["swept"]["duration_s"] == planned["duration_s"]
    assert len(planned["swept"]["joints"]) == 6


@pytest.mark.thorough
def test_time_ranges_and_boxes_are_printed_before_anything_moves(tmp_path):
    said = hil("run", DWELL, "--speed-scale", "50%", "--limit", "1", "--runs", tmp_path).stderr
    (plan,) = tmp_path.glob("*/ur5/*/plan.json")
    expected = swept(read_plan(plan), load_arm("ur5")).lines()
    lines = [line.strip() for line in said.splitlines()]
    begins = next(i for i, line in enumerate(lines) if line.startswith("running "))
    first = lines.index("this run sweeps") + 1
    assert lines[first : first + len(expected)] == expected
    assert first < begins


@pytest.mark.thorough
def test_plan_prints_ranges_and_boxes(tmp_path):
    said = hil("plan", DWELL, "--speed-scale", "50%", "--picture", tmp_path / "plan.svg").stdout
    names = {line.split("  ")[0] for line in said.splitlines()}
    assert {"duration", "elbow_joint", "flange x", "flange z", "elbow y"} <= names


@pytest.mark.thorough
def test_a_commissioning_run_says_so_and_is_not_judged(tmp_path):
    asked = ("run", DWELL, "--runs", tmp_path, "--json")
    done = hil(*asked, "--speed-scale", "50%", "--limit", "2")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["outcome"], said["verdict"]) == ("completed", "not judged")
    start = json.loads((Path(said["run"]) / "start.json").read_text())
    part = "at 50 % of the speed, only the first 2 of 12 measured"
    assert start["commissioning"]["text"] == part
    assert part in Path(said["report"]).read_text()
    shown = " ".join(hil("show", said["run"]).stdout.split())
    assert (
        f"This is a commissioning run ({part}); commissioning runs are neither fitted nor judged."
        in shown
    )
    assert shown.endswith(f"next: hil run {DWELL} --speed-scale 50%")
    assert "hil fit" not in shown
    rows = read_topic(Path(said["run"]) / "recording" / "00.mcap")
    assert np.abs(rows["qd_target"]).max() <= np.radians(60) * 0.5 + 1e-6
    again = hil("resume", said["run"])
    assert again.returncode == 8
    assert "commissioning" in again.stderr
