"""Connecting to a UR controller that is not idle, or is strict; what preflight says of it."""

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

from hil.core.errors import CommandRefused, HilError, RobotFault
from hil.robot import HasChecks, Segment
from hil.testing.moves import begin, follow, move, standing_at
from hil_drivers.ur.robot import UrRobot
from tests.support.mock_servers import mock_ur
from tests.support.paths import EXPERIMENTS
from tests.support.waiting import until

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]

SLOW = {"late_s": 2.0, "lag_s": 1.0, "watchdog_hz": 0.5}


def ur5(running, **options):
    return UrRobot("arm", "ur5", **({"address": running.address} | SLOW | options))


@contextlib.contextmanager
def robot_on(running, **options):
    robot = ur5(running, **options)
    try:
        robot.connect()
        yield robot
    finally:
        with contextlib.suppress(HilError):
            robot.close()


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
        asked = time.monotonic()
        with pytest.raises(RobotFault, match=said) as caught:
            ur5(running, watchdog_hz=2.0).connect()
        assert time.monotonic() - asked < 5.0
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
        assert "no difference between local and remote" in told["remote-control"].message
        assert told["software"].measured == "3.15.8.106339"
        assert told["payload"].message.startswith("payload 0.000 kg at")
        assert "as wide as the maker's" in told["joint-limits"].message
        assert told["watchdog"].message == "watchdog armed at 2 Hz in our program, which is playing"
        assert told["speed-slider"].measured == 1.0


@pytest.mark.proof
def test_the_lines_are_in_the_runs_preflight_and_on_the_console(tmp_path):
    with mock_ur("--speed", "4") as running:
        station = yaml.safe_load((EXPERIMENTS / "stations" / "ur5_rtde_mock.yaml").read_text())
        station["robots"]["ur5"]["options"] |= {"address": running.address}
        station["robots"]["ur5"]["own_process"] = True
        path = tmp_path / "station.yaml"
        path.write_text(yaml.safe_dump(station))
        asked = ("run", EXPERIMENTS / "ci_dwell_12.yaml", "--station", path, "--first", "1")
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
