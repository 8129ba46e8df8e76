"""Pausing at a checkpoint and going on, asked for by people, signals and interlocks."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np
import pytest

from hil.core.typing import StructArray
from hil.engine import Engine, Observers, Outcome, RunState
from hil.engine.engine import CLEAR_FOR_S, TRANSITIONS
from hil.engine.interlocks import Threshold
from hil.engine.signals import SignalWatch
from tests.support.engine_parts import ListSink, engine
from tests.support.kinematic_robot import KinematicRobot


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
