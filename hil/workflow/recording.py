"""Recording of a run: open the robot, plan, create the run directory, check and execute the motion.

The recording of a run consists of one or more attempts. The function `record` makes the first
attempt of a run; the module `hil.workflow.resuming` makes the later attempts. An `Attempt`
describes an attempt whose documents are written and whose motion has not begun; `execute` carries
the attempt out and always writes a stop document. The engine sends samples and events to a
`RunSink`: samples go to the recorder, events go to the event log and the recorder. No model is
fitted in this module.
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
        observers: Receivers of progress events.
        signals: Open signal watch, which guards the motion.
        prompt: Function that asks the operator for a confirmation; prompts for a robot on a virtual
            clock are answered automatically.
        go_on: Function that returns whether the operator ends a pause.
        operator: Name of the operator; the user of this process if the name is empty.
        waivers: Reason for accepting a failed preflight check, by name of the check.
        wait_s: Maximum time to wait for a robot that another process uses [s].
        confirm: Function that confirms that a real robot may move.
        until_judged: Exit stack for resources that stay open until the run is judged and reported.
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
        """Publish the name of the stage of the run that begins now."""
        self.observers.publish({"kind": "stage", "stage": text})

    def planned(self, plan: Plan) -> None:
        """Publish the space that the motions of `plan` sweep, before the robot moves."""
        space = swept(plan, load_arm(plan.robot_model))
        self.observers.publish({"kind": "plan", **space.to_dict(), "lines": space.lines()})

    def computing(self, advance: Advance) -> None:
        """Publish the progress of a long computation of trajectories."""
        self.observers.publish(advance.to_event())


def record(
    experiment: Experiment, *, runs: Path, attendance: Attendance, opened: Robot | None = None
) -> Recorded:
    """Plan, check and execute an experiment, and return the recorded run.

    The run directory contains a stop document even if the run fails.

    Args:
        experiment: Spec and station of the run.
        runs: Folder in which the run directory is created.
        attendance: Operator, observers and signals.
        opened: Robot of the experiment, if the caller has already opened it.

    Raises:
        SpecError, PlanError, PluginError, RobotError: An error occurred before the run directory
            was created.
        PreflightFailed: The run has prompts that no operator could answer, or the disk has too
            little free space to begin a run.
        NotConfirmed: The operator did not confirm the motion of a real robot.
        RecordingError: The run directory cannot be created.
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
    """Raise before any motion if the units or plug-ins of an experiment are unusable.

    Without this check, a run with wrong units or missing plug-ins would fail only after hours of
    motion. A commissioning run is neither fitted nor evaluated, so the check of units and plug-ins
    is skipped.

    Raises:
        SpecError: The acceptance criteria use a different unit than the efforts of the robot.
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
    """Write the initial documents of a run: spec, station, plan and start document.

    Args:
        directory: Directory of the run.
        experiment: Spec and station of the run.
        robot: Connected robot.
        plan: Plan that will be executed.
        operator: Name of the operator; the user of this process if the name is empty.
        waivers: Reason for accepting a failed preflight check, by name of the check.
        confirmation: Record of the confirmation of a real robot's motion; None if no confirmation
            is needed.

    Raises:
        RecordingError: A file cannot be written to the disk.
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
    """Return the entry of the start document that describes the robot."""
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
    """Return the capabilities of a run's robot that viewers need, from the start document.

    Raises:
        DataError: The start document has no valid description of the robot.
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
            f"{run.path}/start.json does not describe the robot: {error}",
            hint="resume without --live",
        ) from error


def whole(source: str) -> str:
    """Return the absolute path, because a run may be resumed in a different working directory.

    A text that is not the path of a file is returned unchanged.
    """
    return str(Path(source).resolve()) if Path(source).is_file() else source


COUNTED = ("samples", "gaps", "missing", "duplicates", "overruns")
NOTHING: Mapping[str, int] = dict.fromkeys(COUNTED, 0)


@dataclass(frozen=True, slots=True)
class Before:
    """Totals over the earlier attempts of a run.

    Attributes:
        counts: Counts of the robot record in earlier attempts, see `Recorded.counts`.
        device_s: Duration of the samples in earlier attempts, by the robot's clock [s].
        first_load: Payload-check readings of the first load, see `readings_of_earlier_attempts`.
    """

    counts: Mapping[str, int] = field(default_factory=lambda: NOTHING)
    device_s: float = 0.0
    first_load: Readings = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Attempt:
    """Attempt of a run, ready to be executed.

    Attributes:
        directory: Run directory, which contains all documents that precede the motion.
        number: Number of the attempt; 0 for the first attempt.
        experiment: Experiment with spec and station.
        plan: Plan of the whole run.
        todo: Part of the plan that this attempt executes, which starts at the present pose of the
            robot.
        interlocks: Interlocks of the spec for this robot and plan.
        before: Totals over the earlier attempts of the run.
    """

    directory: RunDirectory
    number: int
    experiment: Experiment
    plan: Plan
    todo: Plan
    interlocks: RunInterlocks
    before: Before = field(default_factory=lambda: Before())


def execute(attempt: Attempt, robot: Robot, attendance: Attendance) -> Recorded:
    """Check and execute an attempt; the stop document is written even if the attempt fails.

    The caller must guard the process signals during this method.

    Raises:
        RecordingError: The recording file cannot be opened; the stop document also contains the
            error.
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
    """Return the recorder of a new attempt; the documents of the run are attached to its files.

    Raises:
        RecordingError: The recording file cannot be created.
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
    """Return the engine of an attempt; add the resources to close after the run to `around`."""
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
    """Return the payload check; a resumed run restores the readings of the first load."""
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
    """Run whose motion has ended.

    Attributes:
        directory: Run directory, which contains the stop document.
        result: Outcome of the motion; `failed` if the recording is incomplete.
        counts: Counts `samples`, `gaps`, `missing`, `duplicates` and `overruns` of the robot
            record, summed over all attempts.
    """

    directory: RunDirectory
    result: RunResult
    counts: Mapping[str, int]


class RunSink:
    """Sink of the engine for one attempt.

    Args:
        directory: Run directory; new events are appended to its event log.
        recorder: Recorder of the attempt.
    """

    def __init__(self, directory: RunDirectory, recorder: Recorder) -> None:
        self._log = directory.event_log()
        self._recorder = recorder

    def put(self, rows: StructArray) -> None:
        """See `hil.engine.Sink`; write the samples to the recorder."""
        self._recorder.put(STATE_TOPIC, rows)

    def put_topic(self, topic: str, rows: StructArray) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put(topic, rows)

    def event(self, kind: str, **details: Any) -> None:
        """See `hil.engine.Sink`."""
        self._recorder.put_event(self._log.append(kind, **details))

    def health(self) -> Mapping[str, float]:
        """Return the gaps and the backlog of the recording, for progress events."""
        counts = counts_of(self._recorder.counts[STATE_TOPIC])
        del counts["samples"]
        return {**counts, "behind_s": self._recorder.behind_s}

    def close(self) -> list[HilError]:
        """Close recording and event log; return the errors that occurred while closing them."""
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
    """Close recording and event log, then write the stop document.

    The stop document is written even if closing the recording or the event log fails.
    """
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
    """Return the measured part of the plan, and an error if the recording is incomplete.

    A motion that reached its end still counts as failed if the recording lacks measurements. If the
    recording cannot be read, the measured part is None.
    """
    try:
        complete = completeness_of(attempt.plan, attempt.directory.recordings)
    except HilError as error:
        message = f"the recording could not be read back: {error.message}"
        return None, RecordingError(message, hint=error.hint)
    except Exception as error:  # the stop document must be written after any error
        return None, RecordingError(
            f"the recording could not be read back: {error!r}",
            hint="repair the recording: hil recover RUN",
        )
    if not complete.missing:
        return complete, None
    commissioning = "commissioning" in attempt.directory.start
    message = f"the recording lacks measurements: only {complete} are complete"
    if slowed := len(complete.slowed):
        message += f"; {slowed} were measured slower than planned and are excluded"
    again = "run the experiment again" if commissioning else f"hil resume {attempt.directory.path}"
    return complete, RecordingError(message, hint=f"measure the missing steps: {again}")


def _steps_done(attempt: Attempt, result: RunResult) -> int:
    """Return the number of steps of the plan that no longer have to be executed."""
    left = {step.index for step in attempt.todo.steps[result.steps_done :] if step.index >= 0}
    return len(attempt.plan) - len(left)


def counts_of(counts: Counts) -> dict[str, int]:
    """Return the counts of a recording that stop documents and verdicts use."""
    return {name: int(getattr(counts, name)) for name in COUNTED}


def recorded_span(counts: Counts) -> list[float]:
    """Return the device times of the first and the last sample [s]; empty tuple without samples."""
    return [counts.first_time, counts.last_time] if counts.samples else []
