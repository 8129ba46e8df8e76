"""A robot whose controller moves slower than planned: noticed, held, and never measured with."""

from __future__ import annotations

import math

import pytest

from hil.core.errors import RobotFault
from hil.core.typing import StructArray
from hil.engine import Outcome
from hil.engine.interlocks import InterlockContext, Interlocks, interlocks_from_spec
from hil.robot import HasSpeedScaling, Status
from hil.spec.interlocks import DEFAULTS, SpeedScalingInterlock
from tests.support.engine_parts import ListSink, engine, small_plan
from tests.support.kinematic_robot import KinematicRobot

UNTIL = 10**9


class WithSlider(KinematicRobot):
    """Reports its slider at `share` from one block to another.

    Args:
        share: Position of the slider meanwhile.
        first, last: The blocks it is at `share` in.
        fault_at: The block in which the controller faults.
    """

    def __init__(
        self, share: float = 0.7, first: int = 3, last: int = UNTIL, fault_at: int = UNTIL
    ) -> None:
        super().__init__()
        self._share, self._first, self._last, self._fault_at = share, first, last, fault_at
        self._blocks = 0

    @property
    def speed_scaling(self) -> float:
        return self._share if self._first <= self._blocks <= self._last else 1.0

    def read(self, timeout_s: float = 1.0) -> StructArray:
        self._blocks += 1
        if self._blocks == self._fault_at:
            raise RobotFault("joint 1 is led beside the path", hint="raise gain")
        return super().read(timeout_s)


def watching(robot: object, action: str = "pause") -> Interlocks:
    assert isinstance(robot, HasSpeedScaling)
    spec = SpeedScalingInterlock(kind="speed_scaling", action=action)
    return interlocks_from_spec([spec], InterlockContext(speed_scaling=lambda: robot.speed_scaling))


def test_it_watches_by_default_robots_that_report_it() -> None:
    assert SpeedScalingInterlock(kind="speed_scaling") in DEFAULTS
    (off,) = interlocks_from_spec([SpeedScalingInterlock(kind="speed_scaling")]).off
    assert off.name == "speed_scaling"
    assert "does not report" in off.why


def test_a_lowered_slider_holds_the_run_at_the_next_checkpoint_until_it_is_back() -> None:
    robot, sink = WithSlider(last=40), ListSink()
    result = engine(robot, sink, interlocks=watching(robot)).run()
    assert result.outcome is Outcome.COMPLETED
    states = [event for event in sink.events if event["kind"] == "state"]
    (paused,) = [event for event in states if event["state"] == "paused"]
    assert (
        "interlock speed_scaling: the robot's speed scaling (speed slider) at 70 %"
        in (paused["reason"])
    )


class Slow(WithSlider):
    """Moves as slowly as its slider says."""

    def start(self) -> None:
        super().start()
        times = min(round(1 / self._share), 1000)
        self._queue = [point for point in self._queue for _ in range(times)]


def test_a_move_may_take_as_long_as_the_slider_makes_it() -> None:
    robot = Slow(0.1, first=0)
    result = engine(robot, ListSink()).run()
    assert result.outcome is Outcome.COMPLETED, result.reason


@pytest.mark.thorough
def test_a_move_that_does_not_end_at_all_ends_the_run() -> None:
    robot = Slow(0.002, first=0)
    result = engine(robot, ListSink()).run()
    assert "planned to take" in result.reason
    assert "(speed slider) is at 0%" in result.reason


def test_with_action_stop_it_ends_the_run() -> None:
    robot, sink = WithSlider(), ListSink()
    result = engine(robot, sink, interlocks=watching(robot, "stop")).run()
    assert result.outcome is Outcome.TRIPPED
    assert "speed slider) at 70 %, at least 99 %" in result.reason


def test_each_change_is_an_event_and_a_note() -> None:
    robot, sink = WithSlider(last=40), ListSink()
    result = engine(robot, sink, interlocks=watching(robot)).run()
    changes = [event["share"] for event in sink.events if event["kind"] == "speed_scaling"]
    assert changes == [0.7, 1.0]
    (note,) = result.notes
    assert "was lowered once, at device time" in note
    assert "lowest value 70%" in note


def test_all_of_a_measurement_is_marked_from_the_change_to_the_next_checkpoint() -> None:
    robot, sink = WithSlider(first=5, last=6), ListSink()
    engine(robot, sink, plan=small_plan()).run()
    slowed = (sink.rows["status"] & int(Status.SLOWED)) != 0
    steps = sink.rows["segment"]
    assert slowed[steps == 2].all()  # the dwell, though the slider was back before it
    assert not slowed[steps >= 3].any()


@pytest.mark.parametrize("share", [1.0, 0.99, math.nan])
def test_full_speed_and_a_speed_that_is_not_known_are_no_news(share: float) -> None:
    robot, sink = WithSlider(share), ListSink()
    result = engine(robot, sink, interlocks=watching(robot)).run()
    assert result.outcome is Outcome.COMPLETED
    assert result.notes == ()
    assert not (sink.rows["status"] & int(Status.SLOWED)).any()


def test_an_error_that_follows_names_the_slider() -> None:
    robot, sink = WithSlider(0.5, fault_at=8), ListSink()
    result = engine(robot, sink).run()
    assert result.reason.endswith("the robot's speed scaling (speed slider) is at 50%")
    assert result.error is not None
    assert result.error.hint == "raise gain; set the speed slider to 100 %"
