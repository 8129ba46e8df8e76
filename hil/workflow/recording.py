"""The motion of a run: robot, plan, run directory, preflight, engine. Nothing is fitted in here.

A run is recorded in attempts: `record` makes the first one, `hil.workflow.resuming` further ones.
An `Attempt` has everything that was written before the motion; `execute` ends it with a stop
document, whatever happens. What the engine measures and reports goes to a `RunSink`: samples to the
recorder, events to the event log and the recorder.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from hil.arms import load_arm, model_sha256
from hil.core import DataError, HilError, RecordingError, StructArray, exit_code_of, plugins
from hil.engine import (
    Engine,
    GoOn,
    Observers,
    Outcome,
    Prompt,
    RunResult,
    SignalWatch,
    nobody_goes_on,
    preflight_context,
    require_preflight,
    require_room_to_begin,
)
from hil.excitation import Advance
from hil.importers import Completeness, completeness_of
from hil.planning import Experiment, Plan, close_robot, held, plan_for, swept
from hil.recording import (
    Attachment,
    Counts,
    McapWriter,
    Recorder,
    RunDirectory,
    collect_provenance,
    name_of_attempt,
)
from hil.robot import STATE_TOPIC, Capabilities, HasTopics, Robot, state_topic
from hil.spec import StationRobot, require_judgeable, spec_hash
from hil.workflow.checks import require_extras, require_within_reach
from hil.workflow.interlocks import RunInterlocks
from hil.workflow.live_state import ArmView, LiveState
from hil.workflow.motion_confirmation import Confirm, Gate, Unconfirmed, loads_document, was_shown
from hil.workflow.operator import prompt_on, require_attended
from hil.workflow.payload_check import CHECK as WEIGHING
from hil.workflow.payload_check import PayloadCheck, Readings
from hil.workflow.remote_control import Control, hold_attempt


@dataclass(frozen=True, slots=True)
class Attendance:
    """Operator, observers and signals of a run.

    Attributes:
        observers: Receive progress events.
        signals: Open; guards the motion.
        prompt: Asks the operator; a robot on a virtual clock answers by itself.
        go_on: Returns whether the operator ends a pause.
        operator: Name of the operator; empty for the user of this process.
        waivers: Preflight check → why its failure is accepted.
        wait_s: How long to wait for a robot that another process holds [s].
        confirm: Confirms that a real robot may move.
        until_judged: Holds what stays open until the run has been judged and reported.
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
        """Publish what is done now."""
        self.observers.publish({"kind": "stage", "stage": text})

    def planned(self, plan: Plan) -> None:
        """Publish the space that the motions of `plan` sweep, before anything moves."""
        space = swept(plan, load_arm(plan.robot_model))
        self.observers.publish({"kind": "plan", **space.to_dict(), "lines": space.lines()})

    def computing(self, advance: Advance) -> None:
        """Publish the progress of trajectories that take long to compute."""
        self.observers.publish(advance.to_event())


def record(
    experiment: Experiment, *, runs: Path, attendance: Attendance, opened: Robot | None = None
) -> Recorded:
    """Plan, check and execute; leaves a complete run directory, whatever happens.

    Args:
        experiment: What to do, and where.
        runs: Where run directories are kept.
        attendance: Operator, observers and signals.
        opened: The robot, if it is open already.

    Raises:
        SpecError, PlanError, PluginError, RobotError: Before a run directory exists.
        PreflightFailed: The run has prompts that could not be answered, or the disk has no room for
            what a run begins with.
        NotConfirmed: The robot is a real one, and its motion was not confirmed.
        RecordingError: The run directory cannot be made.
    """
    gate = Gate(experiment, attendance.confirm)
    with held(
        experiment,
        wait_s=attendance.wait_s,
        report=attendance.stage,
        admit=gate.admit,
        robot=opened,
    ) as (robot, lease):
        require_within_reach(experiment, robot.capabilities)
        require_usable(experiment, robot)
        attendance.stage("planning")
        plan = plan_for(experiment, robot, attendance.computing)
        if (part := experiment.commissioning) is not None:
            experiment = replace(experiment, commissioning=part.within(plan))
        require_attended(plan, prompt_on(robot, attendance.prompt))
        interlocks = RunInterlocks(experiment, robot, plan)
        require_room_to_begin(runs)
        confirmed = gate.confirmation(robot, plan)
        if not was_shown(confirmed):
            attendance.planned(plan)
        with attendance.signals.guard():
            directory = RunDirectory.create(
                runs,
                experiment.spec.robot,
                experiment.spec.name,
                begin=lambda draft: write_beginning(
                    draft,
                    experiment,
                    robot,
                    plan,
                    attendance.operator,
                    attendance.waivers,
                    confirmed,
                ),
            )
            attendance.until_judged.enter_context(hold_attempt(directory.path))
            lease.note_run(directory.path)
            attendance.stage(f"running {plan.name} → {directory.path}")
            attempt = Attempt(directory, 0, experiment, plan, plan, interlocks)
            return execute(attempt, robot, attendance)


def require_usable(experiment: Experiment, robot: Robot) -> None:
    """Raise before any motion what would only fail after hours of it: units and plug-ins.

    A commissioning run is neither fitted nor judged, so it needs none of them.

    Raises:
        SpecError: The criteria are in another unit than the robot's efforts.
        PluginError: An estimator, a study or an extra is missing.
    """
    if experiment.commissioning is not None:
        return
    require_judgeable(experiment.spec, robot.capabilities.effort_kind)
    for fit in experiment.spec.fit:
        plugins.load("hil.estimators", fit.estimator)
    for entry in experiment.spec.study:
        plugins.load("hil.studies", entry.study)
    require_extras(experiment.spec)


def write_beginning(
    directory: RunDirectory,
    experiment: Experiment,
    robot: Robot,
    plan: Plan,
    operator: str,
    waivers: Mapping[str, str],
    confirmation: Mapping[str, Any] | None = None,
) -> None:
    """Store what the run starts from: spec, station, plan and start document.

    Args:
        directory: Of the run.
        experiment: What is done, and where.
        robot: Connected.
        plan: What is executed.
        operator: Name of the operator; empty for the user of this process.
        waivers: Preflight check → why its failure is accepted.
        confirmation: How the motion of a real robot was confirmed; None if it need not be.

    Raises:
        RecordingError: The disk refuses.
    """
    directory.write_text("spec.yaml", experiment.spec_text)
    directory.write_text("station.yaml", experiment.station_text)
    directory.write_json("plan.json", plan.to_dict())
    provenance = collect_provenance(spec_folder=experiment.folder)
    if operator:
        provenance["operator"] = operator
    part = experiment.commissioning
    directory.write_start(
        provenance
        | {
            "experiment": experiment.spec.name,
            "plan_hash": plan.hash,
            "spec_hash": spec_hash(experiment.spec),
            **({"spec": whole(experiment.spec_source)} if experiment.spec_source else {}),
            **({"overrides": dict(experiment.overrides)} if experiment.overrides else {}),
            "station": whole(experiment.station_source),
            "robot_name": experiment.spec.robot,
            "robot": describe_robot(robot, experiment.robot),
            "loads": loads_document(plan.loads),
            "seed": experiment.spec.excitation.seed,
            **({} if part is None else {"commissioning": part.to_dict()}),
            **({"occasion": experiment.occasion} if experiment.occasion else {}),
            **({"confirmation": dict(confirmation)} if confirmation else {}),
            "waivers": [
                {"check": check, "reason": reason, "who": provenance["operator"]}
                for check, reason in waivers.items()
            ],
        }
    )


def describe_robot(robot: Robot, station_robot: StationRobot) -> dict[str, Any]:
    """Return what the start document says about the robot."""
    can = robot.capabilities
    digest = model_sha256(station_robot.model)
    return {
        "model": station_robot.model,
        **({"model_sha256": digest} if digest else {}),
        "gravity_m_s2": list(station_robot.gravity_m_s2),
        "identity": asdict(robot.identity),
        "joint_names": list(can.joint_names),
        "rate_hz": can.rate_hz,
        "clock": can.clock,
        "effort_kind": can.effort_kind,
        "drive_gains": list(can.drive_gains),
        "drive_gains_source": can.drive_gains_source,
    }


def recorded_capabilities(run: RunDirectory) -> Capabilities:
    """Return what the robot of a run offered, from the start document: the part that viewers need.

    Raises:
        DataError: The document lacks the robot.
    """
    try:
        robot = run.start["robot"]
        return Capabilities(
            joint_names=tuple(map(str, robot["joint_names"])),
            rate_hz=float(robot["rate_hz"]),
            effort_kind=robot["effort_kind"],
            clock=robot["clock"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{run.path}/start.json does not say what the robot was: {error}",
            hint="resume without --live",
        ) from error


def whole(source: str) -> str:
    """Return an absolute path: a run may be resumed from another working directory."""
    return str(Path(source).resolve()) if Path(source).is_file() else source


COUNTED = ("samples", "gaps", "missing", "duplicates", "overruns")
NOTHING: Mapping[str, int] = dict.fromkeys(COUNTED, 0)


@dataclass(frozen=True, slots=True)
class Before:
    """What earlier attempts of a run recorded.

    Attributes:
        counts: Of the robot record, see `Recorded.counts`.
        device_s: Duration of their samples by the robot's clock [s].
        first_load: Payload check of the first load, see `readings_of_earlier_attempts`.
    """

    counts: Mapping[str, int] = field(default_factory=lambda: NOTHING)
    device_s: float = 0.0
    first_load: Readings = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Attempt:
    """An attempt that is about to be executed.

    Attributes:
        directory: The run; everything before the motion is written.
        number: 0 for the first attempt.
        experiment: Spec and station.
        plan: Of the whole run.
        todo: The part of the plan that is executed now, from where the robot stands.
        interlocks: Those of the spec, for this robot and plan.
        before: What the attempts before this one recorded.
    """

    directory: RunDirectory
    number: int
    experiment: Experiment
    plan: Plan
    todo: Plan
    interlocks: RunInterlocks
    before: Before = field(default_factory=lambda: Before())


def execute(attempt: Attempt, robot: Robot, attendance: Attendance) -> Recorded:
    """Check and execute an attempt; leaves a stop document, whatever happens.

    Signals must be guarded.

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


def _quietly(close: Callable[[], object]) -> None:
    with contextlib.suppress(HilError):
        close()


def open_recorder(
    directory: RunDirectory, attempt: int, robot: Robot, experiment: Experiment
) -> Recorder:
    """Return the recorder of a new attempt; its files begin with the documents of the run.

    Raises:
        RecordingError: The file cannot be made.
    """
    can, uid = robot.capabilities, str(directory.start["uid"])
    unit = "A" if can.effort_kind == "current" else "N·m"
    topic = state_topic(len(can.joint_names), can.rate_hz, clock=can.clock, effort_unit=unit)
    names = ["spec.yaml", "station.yaml", "plan.json", "start.json"]
    names += [name_of_attempt("resume.json", attempt)] if attempt else []
    attachments = [
        Attachment(name, _media_type(name), (directory.path / name).read_bytes()) for name in names
    ]

    def open_part(part: int) -> McapWriter:
        about = {"attempt": str(attempt), "part": str(part)}
        return McapWriter(
            directory.part_path(attempt, part),
            [topic, *(robot.topics if isinstance(robot, HasTopics) else ())],
            metadata={"run": {"uid": uid, "name": experiment.spec.name, **about}},
            attachments=attachments,
            joint_names=can.joint_names,
        )

    return Recorder(
        open_part(0),
        next_part=open_part,
        rotate_bytes=experiment.spec.record.rotate_mb * 1e6,
        on_backlog="wait" if can.clock == "virtual" else "raise",
    )


def _media_type(name: str) -> str:
    return "application/json" if name.endswith(".json") else "application/yaml"


def _engine(
    attempt: Attempt,
    robot: Robot,
    attendance: Attendance,
    recorder: Recorder,
    sink: RunSink,
    around: contextlib.ExitStack,
) -> Engine:
    """Return the engine; what is to be closed after its run is added to `around`."""
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
        measured=_payload_check(attempt, robot, sink, attendance).measured,
        health=sink.health,
        stale_after_s=interlocks.stale_after_s,
        steps=len(attempt.plan) if attempt.number else None,
    )
    live = LiveState(directory.path, ArmView(robot.capabilities, interlocks))
    attendance.until_judged.callback(live.close)
    attendance.observers.add(live)
    around.enter_context(Control(directory.path, engine, sink.event, prompt))
    return engine


def _payload_check(
    attempt: Attempt, robot: Robot, sink: RunSink, attendance: Attendance
) -> PayloadCheck:
    """Return the payload check; in a resumed run it knows what the first load weighed."""
    experiment = attempt.experiment
    check = PayloadCheck(
        attempt.plan,
        experiment.robot.gravity_m_s2,
        robot.capabilities,
        experiment.spec.weigh,
        event=sink.event,
        waived=WEIGHING in attendance.waivers,
    )
    check.restore(attempt.before.first_load)
    return check


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


@dataclass(frozen=True, slots=True)
class Recorded:
    """A run whose motion has ended.

    Attributes:
        directory: The run directory, complete up to its stop document.
        result: How the run ended; `failed` if the recording lacks something.
        counts: `samples`, `gaps`, `missing`, `duplicates`, `overruns` of the robot record, over
            all attempts.
    """

    directory: RunDirectory
    result: RunResult
    counts: Mapping[str, int]


class RunSink:
    """The engine's sink for one attempt.

    Args:
        directory: Of the run; its event log is continued.
        recorder: Of the attempt.
    """

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

    def health(self) -> Mapping[str, float]:
        """Return gaps and backlog of the recording, for progress events."""
        counts = counts_of(self._recorder.counts[STATE_TOPIC])
        del counts["samples"]
        return {**counts, "behind_s": self._recorder.behind_s}

    def close(self) -> list[HilError]:
        """Finish recording and log; return what went wrong in either."""
        problems = []
        for close in (self._recorder.close, self._log.close):
            try:
                close()
            except HilError as error:
                problems.append(error)
        return problems


def finish(
    attempt: Attempt, result: RunResult, recorder: Recorder, sink: RunSink, observers: Observers
) -> Recorded:
    """Close everything, then write the stop document, whatever goes wrong in closing."""
    lost = sink.close()
    complete, problem = _completeness(attempt)
    notes = (*result.notes, *(e.message for e in lost), *observers.problems())
    notes += (problem.message,) if problem and not complete and result.error else ()
    result = replace(result, notes=notes)
    if result.error is None and (error := lost[0] if lost else problem):
        result = replace(result, outcome=Outcome.FAILED, reason=error.message, error=error)
    own = counts_of(recorder.counts[STATE_TOPIC])
    counts = {name: own[name] + attempt.before.counts[name] for name in COUNTED}
    document = {
        **counts,
        "steps_done": _steps_done(attempt, result),
        "unsettled": sorted(complete.unsettled) if complete else list(result.unsettled),
        "complete": complete.to_dict() if complete else {},
        "device_s": result.device_s + attempt.before.device_s,
        "wall_s": result.wall_s,
        "recorded": recorded_span(recorder.counts[STATE_TOPIC]),
        "exit_code": exit_code_of(result.error) if result.error else 0,
        "problems": list(notes),
        **({"hint": result.error.hint} if result.error and result.error.hint else {}),
    }
    attempt.directory.write_stop(
        result.outcome.value, result.reason, document, attempt=attempt.number
    )
    return Recorded(attempt.directory, result, counts)


def _completeness(attempt: Attempt) -> tuple[Completeness | None, HilError | None]:
    """Return what was measured, by the recording; and an error if it is unreadable or incomplete.

    Motion that came to its end is no success if its recording lacks a part.
    """
    try:
        complete = completeness_of(attempt.plan, attempt.directory.recordings)
    except HilError as error:
        message = f"the recording could not be read back: {error.message}"
        return None, RecordingError(message, hint=error.hint)
    except Exception as error:  # the motion is over: whatever this is, its end must be written
        return None, RecordingError(
            f"the recording could not be read back: {error!r}",
            hint="hil recover RUN makes whole what is left of it",
        )
    if not complete.missing:
        return complete, None
    commissioning = "commissioning" in attempt.directory.start
    message = f"the recording lacks measurements: {complete} are whole"
    if slowed := len(complete.slowed):
        message += f"; {slowed} were measured slower than planned and are excluded"
    again = "run the experiment again" if commissioning else f"hil resume {attempt.directory.path}"
    return complete, RecordingError(message, hint=f"measure what is missing: {again}")


def _steps_done(attempt: Attempt, result: RunResult) -> int:
    """Return the number of steps of the plan that need not be executed any more."""
    left = {step.index for step in attempt.todo.steps[result.steps_done :] if step.index >= 0}
    return len(attempt.plan) - len(left)


def counts_of(counts: Counts) -> dict[str, int]:
    """Return the counts of a recording that stop documents and verdicts use."""
    return {name: int(getattr(counts, name)) for name in COUNTED}


def recorded_span(counts: Counts) -> list[float]:
    """Return the device time of the first and the last sample [s]; empty without samples."""
    return [counts.first_time, counts.last_time] if counts.samples else []
