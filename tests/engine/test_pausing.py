"""Runs that stand still for a while: paused, slowed by their controller, or not scheduled."""

from __future__ import annotations

import math
import os
import signal
import time
from typing import Any

import numpy as np
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
from hil.engine import Engine, Observers, Outcome, RunState, watchdog
from hil.engine.engine import CLEAR_FOR_S, TRANSITIONS
from hil.engine.interlocks import InterlockContext, Interlocks, Threshold, interlocks_from_spec
from hil.engine.signals import SignalWatch
from hil.robot import Capabilities, HasSpeedScaling, Segment, Status
from hil.robot.protocol import ClockKind
from hil.spec.interlocks import DEFAULTS, SpeedScalingInterlock
from tests.support.engine_parts import ListSink, engine, small_plan
from tests.support.kinematic_robot import KinematicRobot

# Pausing at a checkpoint and going on, asked for by people, signals and interlocks


class AtStep:
    """Does something once when the first sample of a step has been read."""

    def __init__(self, step: int, act: Any) -> None:
        self.step, self.act, self.done = step, act, False

    def __call__(self, block: StructArray) -> None:
        if not self.done and (block["segment"] == self.step).any():
            self.done = True
            self.act()


def paused_run(act: Any, go_on_after: int = 5) -> tuple[Engine, KinematicRobot, ListSink, Any]:
    """A run that is asked to pause during step 1 and let go on some blocks later."""
    robot, sink = KinematicRobot(), ListSink()
    waited: list[int] = []

    def go_on() -> str:
        waited.append(1)
        return "Ada" if len(waited) >= go_on_after else ""

    running = engine(robot, sink, go_on=go_on)
    robot.disturb = AtStep(1, lambda: act(running))
    return running, robot, sink, running.run()


def kinds(sink: ListSink) -> list[str]:
    return [e["state"] if e["kind"] == "state" else e["kind"] for e in sink.events]


def test_a_pause_waits_for_the_checkpoint_and_goes_on_when_somebody_says_so() -> None:
    _, _, sink, result = paused_run(lambda e: e.request_pause("coffee"))
    assert result.outcome is Outcome.COMPLETED
    told = kinds(sink)
    # Step 1 leads to the dwell of step 2, and the next checkpoint is before step 3.
    assert told.index("dwell") < told.index("paused") < told.index("resumed")
    assert next(e for e in sink.events if e["kind"] == "resumed")["by"] == "Ada"
    paused = next(e for e in sink.events if e.get("state") == "paused")
    assert paused["reason"] == "coffee"


def test_samples_of_a_pause_belong_to_no_step_and_the_arm_holds() -> None:
    _, _, sink, _ = paused_run(lambda e: e.request_pause("coffee"), go_on_after=20)
    rows = sink.rows
    moved = np.flatnonzero(rows["segment"] >= 0)
    pause = rows[moved[0] : moved[-1]]
    pause = pause[pause["segment"] == -1]
    assert len(pause) >= 20
    assert (pause["q_target"] == 0.3).all()


def test_a_paused_run_records_what_an_undisturbed_one_does() -> None:
    _, _, sink, _ = paused_run(lambda e: e.request_pause("coffee"), go_on_after=50)
    undisturbed = ListSink()
    engine(KinematicRobot(), undisturbed).run()
    for step in range(1, 5):
        with_pause = sink.rows[sink.rows["segment"] == step]["q_target"]
        without = undisturbed.rows[undisturbed.rows["segment"] == step]["q_target"]
        assert np.array_equal(with_pause[: len(without)], without[: len(with_pause)])


def test_a_pause_taken_back_before_the_checkpoint_is_none() -> None:
    def both(running: Engine) -> None:
        running.request_pause("coffee")
        running.request_resume("Ada")

    _, _, sink, result = paused_run(both)
    assert result.outcome is Outcome.COMPLETED
    assert "paused" not in kinds(sink)


def test_a_stop_ends_a_pause_at_once() -> None:
    robot, sink = KinematicRobot(), ListSink()

    def go_on() -> str:
        running.request_stop("enough")
        return ""

    running = engine(robot, sink, go_on=go_on)
    robot.disturb = AtStep(1, lambda: running.request_pause("coffee"))
    result = running.run()
    assert result.outcome is Outcome.STOPPED
    assert result.reason == "enough"
    assert result.steps_done == 3
    assert robot.calls[-1] == "stop"


def test_a_pause_before_the_first_motion_holds_before_it() -> None:
    robot, sink = KinematicRobot(), ListSink()
    running = engine(robot, sink, go_on=lambda: "Ada")
    running.request_pause("not yet")
    result = running.run()
    assert result.outcome is Outcome.COMPLETED
    assert kinds(sink).index("paused") < kinds(sink).index("checkpoint")


class Heat:
    """Joint 3 is hot from step 1 on, for a while of device time."""

    def __init__(self, for_s: float) -> None:
        self.for_s, self.since = for_s, np.inf

    def __call__(self, block: StructArray) -> None:
        if (block["segment"] == 1).any():
            self.since = min(self.since, float(block["device_time"][0]))
        hot = block["device_time"] - self.since
        block["temperature"][:, 2] = np.where((hot >= 0) & (hot < self.for_s), 71.0, 40.0)


def hot_run(for_s: float, **options: Any) -> tuple[ListSink, Any]:
    robot, sink = KinematicRobot(Heat(for_s)), ListSink()
    limit = Threshold("temperature", "temperature", 70.0, "°C", action="pause", resume=65.0)
    return sink, engine(robot, sink, interlocks=[limit], **options).run()


def test_an_interlock_pauses_and_the_run_goes_on_by_itself_when_it_is_clear() -> None:
    sink, result = hot_run(for_s=8.0)
    assert result.outcome is Outcome.COMPLETED
    paused = next(e for e in sink.events if e.get("state") == "paused")
    assert "temperature" in paused["reason"]
    assert "j3" in paused["reason"]
    moved = np.flatnonzero(sink.rows["segment"] >= 0)
    pause = sink.rows[moved[0] : moved[-1]]
    pause = pause[pause["segment"] == -1]
    hot_until = sink.rows["device_time"][sink.rows["temperature"][:, 2] > 70][-1]
    assert pause["device_time"][-1] - hot_until >= CLEAR_FOR_S


def test_a_violation_that_is_over_at_the_checkpoint_still_pauses_for_a_moment() -> None:
    sink, result = hot_run(for_s=0.05)
    assert result.outcome is Outcome.COMPLETED
    assert "paused" in kinds(sink)


def test_an_unattended_run_that_stays_held_ends_and_names_the_interlock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hil.engine.engine.UNATTENDED_S", 6.0)
    sink, result = hot_run(for_s=np.inf)
    assert result.outcome is Outcome.TRIPPED
    assert "interlock temperature: j3" in result.reason
    assert result.reason.endswith("and no operator attends the run")
    paused = next(e for e in sink.events if e.get("state") == "paused")
    assert paused["reason"] in result.reason


def test_an_attended_run_that_stays_held_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.engine.engine.UNATTENDED_S", 6.0)
    _, result = hot_run(for_s=9.0, go_on=lambda: "")
    assert result.outcome is Outcome.COMPLETED


def test_a_pause_that_a_person_asked_for_does_not_end_an_unattended_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hil.engine.engine.UNATTENDED_S", 1.0)
    robot, sink = KinematicRobot(), ListSink()
    paused: list[int] = []

    def resumed_after_a_while(block: StructArray) -> None:
        paused.append(running.state is RunState.PAUSED)
        if sum(paused) == 40:
            running.request_resume("Ada")

    running = engine(robot, sink)
    robot.disturb = resumed_after_a_while
    running.request_pause("coffee")
    assert running.run().outcome is Outcome.COMPLETED
    assert sum(paused) * 8 / 125.0 > 2.0


def test_a_stop_interlock_judges_while_the_run_is_paused() -> None:
    robot, sink = KinematicRobot(), ListSink()

    def spike(block: StructArray) -> None:
        if running.state is RunState.PAUSED:
            block["qd"][:, 1] = 9.0

    running = engine(robot, sink, interlocks=[Threshold("speed", "qd", 5.0, "rad/s")])
    running.request_pause("coffee")
    robot.disturb = spike
    assert running.run().outcome is Outcome.TRIPPED


def test_operator_and_interlock_must_both_let_go() -> None:
    robot, sink = KinematicRobot(Heat(6.0)), ListSink()
    asked: list[float] = []

    def go_on() -> str:
        asked.append(1)
        return "Ada"

    limit = Threshold("temperature", "temperature", 70.0, "°C", action="pause", resume=65.0)
    running = engine(robot, sink, interlocks=[limit], go_on=go_on)
    running.request_pause("coffee")
    assert running.run().outcome is Outcome.COMPLETED
    resumed = [e["by"] for e in sink.events if e["kind"] == "resumed"]
    assert "interlocks clear" in resumed


@pytest.mark.parametrize(("presses", "outcome"), [(1, Outcome.COMPLETED), (2, Outcome.STOPPED)])
def test_ctrl_c_pauses_first_and_stops_second(presses: int, outcome: Outcome) -> None:
    robot, sink = KinematicRobot(), ListSink()
    with SignalWatch() as watch, watch.guard():
        running = engine(robot, sink, go_on=lambda: "Ada")
        watch.bind(running, robot)

        def press() -> None:
            for _ in range(presses):
                os.kill(os.getpid(), signal.SIGINT)

        robot.disturb = AtStep(1, press)
        result = running.run()
    assert result.outcome is outcome
    assert ("paused" in kinds(sink)) is (presses == 1)


def test_ctrl_c_stops_at_once_where_nobody_could_go_on() -> None:
    robot, sink = KinematicRobot(), ListSink()
    with SignalWatch(attended=False) as watch, watch.guard():
        running = engine(robot, sink)
        watch.bind(running, robot)
        robot.disturb = AtStep(1, lambda: os.kill(os.getpid(), signal.SIGINT))
        result = running.run()
    assert (result.outcome, result.reason) == (Outcome.STOPPED, "stopped by SIGINT")
    assert "paused" not in kinds(sink)


def test_ctrl_c_stops_a_run_that_is_paused_already() -> None:
    robot, sink = KinematicRobot(), ListSink()
    with SignalWatch() as watch, watch.guard():

        def go_on() -> str:
            os.kill(os.getpid(), signal.SIGINT)
            return ""

        running = engine(robot, sink, go_on=go_on)
        watch.bind(running, robot)
        running.request_pause("coffee")
        result = running.run()
    assert result.outcome is Outcome.STOPPED
    assert "SIGINT" in result.reason


def test_every_state_of_motion_can_be_left_by_a_stop() -> None:
    ends = {RunState.STOPPING, RunState.DONE}
    assert all(RunState.STOPPING in TRANSITIONS[s] for s in RunState if s not in ends)


def test_observers_hear_of_steps_states_and_blocks() -> None:
    class Hears:
        wants_rows = True

        def __init__(self) -> None:
            self.events: list[Any] = []

        def notify(self, event: Any) -> None:
            self.events.append(event)

    hears = Hears()
    observers = Observers((hears,))
    robot, sink = KinematicRobot(), ListSink()
    engine(robot, sink, observers=observers, health=lambda: {"gaps": 3.0}).run()
    observers.close()
    heard = [event["kind"] for event in hears.events]
    assert {"state", "step", "rows", "progress"} <= set(heard)
    assert [e["step"] for e in hears.events if e["kind"] == "step"] == [0, 1, 2, 3, 4]
    assert next(e for e in hears.events if e["kind"] == "progress")["gaps"] == 3.0
    assert hears.events[-1] == {"kind": "state", "state": "done", "reason": "completed"}


def test_what_a_dwell_measured_is_handed_over_settled() -> None:
    seen: list[tuple[int, int, float]] = []
    engine(
        KinematicRobot(),
        ListSink(),
        measured=lambda step, rows: seen.append((step.index, len(rows), float(rows["q"][0, 0]))),
    ).run()
    assert seen == [(2, 10, 0.3), (4, 10, -0.2)]


def test_nothing_is_parked_before_the_first_motion() -> None:
    robot = KinematicRobot()
    engine(robot, ListSink()).run()
    assert "prepare -1" not in robot.calls


# A robot whose controller moves slower than planned: noticed, held, and never measured with


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
    assert "not reported" in off.why


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


# A process that did not run for a while: one end of the run, whatever is found wrong first


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


@pytest.fixture
def _clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watchdog, "now_s", lambda: time.monotonic() + Suspended.slept_s)


@pytest.mark.usefixtures("_clock")
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


@pytest.mark.usefixtures("_clock")
def test_a_short_one_explains_a_silence_but_hides_no_fault() -> None:
    silent = engine(Suspended(1.0, RobotTimeout("no answer")), ListSink()).run()
    assert "this process did not run for 1.0 s" in silent.reason
    fault = engine(Suspended(1.0, RobotFault("protective stop")), ListSink()).run()
    assert fault.reason.startswith("protective stop")
    assert "this process did not run for 1.0 s just before the end" in fault.notes


@pytest.mark.usefixtures("_clock")
def test_a_short_one_does_not_explain_the_silence_of_a_robot_that_was_heard_again() -> None:
    error = RobotConnectionError("the cable was pulled")
    result = engine(Suspended(0.6, error, blocks=4), ListSink()).run()
    assert result.reason.startswith("the cable was pulled")


@pytest.mark.usefixtures("_clock")
def test_a_short_one_without_consequence_does_not_end_the_run() -> None:
    assert engine(Suspended(1.0), ListSink()).run().outcome is Outcome.COMPLETED


@pytest.mark.usefixtures("_clock")
def test_a_library_that_keeps_the_interpreter_while_the_arm_stands_is_none() -> None:
    result = engine(Suspended(10.0, call="prepare"), ListSink()).run()
    assert result.outcome is Outcome.COMPLETED


@pytest.mark.usefixtures("_clock")
def test_on_a_virtual_clock_nothing_moves_meanwhile() -> None:
    result = engine(Suspended(10.0, clock="virtual"), ListSink()).run()
    assert result.outcome is Outcome.COMPLETED
