"""One attempt: preflight, motion, and an end that is written down however it came."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from hil.campaign.beginning import open_recorder
from hil.campaign.control import Control
from hil.campaign.experiment import Experiment
from hil.campaign.interlocks import interlocks_for
from hil.campaign.live_state import LiveState
from hil.campaign.operator import prompt_on
from hil.campaign.robots import close_robot
from hil.campaign.sink import COUNTED, RunSink, counts_of
from hil.data.completeness import Completeness, completeness_of
from hil.engine import Engine, Observers, Outcome, Prompt, RunResult
from hil.engine.pausing import GoOn, nobody_goes_on
from hil.engine.signals import SignalWatch
from hil.errors import HilError
from hil.plan.plan import Plan
from hil.preflight import preflight_context, require_preflight
from hil.record.parts import name_of_attempt
from hil.record.recorder import Recorder
from hil.record.rundir import RunDirectory
from hil.record.topic import STATE_TOPIC
from hil.robot import Robot

NOTHING: Mapping[str, int] = dict.fromkeys(COUNTED, 0)


@dataclass(frozen=True, slots=True)
class Attendance:
    """Who and what attends a run.

    Attributes:
        observers: Told about progress.
        signals: Open; guards the motion.
        prompt: Asks the operator; a robot on a virtual clock confirms by itself.
        go_on: Looks whether the operator ends a pause.
        operator: Who is at the robot; empty for the user of this process.
        waivers: Preflight check → why its failure is accepted.
        wait_s: How long to wait for a robot that somebody else holds [s].
    """

    observers: Observers
    signals: SignalWatch
    prompt: Prompt
    go_on: GoOn = nobody_goes_on
    operator: str = ""
    waivers: Mapping[str, str] = field(default_factory=dict)
    wait_s: float = 0.0

    def stage(self, text: str) -> None:
        """Tell observers what is being done."""
        self.observers.publish({"kind": "stage", "stage": text})


@dataclass(frozen=True, slots=True)
class Before:
    """What earlier attempts of a run recorded.

    Attributes:
        counts: Of the robot record, see `Recorded.counts`.
        device_s: Device time of their samples [s].
    """

    counts: Mapping[str, int] = field(default_factory=lambda: NOTHING)
    device_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Attempt:
    """What is about to be executed.

    Attributes:
        directory: The run; everything before the motion is written.
        number: 0 for the first attempt.
        experiment: Spec and station.
        plan: Of the whole run.
        todo: What of it is to be executed now, from where the robot stands.
        before: What the attempts before this one recorded.
    """

    directory: RunDirectory
    number: int
    experiment: Experiment
    plan: Plan
    todo: Plan
    before: Before = field(default_factory=lambda: Before())


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the motion left behind.

    Attributes:
        directory: The run directory, complete up to its stop document.
        result: How the run ended; a recording that could not be kept makes it `failed`.
        counts: `samples`, `gaps`, `missing`, `duplicates`, `overruns` of the robot record, over
            all attempts.
    """

    directory: RunDirectory
    result: RunResult
    counts: Mapping[str, int]


def execute(attempt: Attempt, robot: Robot, attendance: Attendance) -> Recorded:
    """Check and execute; leaves a stop document however it ends. Signals must be guarded.

    Raises:
        RecordingError: The recording cannot be opened; the stop document says so too.
    """
    directory, number = attempt.directory, attempt.number
    open_files = contextlib.ExitStack()
    try:
        recorder = open_recorder(directory, number, robot, attempt.experiment)
        open_files.callback(_quietly, recorder.close)
        sink = RunSink(directory, recorder)
        open_files.callback(_quietly, sink.close)
        interlocks = interlocks_for(
            attempt.experiment,
            robot,
            attempt.plan,
            folder=directory.path,
            behind_s=lambda: recorder.behind_s,
        )
    except BaseException as error:
        open_files.close()
        with contextlib.suppress(HilError):
            directory.write_stop("failed", str(error) or type(error).__name__, attempt=number)
        raise
    prompt = prompt_on(robot, attendance.prompt)
    engine = Engine(
        attempt.todo,
        robot,
        sink,
        interlocks=interlocks,
        observers=attendance.observers,
        prompt=prompt,
        go_on=attendance.go_on,
        health=sink.health,
        stale_after_s=interlocks.stale_after_s,
        steps=len(attempt.plan),
    )
    attendance.signals.bind(engine, robot)
    live = LiveState(directory.path)
    attendance.observers.add(live)
    with contextlib.closing(interlocks), Control(directory.path, engine, sink.event, prompt):
        result = engine.run(_preflight(attempt, robot, tuple(attendance.waivers)))
    live.close()
    result = replace(result, notes=(*result.notes, *close_robot(robot)))
    return _finish(attempt, result, recorder, sink, attendance.observers)


def _quietly(close: Callable[[], object]) -> None:
    with contextlib.suppress(HilError):
        close()


def _preflight(attempt: Attempt, robot: Robot, waivers: tuple[str, ...]) -> Callable[[], None]:
    directory = attempt.directory

    def keep(name: str, document: Any) -> None:
        directory.write_json(name_of_attempt(name, attempt.number), document)

    def check() -> None:
        context = preflight_context(attempt.experiment.robot, directory.path, waivers=waivers)
        require_preflight(attempt.todo, robot, context, keep=keep)

    return check


def _finish(
    attempt: Attempt, result: RunResult, recorder: Recorder, sink: RunSink, observers: Observers
) -> Recorded:
    """Close everything, then write the stop document, whatever went wrong in closing."""
    lost = sink.close()
    complete, problem = _completeness(attempt)
    notes = (*result.notes, *(e.message for e in lost), *problem, *observers.problems())
    result = replace(result, notes=notes)
    if lost and result.error is None:
        error = lost[0]
        result = replace(result, outcome=Outcome.FAILED, reason=error.message, error=error)
    own = counts_of(recorder.counts[STATE_TOPIC])
    counts = {name: own[name] + attempt.before.counts[name] for name in COUNTED}
    document = {
        **counts,
        "steps_done": len(attempt.plan) - (len(attempt.todo) - result.steps_done),
        "unsettled": sorted(complete.unsettled) if complete else list(result.unsettled),
        "complete": complete.to_dict() if complete else {},
        "device_s": result.device_s + attempt.before.device_s,
        "wall_s": result.wall_s,
        "problems": list(notes),
    }
    attempt.directory.write_stop(
        result.outcome.value, result.reason, document, attempt=attempt.number
    )
    return Recorded(attempt.directory, result, counts)


def _completeness(attempt: Attempt) -> tuple[Completeness | None, list[str]]:
    """What was measured, from the data, and what a run that came to its end is missing."""
    try:
        complete = completeness_of(attempt.plan, attempt.directory.recordings)
    except HilError as error:
        return None, [f"the recording could not be read back: {error.message}"]
    return complete, []
