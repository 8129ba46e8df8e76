"""A driver that hangs takes neither the arm nor the run's end with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from hil.core.errors import RobotTimeout
from hil.core.typing import StructArray
from hil.engine import Outcome, watchdog
from hil.robot import Capabilities
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot


class WallRobot(KinematicRobot):
    """Lives in wall time, and hangs in `read` or `prepare` once a segment has begun."""

    def __init__(self, hangs_in: str) -> None:
        super().__init__()
        self.hangs_in, self.free = hangs_in, threading.Event()

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(super().capabilities.joint_names, 125.0, "current", clock="wall")

    def read(self, timeout_s: float = 1.0) -> StructArray:
        on_main_line = threading.current_thread().name == "hil-the control loop"
        if self.hangs_in == "read" and self._segment == 1 and on_main_line:
            self.free.wait(20)
        return super().read(timeout_s)

    def prepare(self, segment: object) -> None:
        if self.hangs_in == "prepare" and self._segment == 1:
            self.free.wait(20)
        super().prepare(segment)  # type: ignore[arg-type]


@pytest.mark.thorough
@pytest.mark.parametrize("call", ["read", "prepare"])
def test_a_call_that_never_returns_ends_the_run_and_commands_nothing_later(
    monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    monkeypatch.setattr("hil.engine.engine.COMMAND_WITHIN_S", 0.3)
    monkeypatch.setattr(watchdog.Watchdog.__init__, "__kwdefaults__", {"limit_s": 0.3, "on": True})
    robot, sink = WallRobot(call), ListSink()
    begin = time.monotonic()
    result = engine(robot, sink).run()
    assert time.monotonic() - begin < 5
    assert result.outcome is Outcome.FAILED
    assert isinstance(result.error, RobotTimeout)
    assert "stop" in robot.calls
    told = [c for c in robot.calls if c == "start"]
    robot.free.set()
    time.sleep(0.3)
    assert [c for c in robot.calls if c == "start"] == told


SCRIPT = """
import os, signal, sys, time
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot
from hil.engine.signals import SignalWatch

class Stuck(KinematicRobot):
    def stop(self):
        time.sleep(30)

robot = Stuck()
with SignalWatch() as watch, watch.guard():
    running = engine(robot, ListSink())
    watch.bind(running, robot)
    begun = []

    def press(block):
        if not begun and (block["segment"] == 1).any():
            begun.append(1)
            print("moving", flush=True)
            for _ in range(3):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.05)

    robot.disturb = press
    running.run()
"""


@pytest.mark.thorough
def test_the_third_signal_ends_the_process_although_stop_hangs() -> None:
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=25, check=False
    )
    assert done.returncode == 130, done.stderr
    assert "moving" in done.stdout
    assert time.monotonic() - begin < 20


def test_a_pause_asked_for_elsewhere_does_not_count_as_a_signal() -> None:
    from hil.engine.signals import SignalWatch

    robot, sink = KinematicRobot(), ListSink()
    with SignalWatch() as watch, watch.guard():

        def go_on() -> str:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
            return ""

        running = engine(robot, sink, go_on=go_on)
        watch.bind(running, robot)
        running.request_pause("hil pause")
        result = running.run()
    assert result.outcome is Outcome.STOPPED
