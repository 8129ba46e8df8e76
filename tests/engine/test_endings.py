"""Every way a run ends: the robot is stopped, watched to rest, and the reason is kept."""

from __future__ import annotations

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import (
    HilError,
    InterlockTripped,
    PreflightFailed,
    RecordingError,
    RobotFault,
    RobotTimeout,
    StaleState,
    Stopped,
)
from hil.core.typing import StructArray
from hil.engine import TRANSITIONS, Outcome, RunState
from hil.engine.engine import under_way
from hil.engine.reading import Deadline
from hil.excitation.motion import Hold
from hil.planning.plan import LoadStep, Plan, Step
from hil.robot import Status
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot


def test_a_dwell_waits_until_ten_samples_are_at_rest() -> None:
    def restless(block: StructArray) -> None:
        block["qd"][(block["segment"] == 2) & (block["device_time"] < 2.0)] = 0.01

    robot, sink = KinematicRobot(restless), ListSink()
    result = engine(robot, sink).run()
    dwell = sink.rows[sink.rows["segment"] == 2]
    assert result.unsettled == ()
    assert (np.abs(dwell["qd"][-10:]) < 0.002).all()


def test_the_fault_bit_ends_the_run_in_the_drivers_own_words() -> None:
    class Faulty(KinematicRobot):
        def read(self, timeout_s: float = 1.0) -> StructArray:
            if self.faulted:
                raise RobotFault("protective stop: joint 2 overloaded")
            block = super().read(timeout_s)
            if (block["segment"] == 1).any():
                block["status"] |= Status.FAULT
                self.faulted = True
            return block

        faulted = False

    result = engine(Faulty(), ListSink()).run()
    assert result.outcome is Outcome.FAILED
    assert isinstance(result.error, RobotFault)
    assert "joint 2 overloaded" in result.reason


def test_a_fault_without_words_names_its_code() -> None:
    def fault(block: StructArray) -> None:
        if (block["segment"] == 1).any():
            block["status"] |= Status.FAULT
            block["fault_code"] = 77

    result = engine(KinematicRobot(fault), ListSink()).run()
    assert isinstance(result.error, RobotFault)
    assert "fault 77" in result.reason


@pytest.mark.parametrize(
    ("broken", "error", "outcome"),
    [
        ("frozen", InterlockTripped, Outcome.TRIPPED),
        ("nan", StaleState, Outcome.FAILED),
    ],
)
@pytest.mark.parametrize("segment", [1, 2])
def test_a_clock_that_stands_still_ends_the_run(
    broken: str, error: type[HilError], outcome: Outcome, segment: int
) -> None:
    def break_clock(block: StructArray) -> None:
        if (block["segment"] == segment).any():
            block["device_time"] = 0.01 if broken == "frozen" else np.nan
            block["status"] = Status.MOVING

    result = engine(KinematicRobot(break_clock), ListSink()).run()
    assert isinstance(result.error, error)
    assert result.outcome is outcome


def test_a_motion_that_never_ends_times_out() -> None:
    def endless(block: StructArray) -> None:
        if (block["segment"] == 1).any():
            block["status"] = Status.MOVING

    result = engine(KinematicRobot(endless), ListSink()).run()
    assert isinstance(result.error, RobotTimeout)


def test_a_dwell_whose_samples_never_come_times_out() -> None:
    def elsewhere(block: StructArray) -> None:
        block["segment"][block["segment"] == 2] = 1

    result = engine(KinematicRobot(elsewhere), ListSink()).run()
    assert isinstance(result.error, RobotTimeout)


def test_time_outs_of_a_robot_in_wall_time_do_not_need_its_clock() -> None:
    clock = iter(range(1000))
    deadline = Deadline(5.0, 0.0, wall=True, now=lambda: float(next(clock)))
    assert [deadline.over(0.0) for _ in range(7)] == [False] * 5 + [True] * 2


def test_a_device_clock_that_is_slow_but_goes_on_is_waited_for() -> None:
    walls = iter(float(i) for i in range(20))
    deadline = Deadline(3.0, 0.0, wall=True, now=lambda: next(walls))
    slow = [0.4 * i for i in range(1, 10)]  # 0.4 s of device time a second
    assert [deadline.over(at) for at in slow] == [at > 3.0 for at in slow]
    assert deadline.over(slow[6] + 0.1)


def test_a_simulated_second_that_lasts_a_tenth_leaves_the_computer_its_time() -> None:
    walls = iter([0.0, 0.3, 0.9, 1.0])
    deadline = Deadline(2.0, 0.0, wall=True, now=lambda: next(walls))
    assert [deadline.over(at) for at in (3.0, 9.0, 10.0)] == [False, False, True]


def test_a_stopped_arm_is_recorded_until_it_is_at_rest() -> None:
    class Coasts(KinematicRobot):
        coasting = 0

        def stop(self) -> None:
            if "stop" not in self.calls:
                self.coasting = 5
            super().stop()

        def read(self, timeout_s: float = 1.0) -> StructArray:
            block = super().read(timeout_s)
            if self.coasting:
                self.coasting -= 1
                block["qd"] = 0.5
            return block

    robot, sink = Coasts(), ListSink()
    result = engine(robot, sink).run()
    assert result.outcome is Outcome.COMPLETED
    assert (np.abs(sink.blocks[-1]["qd"][-1]) < 0.01).all()
    assert len(sink.rows) == robot.ticks


def test_an_arm_that_does_not_come_to_rest_is_a_failure() -> None:
    def drifting(block: StructArray) -> None:
        if "stop" in robot.calls:
            block["qd"] = 0.5

    robot = KinematicRobot(drifting)
    result = engine(robot, ListSink()).run()
    assert result.outcome is Outcome.FAILED
    assert "not at rest" in result.reason


def test_a_robot_that_cannot_be_stopped_never_counts_as_completed() -> None:
    class Unstoppable(KinematicRobot):
        def stop(self) -> None:
            raise RobotFault("the line is dead")

    result = engine(Unstoppable(), ListSink()).run()
    assert result.outcome is Outcome.FAILED
    assert "the line is dead" in result.reason


@pytest.mark.parametrize("at_step", [1, 2, 3, 4])
def test_a_stop_request_is_obeyed_in_every_step(at_step: int) -> None:
    def stop_now(block: StructArray) -> None:
        if (block["segment"] == at_step).any():
            running.request_stop("enough")

    robot, sink = KinematicRobot(stop_now), ListSink()
    running = engine(robot, sink)
    result = running.run()
    assert result.outcome is Outcome.STOPPED
    assert result.steps_done == at_step
    assert not any("by_signal" in event for event in sink.events)
    assert robot.calls[-1] == "stop"
    assert f"prepare {at_step + 1}" not in robot.calls


def test_a_stop_requested_before_the_start_moves_nothing() -> None:
    robot, sink = KinematicRobot(), ListSink()
    running = engine(robot, sink)
    running.request_stop("not today", by_signal=True)
    result = running.run()
    assert result.outcome is Outcome.STOPPED
    assert isinstance(result.error, Stopped)
    assert result.error.by_signal
    assert robot.calls == ["stop"]
    told = [event.get("by_signal") for event in sink.events if event.get("state") == "stopping"]
    assert told == [True]


def test_failed_preflight_moves_nothing() -> None:
    def refuse() -> None:
        raise PreflightFailed("no")

    robot = KinematicRobot()
    result = engine(robot, ListSink()).run(refuse)
    assert result.outcome is Outcome.FAILED
    assert "start" not in robot.calls


def test_a_recorder_that_cannot_keep_the_data_ends_the_run() -> None:
    class Full(ListSink):
        def put(self, rows: StructArray) -> None:
            super().put(rows)
            if len(self.blocks) > 10:
                raise RecordingError("disk full")

    robot = KinematicRobot()
    result = engine(robot, Full()).run()
    assert isinstance(result.error, RecordingError)
    assert robot.calls[-1] == "stop"


def test_a_bug_still_stops_the_robot() -> None:
    class Buggy(ListSink):
        def put(self, rows: StructArray) -> None:
            raise ZeroDivisionError

    robot = KinematicRobot()
    result = engine(robot, Buggy()).run()
    assert result.outcome is Outcome.FAILED
    assert "ZeroDivisionError" in result.reason
    assert any("Traceback" in n or "put" in n for n in result.notes)
    assert robot.calls[-1] == "stop"


def test_a_stop_that_fails_does_not_hide_why_the_run_ended() -> None:
    class Unstoppable(KinematicRobot):
        def stop(self) -> None:
            raise RobotFault("the line is dead")

    def fault(block: StructArray) -> None:
        if (block["segment"] == 1).any():
            raise RobotFault("protective stop")

    result = engine(Unstoppable(fault), ListSink()).run()
    assert result.reason == "protective stop, in step 2 (move to pose 0)"
    assert any("the line is dead" in note for note in result.notes)


def test_every_state_but_the_last_can_go_to_stopping() -> None:
    for state, reachable in TRANSITIONS.items():
        if state not in (RunState.STOPPING, RunState.DONE):
            assert RunState.STOPPING in reachable


def test_what_was_under_way_is_named_with_its_pose() -> None:
    there = Hold((0.0,) * 6)
    steps = (
        Step(0, "payload"),
        Step(1, "move", there),
        Step(2, "dwell", there, pose=4),
        Step(3, "move", there),
        Step(4, "reference", there),
        Step(5, "move", there),
        Step(6, "trajectory", there, trajectory=3),
        Step(-1, "move", there),
    )
    plan = Plan("p", "ur5", ("j",) * 6, 125.0, steps, (LoadStep(Payload()),))
    assert [under_way(plan, step) for step in steps] == [
        "in step 1 (payload)",
        "in step 2 (move to pose 4)",
        "in step 3 (dwell at pose 4)",
        "in step 4 (move to the reference)",
        "in step 5 (reference)",
        "in step 6 (move)",
        "in step 7 (trajectory 3)",
        "in a step of the way back (move)",
    ]
