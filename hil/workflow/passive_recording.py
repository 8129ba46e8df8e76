"""Passive recording of a robot that a different program drives (`hil record`); sends no commands.

A passive recording creates a run directory whose steps (dwells, moves, trajectories) are detected
in the samples instead of planned. Samples are written in the order in which the robot sends them;
`hil.importers.Segmenter` marks the dwells while the samples arrive.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import (
    HilError,
    PluginError,
    RobotTimeout,
    SpecError,
    StructArray,
    did_you_mean,
    exit_code_of,
    hold_run,
)
from hil.dynamics import load_model
from hil.engine import SignalWatch
from hil.estimators import StaticWls
from hil.importers import PASSIVE_PLAN_FILE, DetectedSteps, Segmenter
from hil.planning import BUILT_IN, close_robot, find_station, open_robot
from hil.recording import Attachment, McapWriter, Recorder, RunDirectory, collect_provenance
from hil.robot import STATE_TOPIC, HasTopics, Listens, Robot, Status, state_topic
from hil.spec import StationRobot
from hil.workflow.recording import RunSink, counts_of, describe_robot


@dataclass(frozen=True, slots=True)
class RecordingRequest:
    """Robot and end conditions of a passive recording.

    The recording ends as soon as one of its end conditions occurs. Ctrl-C ends the recording in
    every case.

    Attributes:
        robot: Name of the robot in the station file.
        name: Name of the recording.
        for_s: Duration by the robot's clock [s]; None for an unlimited duration.
        until_program_stops: Whether the recording ends when the robot program stops; the program
            may start after the recording has begun.
        payload: Mounted payload; None if no payload was declared.
        operator: Name of the operator; the user of this process if the name is empty.
    """

    robot: str
    name: str = "recording"
    for_s: float | None = None
    until_program_stops: bool = False
    payload: Payload | None = None
    operator: str = ""


@dataclass(frozen=True, slots=True)
class PassiveResult:
    """Result of a passive recording.

    Attributes:
        run: Run directory.
        reason: Reason why the recording ended, as text.
        counts: Numbers of samples, gaps, missing samples, duplicates and overruns of the robot
            record.
        device_s: Duration from the first to the last sample [s].
        steps: Number of detected dwells, moves and trajectories, by kind.
        notes: Texts about limits for the use of the recording.
        error: Error that ended the recording early; None if there was no error.
    """

    run: Path
    reason: str
    counts: dict[str, int]
    device_s: float
    steps: dict[str, int]
    notes: tuple[str, ...] = ()
    error: HilError | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON output of `hil record --json`."""
        document = {
            "run": str(self.run),
            "reason": self.reason,
            **self.counts,
            "device_s": self.device_s,
            "found": self.steps,
            "notes": list(self.notes),
        }
        if self.error is not None:
            document["error"] = {"kind": type(self.error).__name__, "message": self.error.message}
        return document


def record_passively(
    request: RecordingRequest,
    *,
    station: Path | None,
    runs: Path,
    tell: Callable[[str], object],
) -> PassiveResult:
    """Record a robot without driving it.

    Args:
        request: Robot and end conditions of the recording.
        station: Station file; by default the station that `hil run` would use in the working
            directory.
        runs: Folder in which the run directory is created.
        tell: Callback that receives the progress, one line at a time.

    Raises:
        SpecError: The station has no robot with this name.
        PluginError: The driver of the robot does not support passive recording.
        RobotError: The robot cannot be reached.
        RecordingError: The run directory or its stop document cannot be written.
    """
    bench, text, source = find_station(Path.cwd(), station)
    entry = bench.robots.get(request.robot)
    if entry is None:
        raise SpecError(
            f"the station {bench.name!r} has no robot {request.robot!r}",
            hint=did_you_mean(request.robot, bench.robots) + " (or choose a different --station)",
        )
    # A separate process would only serve to stop the arm, which is not driven here.
    robot = open_robot(request.robot, entry.model_copy(update={"own_process": False}))
    with SignalWatch() as signals:
        try:
            _require_listener(robot, entry.driver).listen()
            with signals.guard():
                directory = RunDirectory.create(
                    runs,
                    request.robot,
                    request.name,
                    begin=lambda draft: write_start(
                        draft, request, robot, entry, text or f"# {BUILT_IN}\n", source
                    ),
                )
                with hold_run(directory.path):
                    tell(f"recording → {directory.path}")
                    return PassiveRun(directory, request, robot, signals, tell).record()
        finally:
            close_robot(robot)


def _require_listener(robot: Robot, driver: str) -> Listens:
    """Return the robot; raise if its driver does not support passive recording.

    Raises:
        PluginError: The driver does not implement `hil.robot.Listens`.
    """
    if isinstance(robot, Listens):
        return robot
    raise PluginError(
        f"the driver {driver!r} cannot record a robot that it does not drive",
        hint="to record a motion that hil executes: hil run SPEC",
    )


def write_start(
    directory: RunDirectory,
    request: RecordingRequest,
    robot: Robot,
    entry: StationRobot,
    station_text: str,
    station_source: str,
) -> None:
    """Write the station file and the start document of a passive recording.

    The key `passive` of the start document distinguishes a passive recording from a run.

    Raises:
        RecordingError: One of the files cannot be written to the disk.
    """
    directory.write_text("station.yaml", station_text)
    provenance = collect_provenance()
    if request.operator:
        provenance["operator"] = request.operator
    payload = request.payload or Payload()
    directory.write_start(
        provenance
        | {
            "passive": True,
            "experiment": request.name,
            "station": station_source,
            "robot_name": request.robot,
            "robot": describe_robot(robot, entry),
            "loads": [
                {
                    "mass_kg": payload.mass,
                    "com_m": list(payload.com),
                    "inertia_kgm2": list(payload.inertia),
                    "declared": request.payload is not None,
                }
            ],
        }
    )


STOPPED_FOR_S = 1.0
"""Stop time after which a robot program counts as ended [s].

If one robot program replaces another, the controller reports a stopped program for less than this
time.
"""

SILENT_FOR_S = 5.0
"""Time without data after which the robot counts as disconnected [s]."""

NOT_USABLE = Status.FAULT | Status.MASKED
"""Bits of `status` that each mark the effort of a sample as unusable."""


class PassiveRun:
    """One passive recording, from its first row to its stop document."""

    def __init__(
        self,
        directory: RunDirectory,
        request: RecordingRequest,
        robot: Robot,
        signals: SignalWatch,
        tell: Callable[[str], object],
    ) -> None:
        self._directory, self._request, self._robot = directory, request, robot
        self._signals, self._tell = signals, tell
        self._segmenter, self._steps = Segmenter(), DetectedSteps()
        self._first = self._last = float("nan")
        self._began = False
        self._running_at = float("nan")
        self._unusable = 0

    def record(self) -> PassiveResult:
        """Record until an end condition or an error occurs, then write the stop document."""
        recorder: Recorder | None = None
        sink: RunSink | None = None
        error: HilError | None = None
        reason = ""
        try:
            recorder = open_recorder(self._directory, self._robot, self._request)
            sink = RunSink(self._directory, recorder)
            sink.event("listening", robot=self._request.robot)
            while not reason:
                self._take(sink)
                reason = self._signals.reason if self._signals.seen else self._why_over(sink)
        except HilError as problem:
            error, reason = problem, problem.message
        return self._finish(recorder, sink, reason, error)

    def _take(self, sink: RunSink) -> None:
        try:
            rows = self._robot.read(SILENT_FOR_S if not self._signals.seen else 0.1)
        except RobotTimeout:
            if self._signals.seen:
                return
            raise
        if not len(rows):
            return
        self._first = float(rows["device_time"][0]) if math.isnan(self._first) else self._first
        self._last = float(rows["device_time"][-1])
        self._unusable += int(np.count_nonzero(rows["status"] & NOT_USABLE))
        self._put(sink, self._segmenter.feed(rows))
        if isinstance(self._robot, HasTopics):
            for topic, further in self._robot.drain().items():
                sink.put_topic(topic, further)

    def _put(self, sink: RunSink, rows: StructArray) -> None:
        if len(rows):
            self._steps.add(rows)
            sink.put(rows)

    def _why_over(self, sink: RunSink) -> str:
        """Return the reason why the recording has ended; empty while the recording continues."""
        assert isinstance(self._robot, Listens)
        if self._robot.program_running:
            if not self._began:
                self._tell("a program is running")
                sink.event("program", running=True, device_time=self._last)
            self._began, self._running_at = True, self._last
        elif self._began and self._last - self._running_at >= STOPPED_FOR_S:
            self._began = False
            self._tell("the program has stopped")
            sink.event("program", running=False, device_time=self._last)
            if self._request.until_program_stops:
                return "the program has stopped"
        for_s = self._request.for_s
        if for_s is not None and self._last - self._first >= for_s:
            return f"the duration of {for_s:g} s has elapsed"
        return ""

    def _finish(
        self,
        recorder: Recorder | None,
        sink: RunSink | None,
        reason: str,
        error: HilError | None,
    ) -> PassiveResult:
        problems: list[HilError] = []
        if sink is not None:
            waiting = self._segmenter.flush()
            if waiting is not None:
                with contextlib.suppress(HilError):  # closing reports the error
                    self._put(sink, waiting)
            problems = sink.close()
        error = error or (problems[0] if problems else None)
        steps, steps_by_kind = self._steps.steps(), self._steps.counts()
        robot = self._directory.start["robot"]
        payload = self._request.payload or Payload()
        plan = self._steps.document(name=self._request.name, robot=robot, payload=payload)
        with contextlib.suppress(HilError):  # steps can be detected again from the rows
            self._directory.write_json(PASSIVE_PLAN_FILE, plan)
        counts = counts_of(recorder.counts[STATE_TOPIC]) if recorder else {}
        device_s = self._last - self._first if math.isfinite(self._last) else 0.0
        notes = (
            *_notes(self._request, counts),
            *unusable_notes(self._unusable, counts),
            *fit_notes(steps_by_kind, robot),
        )
        document = {
            **counts,
            "steps_done": len(steps),
            "unsettled": [],
            "complete": {kind: {"done": n, "of": n} for kind, n in steps_by_kind.items()},
            "device_s": device_s,
            "exit_code": exit_code_of(error) if error else 0,
            "problems": [*(one.message for one in problems)],
        }
        self._directory.write_stop("failed" if error else "completed", reason, document)
        return PassiveResult(
            self._directory.path, reason, counts, device_s, steps_by_kind, notes, error
        )


ROTATE_BYTES = 1e9


def open_recorder(directory: RunDirectory, robot: Robot, request: RecordingRequest) -> Recorder:
    """Return the recorder for the robot record and for the additional topics of the robot.

    Raises:
        RecordingError: The recording file cannot be created.
    """
    can, start = robot.capabilities, directory.start
    unit = "A" if can.effort_kind == "current" else "N·m"
    topics = [
        state_topic(len(can.joint_names), can.rate_hz, clock=can.clock, effort_unit=unit),
        *(robot.topics if isinstance(robot, HasTopics) else ()),
    ]
    text = (directory.path / "start.json").read_bytes()

    def open_part(part: int) -> McapWriter:
        about = {"uid": str(start["uid"]), "name": request.name, "attempt": "0", "part": str(part)}
        return McapWriter(
            directory.part_path(0, part),
            topics,
            metadata={"run": about},
            attachments=[Attachment("start.json", "application/json", text)],
            joint_names=can.joint_names,
        )

    return Recorder(
        open_part(0),
        next_part=open_part,
        rotate_bytes=ROTATE_BYTES,
        on_backlog="wait" if can.clock == "virtual" else "raise",
    )


def _notes(request: RecordingRequest, counts: dict[str, int]) -> tuple[str, ...]:
    notes = []
    if request.payload is None:
        notes.append(
            "no payload declared: 0 kg assumed; declare it with --payload MASS_KG[,X_M,Y_M,Z_M]"
        )
    if counts.get("missing"):
        notes.append(f"{counts['missing']} samples are missing in {counts['gaps']} gaps")
    return tuple(notes)


def unusable_notes(rows: int, counts: Mapping[str, int]) -> tuple[str, ...]:
    """Return a note if the arm was switched off, braked or stopped during the recording.

    Args:
        rows: Number of samples in which the arm was switched off, braked or stopped.
        counts: Counts of the recording, such as the number of samples.
    """
    if not rows:
        return ()
    return (
        f"{rows} of {counts.get('samples', rows)} samples were measured while the arm was not "
        "running (switched off, braked, or in a stop): these samples are stored, but not fitted",
    )


def fit_notes(steps: Mapping[str, int], robot: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a note if there are too few dwells for a fit and no trajectories.

    Args:
        steps: Number of dwells, moves and trajectories, by kind.
        robot: Entry of the start document that describes the robot.
    """
    dwells = steps.get("dwell", 0)
    need = 0 if steps.get("trajectory") else dwells_needed(robot)
    if dwells >= need:
        return ()
    return (
        f"{dwells} dwells are too few for static-wls, which needs {need}: record for longer, "
        "or fit several recordings together",
    )


def dwells_needed(robot: Mapping[str, Any]) -> int:
    """Return the minimum number of dwells for `static-wls`; 0 if the robot model is unknown."""
    try:
        model = load_model(str(robot["model"]), gravity=robot["gravity_m_s2"])
    except (HilError, KeyError):
        return 0
    return StaticWls().needs(model).least["dwells"]
