"""What the engine does with a plan: every sample kept and judged, every step in its order."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import InterlockTripped, PlanError, RobotFault
from hil.core.typing import StructArray
from hil.engine import Observers, Outcome, Reply, RunState
from hil.engine.engine import IllegalTransition, StateMachine
from hil.engine.interlocks import Threshold, interlocks_from_spec
from hil.robot import Robot
from hil.spec.interlocks import SpeedInterlock, TemperatureInterlock, TrackingErrorInterlock
from tests.support.engine_parts import ListSink, engine, small_plan
from tests.support.kinematic_robot import KinematicRobot


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
