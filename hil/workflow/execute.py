"""One attempt: preflight, motion, and an end that is written down however it came."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hil.arms import load_arm
from hil.core import HilError
from hil.engine import (
    Engine,
    GoOn,
    Observers,
    Prompt,
    SignalWatch,
    nobody_goes_on,
    preflight_context,
    require_preflight,
)
from hil.excitation import Advance
from hil.planning import Plan, close_robot, swept
from hil.recording import Recorder, name_of_attempt
from hil.robot import Robot
from hil.workflow.arm_view import ArmView
from hil.workflow.attempt import Attempt, Recorded, finish
from hil.workflow.beginning import open_recorder
from hil.workflow.confirmation import Confirm, Unconfirmed
from hil.workflow.control import Control
from hil.workflow.live_state import LiveState
from hil.workflow.operator import prompt_on
from hil.workflow.sink import RunSink
from hil.workflow.weighing import CHECK as WEIGHING
from hil.workflow.weighing import Weighing


@dataclass(frozen=True, slots=True)
class Attendance:
    """Who and what attends a run.

    Attributes:
        observers: Receive progress events.
        signals: Open; guards the motion.
        prompt: Asks the operator; a robot on a virtual clock confirms by itself.
        go_on: Looks whether the operator ends a pause.
        operator: Who is at the robot; empty for the user of this process.
        waivers: Preflight check → why its failure is accepted.
        wait_s: How long to wait for a robot that somebody else holds [s].
        confirm: Confirms that a real robot may move.
        until_judged: What is to stay open until the run has been judged and reported.
    """

    observers: Observers
    signals: SignalWatch
    prompt: Prompt
    go_on: GoOn = nobody_goes_on
    operator: str = ""
    waivers: Mapping[str, str] = field(default_factory=dict)
    wait_s: float = 0.0
    confirm: Confirm = field(default_factory=Unconfirmed)
    until_judged: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    def stage(self, text: str) -> None:
        """Tell observers what is being done."""
        self.observers.publish({"kind": "stage", "stage": text})

    def planned(self, plan: Plan) -> None:
        """Publish the space that the motions of `plan` sweep, before anything moves."""
        space = swept(plan, load_arm(plan.robot_model))
        self.observers.publish({"kind": "plan", **space.to_dict(), "lines": space.lines()})

    def computing(self, advance: Advance) -> None:
        """Tell observers how far trajectories are that take long to compute."""
        self.observers.publish(advance.to_event())


def execute(attempt: Attempt, robot: Robot, attendance: Attendance) -> Recorded:
    """Check and execute; leaves a stop document however it ends. Signals must be guarded.

    Raises:
        RecordingError: The recording cannot be opened; the stop document says so too.
    """
    directory, number = attempt.directory, attempt.number
    open_files, around = contextlib.ExitStack(), contextlib.ExitStack()
    try:
        recorder = open_recorder(directory, number, robot, attempt.experiment)
        open_files.callback(_quietly, recorder.close)
        sink = RunSink(directory, recorder)
        open_files.callback(_quietly, sink.close)
        engine = _engine(attempt, robot, attendance, recorder, sink, around)
    except BaseException as error:
        around.close()
        open_files.close()
        with contextlib.suppress(HilError):
            directory.write_stop("failed", str(error) or type(error).__name__, attempt=number)
        raise
    attendance.signals.bind(engine, robot)
    result = engine.run(_preflight(attempt, robot, attendance))
    result = replace(result, notes=(*result.notes, *close_robot(robot)))
    around.close()
    return finish(attempt, result, recorder, sink, attendance.observers)


def _engine(
    attempt: Attempt,
    robot: Robot,
    attendance: Attendance,
    recorder: Recorder,
    sink: RunSink,
    around: contextlib.ExitStack,
) -> Engine:
    """The engine, and `around` it what is to be closed after it."""
    directory, interlocks = attempt.directory, attempt.interlocks.all
    attempt.interlocks.watch_recording(directory.path, recorder)
    around.callback(interlocks.close)
    sink.event("interlocks", watching=interlocks.describe())
    prompt = prompt_on(robot, attendance.prompt)
    engine = Engine(
        attempt.todo,
        robot,
        sink,
        interlocks=interlocks,
        observers=attendance.observers,
        prompt=prompt,
        go_on=attendance.go_on,
        measured=_weighing(attempt, robot, sink, attendance).measured,
        health=sink.health,
        stale_after_s=interlocks.stale_after_s,
        steps=len(attempt.plan) if attempt.number else None,
    )
    live = LiveState(directory.path, ArmView(robot.capabilities, interlocks))
    attendance.until_judged.callback(live.close)
    attendance.observers.add(live)
    around.enter_context(Control(directory.path, engine, sink.event, prompt))
    return engine


def _weighing(attempt: Attempt, robot: Robot, sink: RunSink, attendance: Attendance) -> Weighing:
    """The judge of what is mounted; in a resumed run it knows what the first load weighed."""
    experiment = attempt.experiment
    weighing = Weighing(
        attempt.plan,
        experiment.robot.gravity_m_s2,
        robot.capabilities,
        experiment.spec.weigh,
        event=sink.event,
        waived=WEIGHING in attendance.waivers,
    )
    weighing.restore(attempt.before.first_load)
    return weighing


def _quietly(close: Callable[[], object]) -> None:
    with contextlib.suppress(HilError):
        close()


def _preflight(attempt: Attempt, robot: Robot, attendance: Attendance) -> Callable[[], None]:
    directory, waivers = attempt.directory, tuple(attendance.waivers)

    def keep(name: str, document: Any) -> None:
        directory.write_json(name_of_attempt(name, attempt.number), document)

    def check() -> None:
        context = preflight_context(attempt.experiment.robot, directory.path, waivers=waivers)
        results = require_preflight(attempt.todo, robot, context, keep=keep)
        checks = [result.to_dict() for result in results]
        attendance.observers.publish({"kind": "preflight", "checks": checks})

    return check
