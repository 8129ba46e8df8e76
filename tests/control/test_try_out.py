"""A model tried on a simulated arm: what is refused, what is measured, and what is said of it."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.arms.payload import Payload
from hil.cli.app import app
from hil.control import controllers, try_out
from hil.control.controllers import Spring, spring_for
from hil.control.try_out import (
    Arm,
    improvement,
    judged,
    lead,
    leading_for,
    relief,
    require_simulated,
    track,
    trajectory_for,
    unaided,
)
from hil.control.try_out_report import found
from hil.core.errors import SpecError
from hil.dynamics import load_model
from hil.report.try_out_page import trial_page
from hil.robot import Capabilities, Identity, TorqueControlled, state_dtype
from hil.spec.station import StationRobot
from hil.studies.result import faults_of
from hil_mock_robot.plant.truth import draw_truth
from tests.support.trial_parts import (
    STATION,
    bench,
    model,
    model_folder,
    reference,
    short_trial,
    shorten,
    way,
)


class Recording:
    """A robot that only notes what it is told."""

    simulated = True

    def __init__(self, speed=0.0):
        self.identity = Identity("ur5", "x-1", "", "test")
        self.capabilities = Capabilities(("j",) * 6, 1000.0, "current", (1.0,) * 6)
        self.limits = SimpleNamespace(
            effort_max=load_model("ur5").effort_max, qd_max=np.full(6, 3.0)
        )
        self.told, self.speed = [], speed

    def command_torque(self, torque):
        self.told.append(torque)

    push = command_torque

    def read(self):
        row = np.zeros(1, state_dtype(6))
        row["qd"] = self.speed
        return row


@pytest.fixture
def station(tmp_path):
    path = tmp_path / "station.yaml"
    path.write_text(STATION, "utf-8")
    return path


@pytest.fixture(scope="module")
def trial():
    made, folder = short_trial()
    return made, found(made), trial_page(made), folder / "out"


def test_a_real_robot_is_refused_before_it_is_opened(station) -> None:
    with pytest.raises(SpecError, match="does not declare itself a simulated arm"):
        require_simulated("real", StationRobot(driver="ur", model="ur5"))


def test_a_robot_in_wall_time_is_refused(station) -> None:
    robot = StationRobot(driver="mock", model="ur5", options={"clock": "wall"})
    with pytest.raises(SpecError, match="wall time"):
        require_simulated("timed", robot)


def test_torque_stays_within_the_limits() -> None:
    robot = Recording()
    assert Arm(robot).step(np.array([1e4, -1e4, 5.0, 0.0, 0.0, 0.0]), np.ones(6))
    torque, push = robot.told
    assert torque.tolist() == [150.0, -150.0, 5.0, 0.0, 0.0, 0.0]
    assert push.tolist() == [1.0] * 6


def test_an_arm_that_is_too_fast_is_braked() -> None:
    robot = Recording(speed=4.0)
    assert not Arm(robot).step(np.zeros(6), np.ones(6))
    push, torque = robot.told[-2:]
    assert torque is None
    assert not push.any()


def test_a_torque_that_is_no_number_brakes_the_arm() -> None:
    with bench().arm(way().start) as arm:
        assert isinstance(arm._robot, TorqueControlled)
        assert not arm.step(np.array([0.0, np.nan, 0, 0, 0, 0]))
        for _ in range(100):
            arm.wait()
        assert arm.q == pytest.approx(way().start, abs=1e-3)


@pytest.mark.thorough
def test_tracking_ends_safely_when_the_arm_strays() -> None:
    asked, still = reference(), np.zeros(6)
    with bench().arm(asked.q[0]) as arm:
        laws_of = controllers.feed_forwards(model(), Payload(), asked, arm.gains)
        pushed = dict(laws_of)[controllers.GRAVITY] + [15.0, 0, 0, 0, 0, 0]
        run = track(arm, "wrong", pushed, asked, Spring(still, still))
    assert run.stopped.startswith("J1 was 20° off")
    assert np.isnan(run.rms).all()


def test_the_model_ahead_is_the_torque_the_true_arm_takes() -> None:
    asked = reference()
    gains = np.array([joint.drive.gain_nm_a for joint in draw_truth("ur5", 5).joints])
    ahead = dict(controllers.feed_forwards(model(), Payload(), asked, gains))
    assert list(ahead) == list(controllers.TOLD)
    assert not ahead[controllers.NOTHING].any()
    rigid = model().robot_.inverse_dynamics(asked.q, asked.qd, asked.qdd)
    assert np.array_equal(ahead[controllers.NOMINAL], rigid)
    at_rest = asked.t < 0
    assert ahead[controllers.MODEL][at_rest] == pytest.approx(
        ahead[controllers.GRAVITY][at_rest], abs=1e-6
    )


@pytest.mark.thorough
def test_a_load_is_part_of_every_law_but_none() -> None:
    asked, gains = reference(), np.ones(6)
    load = Payload(2.0, (0.0, 0.0, 0.05))
    bare = dict(controllers.feed_forwards(model(), Payload(), asked, gains))
    loaded = dict(controllers.feed_forwards(model(), load, asked, gains))
    more = {law: np.abs(loaded[law] - bare[law]).max() for law in controllers.TOLD}
    assert more[controllers.NOTHING] == 0.0
    assert min(more[law] for law in controllers.TOLD if law != controllers.NOTHING) > 0.5


def test_a_network_is_asked_at_the_rate_of_its_training(monkeypatch) -> None:
    asked = reference()
    whole = controllers.predicted(model(), Payload(), asked)
    monkeypatch.setattr("hil.control.controllers.rate_of", lambda model: 125.0)
    slower = controllers.predicted(model(), Payload(), asked)
    assert slower.shape == whole.shape
    assert not np.array_equal(slower, whole)
    assert np.abs(slower - whole)[asked.t < -0.01].max() < 1e-9
    assert np.abs(slower - whole).max() < 10.0


@pytest.mark.thorough
def test_the_hand_carries_an_arm_whose_drives_are_off(monkeypatch) -> None:
    shorten(monkeypatch)
    with bench().arm(way().start) as arm:
        hand = spring_for(model().robot_, way().start[None]).firmer(2.0)
        run = lead(arm, "drives off", None, way(), hand)
    gravity = np.abs(model().robot_.gravity(way().start[None])[0])
    assert run.rms[1] > 0.6 * gravity[1] > 10.0
    assert np.isfinite(run.rest_s)


@pytest.mark.thorough
def test_the_model_tracks_better_and_relieves_the_hand(trial) -> None:
    made, *_ = trial
    assert improvement(made) > 3.0
    assert np.mean(relief(made, try_out.FRICTION, try_out.NOTHING)) < 0.7
    assert np.all(relief(made, try_out.FRICTION, try_out.GRAVITY) < 0.95)
    assert not any(run.stopped for run in (*made.tracked, *made.led))


def test_the_page_and_the_tables_can_be_shown(trial) -> None:
    made, told, page, out = trial
    assert faults_of(told) == []
    assert page.key_figures[0].value.endswith("×")
    assert "plotly" in (out / "report.html").read_text("utf-8")
    document = json.loads((out / "try-out.json").read_text("utf-8"))
    assert [run["law"] for run in document["tracking"]] == list(controllers.TOLD)
    assert len(document["hand"]["led"][3]["rms_nm"]) == 6
    assert document["serial"] == made.serial == "arm-full-5"


def test_an_arm_that_never_rests_is_no_success(trial) -> None:
    made = trial[0]
    restless = replace(made.led[2], rest_s=float("inf"))
    worse = replace(made, led=(*made.led[:2], restless))
    assert trial_page(worse).badge.mark == "fail"
    assert "NOT AT REST with gravity" in found(worse).summary[0]
    assert not worse.ok


def test_a_braked_run_is_said_and_has_no_figures(trial) -> None:
    made = trial[0]
    braked = replace(made.tracked[-1], stopped="J2 was 20° off at 1.00 s")
    worse = replace(made, tracked=(*made.tracked[:-1], braked))
    assert trial_page(worse).badge.mark == "fail"
    assert "BRAKED, model: J2 was 20° off" in found(worse).summary[0]
    assert worse.to_dict()["tracking"][-1]["rms_rad"] == [None] * 6
    assert faults_of(found(worse)) == []


def test_a_braked_run_without_the_model_does_not_speak_against_it(trial) -> None:
    made = trial[0]
    braked = replace(made.tracked[0], stopped="J2 was 20° off at 1.00 s")
    other = replace(made, tracked=(braked, *made.tracked[1:]))
    assert [criterion.met for criterion in judged(other)][:3] == [True] * 3
    assert unaided(other) == controllers.NOMINAL
    assert any("Without the model, no model, the arm was braked" in t for t in found(other).summary)


@pytest.mark.thorough
def test_the_motions_keep_clear_and_within_limits() -> None:
    asked = trajectory_for(bench(), seed=3)
    robot = model().robot_
    assert np.all((asked.q > robot.q_min) & (asked.q < robot.q_max))
    assert not np.array_equal(asked.q, trajectory_for(bench(), seed=4).q)
    assert np.all(np.abs(leading_for(bench()).swing) >= np.radians(1.0))


def test_the_hand_moves_one_joint_at_a_time_then_all() -> None:
    led = way()
    assert np.flatnonzero(led.at(0.2)[1]).tolist() == [0]
    assert np.flatnonzero(led.at(led.turns_s - 0.2)[1]).tolist() == [5]
    assert np.all(led.at(led.release_s)[1] > 0)
    step = 1e-6
    slope = (led.at(1.13 + step)[0] - led.at(1.13 - step)[0]) / (2 * step)
    assert led.at(1.13)[1] == pytest.approx(slope, abs=1e-6)


def test_the_command_says_who_cannot_be_tried(station) -> None:
    done = CliRunner().invoke(
        app,
        ["try-out", str(model_folder()), "-o", str(station.parent / "out"), "--station",
         str(station), "--robot", "real"],
    )  # fmt: skip
    assert isinstance(done.exception, SpecError)
    assert "torque is commanded to simulated arms alone" in str(done.exception)
