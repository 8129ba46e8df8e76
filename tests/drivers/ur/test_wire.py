"""The UR driver by unmodified `ur-rtde` on the mock controller: connecting, moving, stopping."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, HilError, RobotConnectionError, RobotFault, SpecError
from hil.excitation.motion import Line
from hil.robot import HasChecks, Segment, Status
from hil.testing.moves import begin, follow, hold, move, settle, standing_at
from hil_drivers.ur.dashboard import end_program
from hil_drivers.ur.options import Options
from hil_drivers.ur.robot import UrRobot
from hil_drivers.ur.state import TOPIC
from tests.support.in_time import InTime, measured_again
from tests.support.mock_servers import mock_ur
from tests.support.paths import EXPERIMENTS
from tests.support.waiting import until

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]

SLOW = {"late_s": 2.0, "lag_s": 1.0, "watchdog_hz": 0.5}
"""For a machine that is shared with other work."""

STOP_S = 0.1
SPEED_OF_STOP = {"move": 6.0, "trajectory": 1.0}
SEEN_S = 0.3
"""Deceleration [rad/s²], the least that 10 m/s² at the tool can be here; and until rest is seen."""


@pytest.fixture(scope="module")
def mock():
    with mock_ur() as running:
        yield running


@contextlib.contextmanager
def robot_on(running, model="ur5", **options):
    robot = UrRobot("arm", model, **({"address": running.address} | SLOW | options))
    try:
        robot.connect()
        yield robot
    finally:
        with contextlib.suppress(HilError):
            robot.close()


@pytest.fixture(scope="module")
def driven():
    """A controller that `robot` has all the time."""
    with mock_ur() as running:
        yield running


@pytest.fixture(scope="module")
def connected(driven):
    with robot_on(driven) as made:
        yield made


@pytest.fixture
def robot(connected):
    """Connected and at rest, with nothing left to read; for tests that leave it so."""
    settle(connected)
    connected.drain()
    return connected


def trajectory(robot, way=0.3, seconds=2.0, index=40):
    """From rest to rest and back, led along."""
    q = standing_at(robot)
    rate = robot.capabilities.rate_hz
    goal = q.copy()
    goal[-1] += way
    ends = tuple(q.tolist()), tuple(goal.tolist())
    samples = Line(*ends, 2 * abs(way) / seconds, 4.0, jerk=40.0, rate_hz=rate).sample(rate)
    speed, acceleration = np.abs(samples.qd).max(), np.abs(samples.qdd).max()
    return Segment(
        index, "trajectory", samples.q, samples.qd, samples.qdd, float(speed), float(acceleration)
    )


def until_it_raises(robot, within_s=20.0):
    """Read until something is wrong; returns it, and the rows before."""
    rows, until = [], time.monotonic() + within_s
    while time.monotonic() < until:
        try:
            rows.append(robot.read())
        except HilError as error:
            return error, np.concatenate(rows) if rows else None
    raise AssertionError("nothing was wrong")


def wait_for(running, event, after, within_s=5.0):
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        with contextlib.suppress(AssertionError):
            return first(running.journal(), event, after)
        time.sleep(0.05)
    return first(running.journal(), event, after)


def first(journal, event, after=0.0, **details):
    for line in journal:
        late_enough = line["event"] == event and line["monotonic_s"] >= after
        if late_enough and all(line.get(key) == value for key, value in details.items()):
            return line
    raise AssertionError(f"no {event} {details} in {[line['event'] for line in journal][-30:]}")


@pytest.mark.journey
def test_every_state_of_the_controller_arrives_once(robot):
    rows = [robot.read()]
    while sum(map(len, rows)) < 250:
        rows.append(robot.read())
    times = np.concatenate(rows)["device_time"]
    assert np.diff(times) == pytest.approx(0.008)
    further = robot.drain()[TOPIC]
    assert len(further) == len(times)
    assert further["device_time"] == pytest.approx(times)


def test_it_says_which_arm_it_is(robot, driven):
    who = robot.identity
    assert (who.model, who.serial.isdigit(), who.firmware) == ("ur5", True, "3.15.8.106339")
    assert who.details["torque_source"] == "current"
    assert robot.resource == f"ur://{driven.address}"


def test_a_trajectory_is_followed_to_its_end(robot):
    asked = trajectory(robot)
    mine = follow(robot, asked)
    assert mine[-1]["q"] == pytest.approx(asked.q[-1], abs=5e-3)
    # It is followed late, not beside the way.
    assert mine["q"][:, -1].max() < asked.q[:, -1].max() + 5e-3
    seconds = mine["device_time"][-1] - mine["device_time"][0]
    assert seconds == pytest.approx(len(asked.q) / 125, abs=1.5)


def test_moves_may_be_led_and_the_next_one_may_be_the_controllers(mock):
    with robot_on(mock, moves="servoj") as led:
        asked = move(led, 0.1)
        assert follow(led, asked)[-1]["q"] == pytest.approx(asked.q[-1], abs=5e-3)
    with robot_on(mock) as own:
        asked = move(own, 0.1)
        assert follow(own, asked)[-1]["q"] == pytest.approx(asked.q[-1], abs=5e-3)


def test_a_move_to_where_it_stands_is_over_at_once(robot):
    here = standing_at(robot)[None]
    zeros = np.zeros_like(here)
    mine = follow(robot, Segment(50, "move", here, zeros, zeros, 0.0, 0.0))
    assert not mine[-1]["status"] & Status.MOVING


@pytest.mark.journey
def test_trajectories_moves_and_holds_follow_each_other(robot):
    for make in (lambda r: trajectory(r, 0.1), lambda r: move(r, 0.1), hold, hold, trajectory):
        follow(robot, make(robot))


def test_a_load_is_read_back_and_one_that_is_too_heavy_refused(robot):
    declared = Payload(2.0, (0.0, 0.0, 0.05))
    assert declared.agrees_with(robot.set_payload(declared))
    with pytest.raises(CommandRefused, match="too heavy"):
        robot.set_payload(Payload(20.0))
    robot.set_payload(Payload())


def test_a_load_is_not_changed_while_the_arm_moves(robot):
    begin(robot, move(robot, 0.4))
    with pytest.raises(CommandRefused, match="moving"):
        robot.set_payload(Payload(1.0))
    robot.stop()
    settle(robot)


def test_what_an_idle_arm_did_while_nobody_read_is_let_go_of(robot):
    robot.read()
    time.sleep(6.0)
    assert len(robot.read()) < 5.5 * 125


def test_a_torque_source_the_controller_does_not_have_is_refused():
    with mock_ur("--model", "ur5e") as running:
        robot = UrRobot(
            "arm", "ur5e", address=running.address, torque_source="current-as-torque", **SLOW
        )
        with pytest.raises(SpecError, match="current-as-torque"):
            robot.connect()
        with robot_on(running, "ur5e") as connected:
            assert connected.capabilities.rate_hz == 500
            asked = move(connected, 0.1)
            assert follow(connected, asked)[-1]["q"] == pytest.approx(asked.q[-1], abs=5e-3)
            declared = Payload(1.0, (0.0, 0.0, 0.05), (0.01, 0.01, 0.01, 0.0, 0.0, 0.0))
            assert connected.set_payload(declared).inertia == pytest.approx(declared.inertia)
            asked = trajectory(connected, 0.1, 1.0)
            assert follow(connected, asked)[-1]["q"] == pytest.approx(asked.q[-1], abs=5e-3)


def test_another_arm_than_the_stations_is_refused(mock):
    with pytest.raises(RobotConnectionError, match="CB3 controller"):
        UrRobot("arm", "ur5e", address=mock.address).connect()
    with pytest.raises(RobotConnectionError, match="moves a UR5"):
        UrRobot("arm", "ur10", address=mock.address).connect()


def test_nobody_there_is_told_with_what_to_look_at():
    with pytest.raises(RobotConnectionError, match="29999") as caught:
        UrRobot("arm", "ur5", address="127.0.0.254").connect()
    assert caught.value.hint


def test_a_second_driver_is_told_that_somebody_drives_the_arm(driven, robot):
    with pytest.raises(RobotFault, match="a program is running"):
        UrRobot("arm", "ur5", address=driven.address, **SLOW).connect()
    follow(robot, move(robot, 0.05))


def test_local_control_is_refused_before_anything_is_uploaded():
    with mock_ur("--model", "ur5e", "--local") as running:
        with pytest.raises(RobotFault, match="local control"):
            UrRobot("arm", "ur5e", address=running.address).connect()
        assert running.side("state")["program"] is None


MOTIONS = {"move": lambda r: move(r, 0.4), "trajectory": lambda r: trajectory(r, 0.5, 3.0)}


@pytest.mark.parametrize("kind", MOTIONS)
@measured_again
def test_a_stop_is_on_the_wire_within_a_tenth_of_a_second(kind, tmp_path):
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running) as robot:
        begin(robot, MOTIONS[kind](robot))
        asked = InTime(robot._motion.pid, running.process.pid)
        robot.stop()
        took = asked.taken()
        settle(robot)
        journal = running.journal()
        stop = first(journal, "stop", after=asked.at)
        assert stop["by"] == {"move": "stopj", "trajectory": "servo_stop"}[kind]
        assert not [
            e for e in journal if e["event"] == "start" and e["monotonic_s"] > stop["monotonic_s"]
        ]
        rest = wait_for(running, "rest", after=asked.at)
        ramp_s = 0.5 / SPEED_OF_STOP[kind]
        assert rest["device_time"] - stop["device_time"] < ramp_s + SEEN_S
        took.require(STOP_S)
        took.require(STOP_S, stop["monotonic_s"] - asked.at)


@pytest.mark.parametrize("kind", MOTIONS)
@measured_again
def test_a_motion_process_that_is_killed_does_not_keep_the_arm_from_being_stopped(kind, tmp_path):
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running) as robot:
        begin(robot, MOTIONS[kind](robot))
        os.kill(robot._motion.pid, signal.SIGKILL)
        asked = InTime(running.process.pid)
        robot.stop()
        took = asked.taken()
        stop = wait_for(running, "stop", after=asked.at)
        assert (stop["by"], stop["via"]) == ("hil_stop", "script")
        error, _ = until_it_raises(robot)
        assert isinstance(error, RobotConnectionError)
        settle(robot)
        robot.connect()
        follow(robot, move(robot, 0.1))
        took.require(STOP_S)
        took.require(STOP_S, stop["monotonic_s"] - asked.at)


def hang(pid):
    """On a busy computer the signal takes some milliseconds until all threads have heard of it."""
    os.kill(pid, signal.SIGSTOP)
    until = time.monotonic() + 5.0
    states = Path(f"/proc/{pid}/task")
    while time.monotonic() < until:
        said = [(task / "stat").read_text().rpartition(")")[2] for task in states.iterdir()]
        if all(state.split()[0] == "T" for state in said):
            return
        time.sleep(0.001)
    raise AssertionError("it goes on")


@measured_again
def test_a_motion_process_that_hangs_does_not_either(tmp_path):
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running) as robot:
        begin(robot, move(robot, 0.4))
        hang(robot._motion.pid)
        try:
            asked = InTime(running.process.pid)
            robot.stop()
            took = asked.taken()
            stop = wait_for(running, "stop", after=asked.at)
            assert stop["by"] == "hil_stop"
        finally:
            os.kill(robot._motion.pid, signal.SIGCONT)
        settle(robot)
        with pytest.raises(RobotFault, match="replaced"):
            robot.prepare(move(robot, 0.1))
        robot.connect()
        follow(robot, move(robot, 0.1))
        took.require(STOP_S)
        took.require(STOP_S, stop["monotonic_s"] - asked.at)


FAST_RAD_S = 2.9
FAST = {
    "move": lambda r: turn(r, "move"),
    "trajectory": lambda r: turn(r, "trajectory"),
}


def turn(robot, kind, way=4.0):
    """The last joint turned at nearly full speed."""
    q = standing_at(robot)
    goal = q.copy()
    goal[-1] += way if q[-1] < 0 else -way
    rate = robot.capabilities.rate_hz
    line = Line(tuple(q.tolist()), tuple(goal.tolist()), FAST_RAD_S, 6.0, jerk=60.0, rate_hz=rate)
    samples = line.sample(rate)
    return Segment(41, kind, samples.q, samples.qd, samples.qdd, FAST_RAD_S, 6.0)


@pytest.mark.parametrize("kind", FAST)
@measured_again
def test_a_stop_out_of_full_speed_is_over_before_the_watchdog_bites(kind, tmp_path):
    usual = {"watchdog_hz": Options("").watchdog_hz}
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running, **usual) as robot:
        begin(robot, FAST[kind](robot))
        while max(map(abs, running.side("state")["qd_target"])) < 0.98 * FAST_RAD_S:
            robot.read()
        asked = InTime(robot._motion.pid, running.process.pid)
        robot.stop()
        took = asked.taken()
        settle(robot)
        time.sleep(1.0)
        said = [e["event"] for e in running.journal() if e["monotonic_s"] > asked.at]
        assert not {"watchdog", "program_stopped"} & set(said), said
        stop = first(running.journal(), "stop", after=asked.at)
        follow(robot, move(robot, 0.1))
        took.require(STOP_S, stop["monotonic_s"] - asked.at)


@pytest.mark.parametrize("kind", MOTIONS)
def test_a_library_that_connects_again_by_itself_has_nothing_left_to_command(kind, tmp_path):
    """Only its connection ends, ours tells on: it would repeat what it was about to command."""
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running) as robot:
        begin(robot, MOTIONS[kind](robot))
        pid = robot._motion.pid
        running.side("fault", kind="cut", only="inputs")
        error, _ = until_it_raises(robot)
        assert isinstance(error, HilError)
        with contextlib.suppress(RobotConnectionError):
            robot.stop()
        time.sleep(1.5)
        assert not robot._motion.alive, pid
        journal = running.journal()
        began = first(journal, "fault", kind="cut")["monotonic_s"]
        after = [e for e in journal if e["monotonic_s"] > began]
        stops = [e for e in after if e["event"] in ("stop", "watchdog", "program_stopped")]
        assert stops, after
        late = [e for e in after if e["monotonic_s"] > stops[0]["monotonic_s"]]
        assert not [e for e in late if e["event"] == "start"], late
        assert max(map(abs, running.side("state")["qd_target"])) < 1e-6
        # The library may have uploaded its program once more before its process ended: an idle
        # one, which connecting refuses to take for ours. A person stops it at the pendant.
        if running.side("state")["program"] is not None:
            with pytest.raises(RobotFault, match="a program is running"):
                robot.connect()
            end_program(running.address)
        robot.connect()
        follow(robot, move(robot, 0.1))


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize(
    ("fault", "said"), [("protective_stop", "protective stop"), ("emergency_stop", "emergency")]
)
def test_a_stop_of_the_controllers_is_a_fault_with_the_remedy(kind, fault, said, tmp_path):
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running) as robot:
        begin(robot, MOTIONS[kind](robot))
        running.side("fault", kind=fault)
        error, rows = until_it_raises(robot)
        assert isinstance(error, RobotFault)
        assert said in error.message
        assert error.hint
        assert rows[-1]["status"] & Status.FAULT
        robot.stop()
        settle(robot)
        with pytest.raises(RobotFault, match="accepts no commands"):
            robot.prepare(move(robot, 0.1))
        with pytest.raises(RobotFault, match=said):
            robot.connect()


def test_after_a_protective_stop_was_unlocked_it_moves_again(tmp_path):
    with mock_ur("--speed", "4") as running, robot_on(running) as robot:
        begin(robot, move(robot, 0.4))
        running.side("fault", kind="protective_stop")
        until_it_raises(robot)
        robot.stop()
        settle(robot)
        # The controller refuses to unlock in the first 5 s, by its own clock.
        unlockable = running.side("state")["device_time"] + 5.5
        while running.side("state")["device_time"] < unlockable:
            time.sleep(0.05)
        running.side("clear")
        dashboard(running.address, "unlock protective stop")
        time.sleep(0.3)
        robot.connect()
        here = standing_at(robot)
        time.sleep(0.5)
        assert standing_at(robot) == pytest.approx(here, abs=1e-3), "the old motion goes on"
        follow(robot, move(robot, 0.1))


def dashboard(address, command):
    with socket.create_connection((address, 29999), 5.0) as line:
        file = line.makefile("rw", newline="\n")
        file.readline()
        file.write(f"{command}\n")
        file.flush()
        return file.readline().strip()


@pytest.mark.parametrize("kind", MOTIONS)
def test_a_program_that_somebody_stops_is_a_fault(kind):
    with mock_ur() as running, robot_on(running) as robot:
        begin(robot, MOTIONS[kind](robot))
        dashboard(running.address, "stop")
        error, _ = until_it_raises(robot)
        assert isinstance(error, RobotFault)
        assert "program" in error.message
        robot.stop()
        settle(robot)
        robot.connect()
        follow(robot, move(robot, 0.1))


KNOWN_S = {"cut": 0.1, "silence": 0.3 + 0.1, "unplugged": 1 / SLOW["watchdog_hz"] + 0.1}
"""When whoever can stop the arm knows of it: at once, after late_s, after the watchdog's period."""

BUSY_S = 0.3


@pytest.mark.parametrize(
    ("kind", "fault"),
    [
        # One kind of motion each; the others take longer: `proof`.
        pytest.param(kind, fault, marks=() if (i + j) % 2 == 0 else pytest.mark.proof)
        for i, kind in enumerate(MOTIONS)
        for j, fault in enumerate(KNOWN_S)
    ],
)
@measured_again
def test_a_lost_connection_stops_the_arm_and_no_motion_is_commanded_any_more(kind, fault, tmp_path):
    with mock_ur(journal=tmp_path / "journal") as running, robot_on(running, late_s=0.3) as robot:
        begin(robot, MOTIONS[kind](robot))
        began = time.monotonic()
        running.side("fault", kind=fault)
        error, _ = until_it_raises(robot)
        asked = InTime(running.process.pid)
        with contextlib.suppress(RobotConnectionError):
            robot.stop()
        took = asked.taken()
        assert isinstance(error, HilError)
        time.sleep(3.0)
        running.side("clear")
        journal = running.journal()
        after = journal[journal.index(first(journal, "fault", began, kind=fault)) :]
        stops = [e for e in after if e["event"] in ("stop", "watchdog", "program_stopped")]
        assert stops, [e["event"] for e in journal]
        # By the controller's clock, which a busy computer holds up with all that it counts.
        assert stops[0]["device_time"] - after[0]["device_time"] < KNOWN_S[fault] + BUSY_S
        assert not [e for e in after[after.index(stops[0]) :] if e["event"] == "start"]
        state = running.side("state")
        assert max(map(abs, state["qd_target"])) < 1e-6
        robot.connect()
        follow(robot, move(robot, 0.05))
        took.require(STOP_S)


def test_a_load_the_controller_does_not_take_is_seen():
    with mock_ur() as running, robot_on(running) as robot:
        running.side("fault", kind="payload_refused")
        declared = Payload(2.0, (0.0, 0.0, 0.05))
        assert robot.set_payload(declared).mass == 0.0


def test_nothing_plays_after_closing(mock):
    with robot_on(mock) as robot:
        follow(robot, move(robot, 0.05))
    assert mock.side("state")["program"] is None


# Connecting to a UR controller that is not idle, or is strict; what preflight says of it.


def ur5(running, **options):
    return UrRobot("arm", "ur5", **({"address": running.address} | SLOW | options))


def pendant(running, *commands):
    with socket.create_connection((running.address, 29999), 5.0) as line:
        file = line.makefile("rw", newline="\n")
        file.readline()
        for command in commands:
            file.write(f"{command}\n")
            file.flush()
            file.readline()


def until_it_faults(robot):
    for _ in range(2000):
        try:
            robot.read()
        except RobotFault:
            return
    raise AssertionError("there is no fault")


@pytest.mark.parametrize(
    ("commands", "said", "runtime"),
    [
        (("load weld.urp", "play"), "a program is running", "PLAYING"),
        (("load weld.urp", "play", "pause"), "a program is paused", "PAUSED"),
    ],
)
def test_a_program_of_somebody_elses_is_left_alone_and_the_arm_refused(commands, said, runtime):
    with mock_ur() as running:
        pendant(running, *commands)
        with pytest.raises(RobotFault, match=said) as caught:
            ur5(running, watchdog_hz=2.0).connect()
        assert "teach pendant" in caught.value.hint
        state = running.side("state")
        assert (state["program"], state["runtime"]) == ("weld", runtime)
        pendant(running, "stop")
        with robot_on(running) as robot:
            follow(robot, move(robot, 0.05))


def test_an_arm_that_moves_is_not_taken_over():
    with mock_ur() as running:
        program = b"def swing():\n  movej([0,-1.2,0,-1.57,0,0], a=1, v=0.1)\nend\n"
        with running.connect(30001) as line:
            line.sendall(program)
            until(lambda: running.side("state")["motion"])
            with pytest.raises(RobotFault, match="the arm is moving") as caught:
                ur5(running, watchdog_hz=2.0).connect()
            assert "a program is running" in caught.value.message
            assert running.side("state")["motion"] is not None


def test_what_a_dead_session_has_left_behind_ends_by_its_watchdog():
    with mock_ur() as running:
        dead = ur5(running)
        dead.connect()
        begin(dead, move(dead, 0.4))
        os.kill(dead._motion.pid, signal.SIGKILL)
        with robot_on(running) as robot:
            here = standing_at(robot)
            time.sleep(0.3)
            assert standing_at(robot) == pytest.approx(here, abs=1e-3)
            follow(robot, move(robot, 0.05))
        dead.close()


def test_after_a_fault_the_programs_of_others_are_not_stopped():
    with mock_ur() as running, robot_on(running) as robot:
        begin(robot, move(robot, 0.4))
        pendant(running, "stop")
        until_it_faults(robot)
        until(lambda: not robot._motion.alive and running.side("state")["program"] is None)
        pendant(running, "load weld.urp", "play")
        assert running.side("state")["program"] == "weld"
        ended = robot.read()["device_time"][-1]
        while robot.read()["device_time"][-1] < ended + 3.5:
            pass
        robot.stop()
        robot.close()
        time.sleep(0.1)
        assert running.side("state")["program"] == "weld"


def test_limits_are_no_wider_than_the_controllers():
    maker = UrRobot("arm", "ur5", address="127.0.0.1").limits
    narrow = ("--joint-range-deg", "-170", "90", "--joint-speed-deg-s", "60")
    with mock_ur(*narrow) as running, robot_on(running) as robot:
        assert robot.limits.q_min == pytest.approx(np.full(6, np.radians(-170)))
        assert robot.limits.q_max == pytest.approx(np.full(6, np.radians(90)))
        assert robot.limits.qd_max == pytest.approx(np.full(6, np.radians(60)))
        assert (robot.limits.qdd_max == maker.qdd_max).all()
        told = {finding.name: finding for finding in robot.checks()}["joint-limits"]
        assert told.passed
        assert f"{np.radians(270):.3f} rad, {maker.qd_max[0] - np.radians(60):.3f} rad/s" in (
            told.message
        )
        beyond = np.linspace(standing_at(robot), np.full(6, np.radians(95)), 50)
        zeros = np.zeros_like(beyond)
        with pytest.raises(CommandRefused, match="joint range"):
            robot.prepare(Segment(1, "move", beyond, zeros, zeros, 0.5, 1.0))


def test_what_was_looked_at_is_told_with_the_figures():
    with mock_ur() as running, robot_on(running, watchdog_hz=2.0) as robot:
        assert isinstance(robot, HasChecks)
        told = {finding.name: finding for finding in robot.checks()}
        assert all(finding.passed for finding in told.values())
        assert told["mode"].message == "robot mode RUNNING"
        assert told["safety"].message == "safety mode NORMAL"
        assert "does not distinguish local and remote" in told["remote-control"].message
        assert told["software"].measured == "3.15.8.106339"
        assert told["payload"].message.startswith("payload 0.000 kg at")
        assert "as wide as the manufacturer's" in told["joint-limits"].message
        assert told["watchdog"].message == (
            "watchdog armed at 2 Hz in the robot program of hil, which is playing"
        )
        assert told["speed-slider"].measured == 1.0


@pytest.mark.proof
def test_the_lines_are_in_the_runs_preflight_and_on_the_console(tmp_path):
    with mock_ur("--speed", "4") as running:
        station = yaml.safe_load((EXPERIMENTS / "stations" / "ur5_rtde_mock.yaml").read_text())
        station["robots"]["ur5"]["options"] |= {"address": running.address}
        station["robots"]["ur5"]["own_process"] = True
        path = tmp_path / "station.yaml"
        path.write_text(yaml.safe_dump(station))
        asked = ("run", EXPERIMENTS / "ci_dwell_12.yaml", "--station", path, "--limit", "1")
        command = [sys.executable, "-m", "hil", *map(str, asked), "--runs", str(tmp_path), "--json"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-3000:]
    kept = json.loads((Path(json.loads(done.stdout)["run"]) / "preflight.json").read_text())
    names = {check["name"]: check for check in kept["checks"]}
    looked_at = ("mode", "safety", "remote-control", "software", "payload", "joint-limits",
                 "watchdog")  # fmt: skip
    for name in looked_at:
        assert names[f"robot-{name}"]["passed"]
        assert f"robot-{name}: {names[f'robot-{name}']['message']}" in done.stderr
