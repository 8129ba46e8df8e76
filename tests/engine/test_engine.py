"""The engine: every sample kept and judged, steps in order, and every way a run ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import (
    HilError,
    InterlockTripped,
    PlanError,
    PreflightFailed,
    RecordingError,
    RobotFault,
    RobotTimeout,
    StaleState,
    Stopped,
)
from hil.core.typing import StructArray
from hil.engine import TRANSITIONS, Observers, Outcome, Reply, RunState
from hil.engine.engine import IllegalTransition, StateMachine, under_way
from hil.engine.interlocks import Threshold, interlocks_from_spec
from hil.engine.reading import STALE_AFTER_BLOCKS, Deadline, Freshness
from hil.excitation.motion import Hold
from hil.planning.plan import LoadStep, Plan, Step
from hil.robot import Capabilities, Robot, Status
from hil.spec.interlocks import SpeedInterlock, TemperatureInterlock, TrackingErrorInterlock
from tests.support.engine_parts import ListSink, engine, small_plan
from tests.support.in_time import InTime, measured_again
from tests.support.interlock_parts import rows
from tests.support.kinematic_robot import KinematicRobot

# What the engine does with a plan: every sample kept and judged, every step in its order


def test_the_test_robot_is_a_robot() -> None:
    robot = KinematicRobot()
    robot.connect()
    assert isinstance(robot, Robot)


def test_a_plan_runs_to_its_end_and_stops_the_robot() -> None:
    robot, sink = KinematicRobot(), ListSink()
    result = engine(robot, sink).run()
    assert result.outcome is Outcome.COMPLETED
    assert result.error is None
    assert result.steps_done == 5
    assert robot.calls[-1] == "stop"


def test_every_row_the_robot_gave_is_recorded_once_and_in_order() -> None:
    robot, sink = KinematicRobot(), ListSink()
    result = engine(robot, sink).run()
    times = sink.rows["device_time"]
    assert len(times) == robot.ticks == result.samples
    np.testing.assert_allclose(np.diff(times), 1 / 125.0, rtol=1e-9)


def test_rows_carry_the_step_they_belong_to() -> None:
    robot, sink = KinematicRobot(), ListSink()
    engine(robot, sink).run()
    dwell = sink.rows[sink.rows["segment"] == 2]
    assert len(dwell) >= 10
    np.testing.assert_allclose(dwell["q"], 0.3, atol=1e-12)


def test_a_pose_that_never_settles_is_marked_and_left() -> None:
    def restless(block: StructArray) -> None:
        block["qd"][block["segment"] == 2] = 0.01

    robot, sink = KinematicRobot(restless), ListSink()
    result = engine(robot, sink).run()
    assert result.outcome is Outcome.COMPLETED
    assert result.unsettled == (2,)
    assert {"kind": "dwell", "step": 2, "settled": False}.items() <= sink.events[
        [e.get("step") == 2 and e["kind"] == "dwell" for e in sink.events].index(True)
    ].items()


@pytest.mark.parametrize(
    ("spec", "field", "value"),
    [
        (TrackingErrorInterlock(kind="tracking_error", limit_rad=0.05), "q", 0.6),
        (TemperatureInterlock(kind="temperature", limit_c=70), "temperature", 71.0),
        (SpeedInterlock(kind="speed", limit_deg_s=90), "qd", 1.6),
    ],
)
def test_an_interlock_trips_on_a_single_sample(spec: Any, field: str, value: float) -> None:
    def spike(block: StructArray) -> None:
        if (block["segment"] == 3).any():
            block[field][5, 2] = value

    robot, sink = KinematicRobot(spike), ListSink()
    result = engine(robot, sink, interlocks=interlocks_from_spec([spec])).run()
    assert result.outcome is Outcome.TRIPPED
    assert isinstance(result.error, InterlockTripped)
    assert "j3" in result.reason
    assert spec.kind in result.reason
    assert "prepare 4" not in robot.calls


def test_an_interlock_violated_from_the_start_trips_before_anything_moves() -> None:
    def hot(block: StructArray) -> None:
        block["temperature"] = 90.0

    robot, sink = KinematicRobot(hot), ListSink()
    result = engine(robot, sink, interlocks=[Threshold("temperature", "temperature", 70, "°C")])
    outcome = result.run().outcome
    assert outcome is Outcome.TRIPPED
    assert "start" not in robot.calls


def test_a_temperature_that_is_not_measured_does_not_trip() -> None:
    def blind(block: StructArray) -> None:
        block["temperature"] = np.nan

    locks = interlocks_from_spec([TemperatureInterlock(kind="temperature", limit_c=70)])
    assert engine(KinematicRobot(blind), ListSink(), interlocks=locks).run().error is None


def test_a_tracking_error_that_cannot_be_seen_trips() -> None:
    def blind(block: StructArray) -> None:
        block["q"] = np.nan

    locks = interlocks_from_spec([TrackingErrorInterlock(kind="tracking_error", limit_rad=0.05)])
    result = engine(KinematicRobot(blind), ListSink(), interlocks=locks).run()
    assert result.outcome is Outcome.TRIPPED


def test_an_unknown_interlock_is_refused() -> None:
    class Unknown:
        kind = "wishful"

    with pytest.raises(PlanError, match="wishful"):
        interlocks_from_spec([Unknown()])


def test_an_interlock_stops_the_robot_before_anything_else_happens() -> None:
    class Watching(ListSink):
        def event(self, kind: str, **details: Any) -> None:
            super().event(kind, **details)
            if kind == "trip":
                assert "stop" in robot.calls

    def fast(block: StructArray) -> None:
        if (block["segment"] == 3).any():
            block["qd"] = 2.0

    robot, sink = KinematicRobot(fast), Watching()
    locks = interlocks_from_spec([SpeedInterlock(kind="speed", limit_deg_s=90)])
    engine(robot, sink, interlocks=locks).run()
    assert [e["kind"] for e in sink.events].count("trip") == 1
    assert robot.calls.count("stop") == 2


def test_further_topics_reach_the_sink() -> None:
    class Raw(KinematicRobot):
        topics = ()

        def drain(self) -> dict[str, StructArray]:
            return {"/can/raw": np.zeros(2, dtype=[("device_time", "<f8")])}

    sink = ListSink()
    engine(Raw(), sink).run()
    assert len(sink.extra) == len(sink.blocks)
    assert sink.extra[0][0] == "/can/raw"


def test_a_fault_while_reading_stops_the_robot_and_keeps_what_came_before() -> None:
    def fault(block: StructArray) -> None:
        if (block["segment"] == 3).any():
            raise RobotFault("protective stop")

    robot, sink = KinematicRobot(fault), ListSink()
    result = engine(robot, sink).run()
    assert result.outcome is Outcome.FAILED
    assert robot.calls[-1] == "stop"
    assert set(sink.rows["segment"]) >= {1, 2}


def test_a_load_is_mounted_only_when_the_operator_confirms() -> None:
    asked: list[str] = []

    def confirm(text: str, meanwhile: Any) -> Reply:
        asked.append(text)
        meanwhile()
        return Reply(yes=True, who="operator")

    robot = KinematicRobot()
    plan = small_plan("Mount 1 kg")
    assert engine(robot, ListSink(), plan=plan, prompt=confirm).run().error is None
    assert asked == ["Mount 1 kg"]
    refused = engine(
        KinematicRobot(),
        ListSink(),
        plan=plan,
        prompt=lambda text, meanwhile: Reply(yes=False, who="anna"),
    ).run()
    assert refused.outcome is Outcome.STOPPED
    assert refused.reason == "anna answered no: 'Mount 1 kg'"


def test_a_payload_that_reads_back_differently_ends_the_run() -> None:
    class Deaf(KinematicRobot):
        def set_payload(self, payload: Payload) -> Payload:
            return replace(payload, mass=0.0)

    result = engine(Deaf(), ListSink()).run()
    assert result.outcome is Outcome.FAILED
    assert "reads back" in result.reason


@pytest.mark.thorough
def test_observers_that_raise_or_sleep_change_nothing() -> None:
    class Raises:
        def notify(self, event: Any) -> None:
            raise RuntimeError("plot window closed")

    class Sleeps:
        def notify(self, event: Any) -> None:
            time.sleep(0.2)

    observers = Observers((Raises(), Sleeps()))
    result = engine(KinematicRobot(), ListSink(), observers=observers).run()
    assert result.outcome is Outcome.COMPLETED
    assert any("plot window closed" in note for note in observers.close())


def test_observers_run_on_their_own_threads() -> None:
    seen: set[str] = set()

    class Names:
        def notify(self, event: Any) -> None:
            seen.add(threading.current_thread().name)

    observers = Observers((Names(),))
    engine(KinematicRobot(), ListSink(), observers=observers).run()
    observers.close()
    assert seen
    assert threading.current_thread().name not in seen


def test_a_transition_outside_the_table_is_refused() -> None:
    with pytest.raises(IllegalTransition):
        StateMachine().to(RunState.RUNNING)


# Every way a run ends: the robot is stopped, watched to rest, and the reason is kept


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
        "in a step of the return to the plan (move)",
    ]


# A driver that hangs takes neither the arm nor the run's end with it


class WallRobot(KinematicRobot):
    """Lives in wall time, and hangs in `read` or `prepare` once a segment has begun."""

    def __init__(self, hangs_in: str) -> None:
        super().__init__()
        self.hangs_in, self.free = hangs_in, threading.Event()
        self.waited_out = list[bool]()

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(super().capabilities.joint_names, 125.0, "current", clock="wall")

    def read(self, timeout_s: float = 1.0) -> StructArray:
        on_main_line = threading.current_thread().name == "hil-the control loop"
        if self.hangs_in == "read" and self._segment == 1 and on_main_line:
            self.waited_out.append(self.free.wait(300))
        return super().read(timeout_s)

    def prepare(self, segment: object) -> None:
        if self.hangs_in == "prepare" and self._segment == 1:
            self.waited_out.append(self.free.wait(300))
        super().prepare(segment)  # type: ignore[arg-type]


@pytest.mark.thorough
@pytest.mark.parametrize("call", ["read", "prepare"])
@measured_again
def test_a_call_that_never_returns_ends_the_run_and_commands_nothing_later(
    monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    monkeypatch.setattr("hil.engine.engine.COMMAND_WITHIN_S", 0.3)
    robot, sink = WallRobot(call), ListSink()
    asked = InTime()
    result = engine(robot, sink).run()
    taken = asked.taken()
    assert not robot.waited_out
    assert result.outcome is Outcome.FAILED
    assert isinstance(result.error, RobotTimeout)
    assert "stop" in robot.calls
    told = [c for c in robot.calls if c == "start"]
    robot.free.set()
    time.sleep(0.3)
    assert [c for c in robot.calls if c == "start"] == told
    taken.require(5)


SCRIPT = """
import os, signal, sys, time
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot
from hil.engine.signals import SignalWatch

class Stuck(KinematicRobot):
    def stop(self):
        time.sleep(300)

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
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 130, done.stderr
    assert "moving" in done.stdout


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


# When state that repeats itself counts as stale: by the wall clock, or by blocks without one


class Wall:
    """A clock that is set by hand [s]."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def watching(after_s: float | None = None, *, wall: bool = True) -> tuple[Freshness, Wall]:
    clock = Wall()
    watch = Freshness(after_s, wall=wall, now=clock)
    watch.check(rows(device_time=3.0))
    return watch, clock


def test_in_wall_time_rows_may_repeat_for_as_long_as_the_spec_says() -> None:
    watch, clock = watching(5.0)
    for _ in range(10 * STALE_AFTER_BLOCKS):
        clock.now += 0.009
        watch.check(rows(device_time=3.0))
    clock.now = 5.1
    with pytest.raises(
        InterlockTripped, match=r"interlock stale: .* stands still at 3\.000 s"
    ) as e:
        watch.check(rows(device_time=3.0))
    assert "no newer sample for 5.1 s, limit 5 s" in e.value.message


def test_a_newer_row_begins_afresh() -> None:
    watch, clock = watching()
    for time_s in (3.1, 3.2, 3.3):
        clock.now += 0.4
        watch.check(rows(device_time=time_s))
    clock.now += 0.4
    watch.check(rows(device_time=3.3))


def test_a_virtual_clock_knows_no_wall_time_and_counts_blocks() -> None:
    watch, clock = watching(5.0, wall=False)
    clock.now = 3600.0
    for _ in range(STALE_AFTER_BLOCKS):
        watch.check(rows(device_time=3.0))
    with pytest.raises(InterlockTripped, match="51 blocks in a row without a newer sample"):
        watch.check(rows(device_time=3.0))


def test_a_clock_that_went_backwards_is_called_so() -> None:
    watch, clock = watching()
    watch.check(rows(device_time=-2.0))
    clock.now = 0.6
    told = (
        r"the robot's clock went backwards, from 3\.000 s to -1\.900 s: no newer sample for 0\.6 s"
    )
    with pytest.raises(InterlockTripped, match=told):
        watch.check(rows(device_time=-1.9))


def test_a_time_that_is_no_number_is_the_drivers_fault() -> None:
    watch, _ = watching()
    with pytest.raises(StaleState, match="is not a finite number"):
        watch.check(rows(device_time=np.nan))
