"""One recorded run: robot, plan, preflight, motion, run directory. No fitting in here."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil import plugins
from hil.campaign.beginning import open_recorder, write_beginning
from hil.campaign.experiment import Experiment
from hil.campaign.operator import mock_mounts
from hil.campaign.robots import close_robot, connected, plan_for
from hil.engine import Engine, Observers, Outcome, Prompt, RunResult
from hil.engine.interlocks import from_spec
from hil.engine.signals import SignalWatch
from hil.errors import HilError
from hil.plan.plan import Plan
from hil.preflight import preflight_context, require_preflight
from hil.record.recorder import Recorder
from hil.record.rundir import RunDirectory
from hil.record.topic import STATE_TOPIC
from hil.robot import Robot
from hil.spec.judgeable import require_judgeable
from hil.typing import StructArray

NO_WAIVERS: Mapping[str, str] = {}
COUNTED = ("samples", "gaps", "missing", "duplicates", "overruns")


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the motion left behind.

    Attributes:
        directory: The run directory, complete up to `stop.json`.
        result: How the run ended; a recording that could not be kept makes it `failed`.
        counts: `samples`, `gaps`, `missing`, `duplicates`, `overruns` of the robot record.
    """

    directory: RunDirectory
    result: RunResult
    counts: Mapping[str, int]


class RunSink:
    """What the engine writes to: samples to the recorder, events to the log and the recorder."""

    def __init__(self, directory: RunDirectory, recorder: Recorder) -> None:
        self._log = directory.event_log()
        self._recorder = recorder

    def put(self, rows: StructArray) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put(STATE_TOPIC, rows)

    def put_topic(self, topic: str, rows: StructArray) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put(topic, rows)

    def event(self, kind: str, **details: Any) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put_event(self._log.append(kind, **details))

    def close(self) -> list[HilError]:
        """Finish recording and log; returns what went wrong in either."""
        problems = []
        for close in (self._recorder.close, self._log.close):
            try:
                close()
            except HilError as error:
                problems.append(error)
        return problems


def record(
    experiment: Experiment,
    *,
    runs: Path,
    operator: str = "",
    observers: Observers,
    prompt: Prompt,
    signals: SignalWatch,
    waivers: Mapping[str, str] = NO_WAIVERS,
) -> Recorded:
    """Plan, check and execute; leaves a complete run directory however it ends.

    Args:
        experiment: What to do, and where.
        runs: Where run directories are kept.
        operator: Who is at the robot; by default the user of this process.
        observers: Told about progress.
        prompt: Asks the operator; a robot on a virtual clock confirms by itself.
        signals: Open; guards the motion.
        waivers: Preflight check → why its failure is accepted.

    Raises:
        SpecError, PlanError, PluginError, RobotError: Before a run directory exists.
        RecordingError: The run directory cannot be made.
    """
    with connected(experiment.spec.robot, experiment.robot) as robot:
        _require_usable(experiment, robot)
        observers.publish({"kind": "stage", "stage": "planning"})
        plan = plan_for(experiment, robot)
        with signals.guard():
            directory = RunDirectory.create(runs, experiment.spec.robot, experiment.spec.name)
            open_files = contextlib.ExitStack()
            try:
                write_beginning(directory, experiment, robot, plan, operator, waivers)
                recorder = open_recorder(directory, robot, experiment)
                open_files.callback(_quietly, recorder.close)
                sink = RunSink(directory, recorder)
            except BaseException as error:
                open_files.close()
                with contextlib.suppress(HilError):
                    directory.write_stop("failed", str(error) or type(error).__name__)
                raise
            observers.publish({"kind": "stage", "stage": f"running {plan.name} → {directory.path}"})
            engine = Engine(
                plan,
                robot,
                sink,
                interlocks=from_spec(experiment.spec.interlocks),
                observers=observers,
                prompt=mock_mounts if robot.capabilities.clock == "virtual" else prompt,
            )
            signals.bind(engine, robot)
            result = engine.run(_preflight(directory, plan, robot, experiment, tuple(waivers)))
            result = replace(result, notes=(*result.notes, *close_robot(robot)))
            return _finish(directory, result, recorder, sink, observers)


def _quietly(close: Callable[[], object]) -> None:
    with contextlib.suppress(HilError):
        close()


def _require_usable(experiment: Experiment, robot: Robot) -> None:
    """What would only fail after hours of motion is refused before it: units and plug-ins."""
    require_judgeable(experiment.spec, robot.capabilities.effort_kind)
    for fit in experiment.spec.fit:
        plugins.load("hil.estimators", fit.estimator)


def _preflight(
    directory: RunDirectory,
    plan: Plan,
    robot: Robot,
    experiment: Experiment,
    waivers: tuple[str, ...],
) -> Callable[[], None]:
    def check() -> None:
        context = preflight_context(experiment.robot, directory.path, waivers=waivers)
        require_preflight(plan, robot, context, keep=directory.write_json)

    return check


def _finish(
    directory: RunDirectory,
    result: RunResult,
    recorder: Recorder,
    sink: RunSink,
    observers: Observers,
) -> Recorded:
    """Close everything, then write the stop document, whatever went wrong in closing."""
    lost = sink.close()
    notes = (*result.notes, *(error.message for error in lost), *observers.problems())
    result = replace(result, notes=notes)
    if lost and result.error is None:
        error = lost[0]
        result = replace(result, outcome=Outcome.FAILED, reason=error.message, error=error)
    final = recorder.counts[STATE_TOPIC]
    counts = {name: int(getattr(final, name)) for name in COUNTED}
    document = {
        **counts,
        "steps_done": result.steps_done,
        "unsettled": list(result.unsettled),
        "device_s": result.device_s,
        "wall_s": result.wall_s,
        "problems": list(notes),
    }
    directory.write_stop(result.outcome.value, result.reason, document)
    return Recorded(directory, result, counts)
