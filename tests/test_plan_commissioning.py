"""Commissioning: the same plan, slower and shorter, and said so."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil.errors import PlanError, SpecError
from hil.excite.motion import FourierSeries, Hold, Line
from hil.payload import Payload
from hil.plan.commissioning import Commissioning, commissioning_of
from hil.plan.plan import LoadStep, Plan, Step
from hil.record.reader import read_topic

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


@pytest.mark.parametrize("motion", [line(), SERIES])
def test_a_slower_motion_has_the_same_path(motion):
    slow = Commissioning(speed=0.1).of(plan_of(Step(0, "trajectory", motion))).steps[0].motion
    fast, slower = motion.sample(1000.0), slow.sample(100.0)
    assert slow.duration_s == pytest.approx(10 * motion.duration_s, rel=0.05)
    same = np.array([np.abs(fast.q - q).max(axis=1).min() for q in slower.q])
    assert same.max() < 2e-3
    assert slow.q_start == pytest.approx(motion.q_start)
    assert slow.q_end == pytest.approx(motion.q_end)


def test_speed_acceleration_and_jerk_shrink_as_time_stretches():
    slow = Commissioning(speed=0.5).of(plan_of(Step(0, "trajectory", SERIES))).steps[0].motion
    fast, slower = SERIES.sample(1000.0), slow.sample(1000.0)
    assert np.abs(slower.qd).max() == pytest.approx(0.5 * np.abs(fast.qd).max(), rel=1e-3)
    assert np.abs(slower.qdd).max() == pytest.approx(0.25 * np.abs(fast.qdd).max(), rel=1e-3)


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
    with pytest.raises(PlanError, match="nothing is measured"):
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
    assert str(Commissioning(first=2).within(dwells(3))) == "only the first 2 of 3 measured"
    assert str(Commissioning(first=9).within(dwells(3))) == "only the first 3 of 3 measured"


def hil(*arguments):
    command = [sys.executable, "-m", "hil", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def test_a_commissioning_run_says_so_and_is_not_judged(tmp_path):
    asked = ("run", "experiments/ci_dwell_12.yaml", "--runs", tmp_path, "--json")
    done = hil(*asked, "--speed", "50%", "--first", "2")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert (said["outcome"], said["verdict"]) == ("completed", "not judged")
    start = json.loads((Path(said["run"]) / "start.json").read_text())
    part = "at 50 % of the speed, only the first 2 of 12 measured"
    assert start["commissioning"]["text"] == part
    assert part in Path(said["report"]).read_text()
    shown = " ".join(hil("show", said["run"]).stdout.split())
    assert (
        f"It is of a commissioning run, {part}: such runs are neither fitted nor judged." in shown
    )
    spec = Path("experiments/ci_dwell_12.yaml").resolve()
    assert shown.endswith(f"next: hil run {spec} --speed 50%")
    assert "hil fit" not in shown
    rows = read_topic(Path(said["run"]) / "recording" / "00.mcap")
    assert np.abs(rows["qd_target"]).max() <= np.radians(60) * 0.5 + 1e-6
    again = hil("resume", said["run"])
    assert again.returncode == 8
    assert "commissioning" in again.stderr
