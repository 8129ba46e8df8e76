"""A process that did not run for a while: one end of the run, whatever is found wrong first."""

from __future__ import annotations

import time

import pytest

from hil.core.errors import (
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
    exit_code_of,
)
from hil.core.typing import StructArray
from hil.engine import Outcome, watchdog
from hil.robot import Capabilities, Segment
from hil.robot.protocol import ClockKind
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot


class Suspended(KinematicRobot):
    """This process is suspended in the middle of one of its calls.

    Args:
        seconds: For so long; only the watchdog's clock knows it.
        error: What the driver finds wrong after it.
        call: `read` during the first move, or `prepare` after it.
        clock: Of the robot.
        blocks: Read without an error after it.
    """

    slept_s = 0.0

    def __init__(
        self,
        seconds: float,
        error: HilError | None = None,
        call: str = "read",
        clock: ClockKind = "wall",
        blocks: int = 0,
    ) -> None:
        super().__init__()
        self._blocks = blocks
        self._seconds, self._error, self._call, self._clock = seconds, error, call, clock

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(super().capabilities.joint_names, 125.0, "current", clock=self._clock)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        self._sleep("read")
        return super().read(timeout_s)

    def prepare(self, segment: Segment) -> None:
        self._sleep("prepare")
        super().prepare(segment)

    def _sleep(self, call: str) -> None:
        if call != self._call or self._segment != 1:
            return
        Suspended.slept_s += self._seconds
        self._seconds = 0.0
        if self._error is not None and self._blocks == 0:
            raise self._error
        if self._blocks > 0:
            self._blocks -= 1
            Suspended.slept_s += 0.4  # less than a gap


@pytest.fixture(autouse=True)
def _clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "now_s", lambda: time.monotonic() + Suspended.slept_s)


@pytest.mark.parametrize(
    "error",
    [
        None,
        RobotTimeout("the driver has not answered read within 2.0 s"),
        RobotConnectionError("the arm moved and was not read for 10.0 s"),
        RobotFault("protective stop"),
        StaleState("the controller has not said anything"),
    ],
    ids=["nothing", "timeout", "connection", "fault", "stale"],
)
def test_it_ends_the_run_in_one_way_whatever_is_found_wrong_first(error: HilError | None) -> None:
    robot = Suspended(10.0, error)
    result = engine(robot, ListSink()).run()
    assert result.outcome is Outcome.TRIPPED
    assert result.error is not None
    assert exit_code_of(result.error) == 5
    assert "this process did not run for 10.0 s" in result.reason
    assert "driver" not in result.reason
    assert "stop" in robot.calls
    if error is not None:
        assert any(error.message in note for note in result.notes)


def test_a_short_one_explains_a_silence_but_hides_no_fault() -> None:
    silent = engine(Suspended(1.0, RobotTimeout("no answer")), ListSink()).run()
    assert "this process did not run for 1.0 s" in silent.reason
    fault = engine(Suspended(1.0, RobotFault("protective stop")), ListSink()).run()
    assert fault.reason.startswith("protective stop")
    assert "this process did not run for 1.0 s just before the end" in fault.notes


def test_a_short_one_does_not_explain_the_silence_of_a_robot_that_was_heard_again() -> None:
    error = RobotConnectionError("the cable was pulled")
    result = engine(Suspended(0.6, error, blocks=4), ListSink()).run()
    assert result.reason.startswith("the cable was pulled")


def test_a_short_one_without_consequence_does_not_end_the_run() -> None:
    assert engine(Suspended(1.0), ListSink()).run().outcome is Outcome.COMPLETED


def test_a_library_that_keeps_the_interpreter_while_the_arm_stands_is_none() -> None:
    result = engine(Suspended(10.0, call="prepare"), ListSink()).run()
    assert result.outcome is Outcome.COMPLETED


def test_on_a_virtual_clock_nothing_moves_meanwhile() -> None:
    result = engine(Suspended(10.0, clock="virtual"), ListSink()).run()
    assert result.outcome is Outcome.COMPLETED
