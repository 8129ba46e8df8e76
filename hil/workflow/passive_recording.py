"""Record a robot that somebody else drives: a run directory with steps found, not planned."""

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
from hil.spec import Station, StationRobot
from hil.workflow.recording import RunSink, counts_of, describe_robot


def listen(
    wanted: Wanted, *, station: Path | None, runs: Path, tell: Callable[[str], object]
) -> Listened:
    """Record a robot without driving it.

    Args:
        wanted: What, and until when.
        station: Station file; by default as for `hil run`, from the present folder.
        runs: Where run directories are kept.
        tell: Is told how it goes, a line at a time.

    Raises:
        SpecError: The station has no such robot.
        PluginError: Its driver cannot listen.
        RobotError: It cannot be reached.
        RecordingError: The run directory cannot be made, or its end not be written.
    """
    bench, text, source = find_station(Path.cwd(), station)
    entry = _entry(bench, wanted.robot)
    # In this process, whatever the station says: there is no arm that would have to be stopped.
    robot = open_robot(wanted.robot, entry.model_copy(update={"own_process": False}))
    with SignalWatch() as signals:
        try:
            require_listener(robot, entry.driver).listen()
            with signals.guard():
                directory = RunDirectory.create(
                    runs,
                    wanted.robot,
                    wanted.name,
                    begin=lambda draft: write_start(
                        draft, wanted, robot, entry, text or f"# {BUILT_IN}\n", source
                    ),
                )
                with hold_run(directory.path):
                    tell(f"recording → {directory.path}")
                    return ListeningRun(directory, wanted, robot, signals, tell).run()
        finally:
            close_robot(robot)


def _entry(bench: Station, name: str) -> StationRobot:
    entry = bench.robots.get(name)
    if entry is None:
        raise SpecError(
            f"the station {bench.name!r} has no robot {name!r}",
            hint=did_you_mean(name, bench.robots) + " (or choose another --station)",
        )
    return entry


def require_listener(robot: Robot, driver: str) -> Listens:
    """The robot as one that can be listened to.

    Raises:
        PluginError: Its driver has not opted into `hil.robot.Listens`.
    """
    if isinstance(robot, Listens):
        return robot
    raise PluginError(
        f"the driver {driver!r} cannot record a robot that it does not drive",
        hint="record a program of hil's own with: hil run SPEC",
    )


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be recorded, and until when; whatever comes first. Ctrl-C always ends it.

    Attributes:
        robot: Name in the station.
        name: What people shall call the recording.
        for_s: Duration by the robot's clock [s]; None for no end.
        until_program_stops: End when a program, which may still have to begin, has stopped.
        payload: What is mounted; None when nobody has said.
        operator: Who is at the robot; empty for the user of this process.
    """

    robot: str
    name: str = "recording"
    for_s: float | None = None
    until_program_stops: bool = False
    payload: Payload | None = None
    operator: str = ""


@dataclass(frozen=True, slots=True)
class Listened:
    """What was recorded.

    Attributes:
        run: The run directory.
        reason: What ended it, in words.
        counts: Samples, gaps, missing, duplicates and overruns of the robot record.
        device_s: From the first sample to the last [s].
        steps: How many dwells, moves and trajectories were found.
        notes: For people.
        error: What ended it early.
    """

    run: Path
    reason: str
    counts: dict[str, int]
    device_s: float
    steps: dict[str, int]
    notes: tuple[str, ...] = ()
    error: HilError | None = None

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil record --json`."""
        out = {
            "run": str(self.run),
            "reason": self.reason,
            **self.counts,
            "device_s": self.device_s,
            "found": self.steps,
            "notes": list(self.notes),
        }
        if self.error is not None:
            out["error"] = {"kind": type(self.error).__name__, "message": self.error.message}
        return out


STOPPED_FOR_S = 1.0
"""A program that is replaced by another one stops in between, for less than this [s]."""

SILENT_FOR_S = 5.0
"""A robot that has nothing to say for so long is taken to be gone [s]."""

Tell = Callable[[str], object]

NOT_USABLE = Status.FAULT | Status.MASKED
"""Bits of `status` of which either says that the effort is no measurement."""


class ListeningRun:
    """One recording, from its first row to its stop document."""

    def __init__(
        self,
        directory: RunDirectory,
        wanted: Wanted,
        robot: Robot,
        signals: SignalWatch,
        tell: Tell,
    ) -> None:
        self._directory, self._wanted, self._robot = directory, wanted, robot
        self._signals, self._tell = signals, tell
        self._segmenter, self._steps = Segmenter(), DetectedSteps()
        self._first = self._last = float("nan")
        self._began = False
        self._running_at = float("nan")
        self._unusable = 0

    def run(self) -> Listened:
        """Record until the end; whatever ends it is written down."""
        recorder: Recorder | None = None
        sink: RunSink | None = None
        error: HilError | None = None
        reason = ""
        try:
            recorder = open_recorder(self._directory, self._robot, self._wanted)
            sink = RunSink(self._directory, recorder)
            sink.event("listening", robot=self._wanted.robot)
            while not reason:
                self._take(sink)
                reason = self._signals.reason if self._signals.seen else self._over(sink)
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

    def _over(self, sink: RunSink) -> str:
        """Why the recording is over; empty while it is not."""
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
            if self._wanted.until_program_stops:
                return "the program has stopped"
        for_s = self._wanted.for_s
        if for_s is not None and self._last - self._first >= for_s:
            return f"{for_s:g} s are over"
        return ""

    def _finish(
        self,
        recorder: Recorder | None,
        sink: RunSink | None,
        reason: str,
        error: HilError | None,
    ) -> Listened:
        problems: list[HilError] = []
        if sink is not None:
            held = self._segmenter.flush()
            if held is not None:
                with contextlib.suppress(HilError):  # closing says what it is
                    self._put(sink, held)
            problems = sink.close()
        error = error or (problems[0] if problems else None)
        found = self._steps.counts()
        self._write_plan()
        counts = counts_of(recorder.counts[STATE_TOPIC]) if recorder else {}
        device_s = self._last - self._first if math.isfinite(self._last) else 0.0
        notes = (
            *_notes(self._wanted, counts),
            *unusable_notes(self._unusable, counts),
            *fit_notes(found, self._directory.start["robot"]),
        )
        document = {
            **counts,
            "steps_done": len(self._steps.steps()),
            "unsettled": [],
            "complete": {kind: {"done": n, "of": n} for kind, n in found.items()},
            "device_s": device_s,
            "exit_code": exit_code_of(error) if error else 0,
            "problems": [*(one.message for one in problems)],
        }
        self._directory.write_stop("failed" if error else "completed", reason, document)
        return Listened(self._directory.path, reason, counts, device_s, found, notes, error)

    def _write_plan(self) -> None:
        plan = self._steps.document(
            name=self._wanted.name,
            robot=self._directory.start["robot"],
            payload=self._wanted.payload or Payload(),
        )
        with contextlib.suppress(HilError):  # it can be detected again from the rows
            self._directory.write_json(PASSIVE_PLAN_FILE, plan)


def _notes(wanted: Wanted, counts: dict[str, int]) -> tuple[str, ...]:
    notes = []
    if wanted.payload is None:
        notes.append(
            "no load declared: 0 kg assumed; declare one with --payload MASS_KG[,X_M,Y_M,Z_M]"
        )
    if counts.get("missing"):
        notes.append(f"{counts['missing']} samples are missing in {counts['gaps']} gaps")
    return tuple(notes)


ROTATE_BYTES = 1e9


def write_start(
    directory: RunDirectory,
    wanted: Wanted,
    robot: Robot,
    entry: StationRobot,
    station_text: str,
    station_source: str,
) -> None:
    """Store the station and the start document; `passive` tells it from a run.

    Raises:
        RecordingError: The disk refuses.
    """
    directory.write_text("station.yaml", station_text)
    provenance = collect_provenance()
    if wanted.operator:
        provenance["operator"] = wanted.operator
    payload = wanted.payload or Payload()
    directory.write_start(
        provenance
        | {
            "passive": True,
            "experiment": wanted.name,
            "station": station_source,
            "robot_name": wanted.robot,
            "robot": describe_robot(robot, entry),
            "loads": [
                {
                    "mass_kg": payload.mass,
                    "com_m": list(payload.com),
                    "inertia_kgm2": list(payload.inertia),
                    "declared": wanted.payload is not None,
                }
            ],
        }
    )


def open_recorder(directory: RunDirectory, robot: Robot, wanted: Wanted) -> Recorder:
    """The recorder of the robot record and of whatever else the robot tells.

    Raises:
        RecordingError: The file cannot be made.
    """
    can, start = robot.capabilities, directory.start
    unit = "A" if can.effort_kind == "current" else "N·m"
    topics = [
        state_topic(len(can.joint_names), can.rate_hz, clock=can.clock, effort_unit=unit),
        *(robot.topics if isinstance(robot, HasTopics) else ()),
    ]
    text = (directory.path / "start.json").read_bytes()

    def open_part(part: int) -> McapWriter:
        about = {"uid": str(start["uid"]), "name": wanted.name, "attempt": "0", "part": str(part)}
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


def unusable_notes(rows: int, counts: Mapping[str, int]) -> tuple[str, ...]:
    """That an arm was switched off, braked or stopped while it was recorded.

    Args:
        rows: Samples that say so.
        counts: Of the recording.
    """
    if not rows:
        return ()
    return (
        f"{rows} of {counts.get('samples', rows)} samples are of an arm that was not running "
        "(switched off, braked, or in a stop): they are kept, and not fitted to",
    )


def fit_notes(found: Mapping[str, int], robot: Mapping[str, Any]) -> tuple[str, ...]:
    """That there are fewer dwells than gravity has parameters, where there is nothing else to use.

    Args:
        found: Dwells, moves and trajectories.
        robot: Of the start document.
    """
    dwells = found.get("dwell", 0)
    need = 0 if found.get("trajectory") else dwells_needed(robot)
    if dwells >= need:
        return ()
    return (
        f"{dwells} dwells are too few for static-wls, which needs {need}: record longer, "
        "or fit to several recordings",
    )


def dwells_needed(robot: Mapping[str, Any]) -> int:
    """Return the fewest dwells that static-wls needs; 0 where the robot is unknown."""
    try:
        model = load_model(str(robot["model"]), gravity=robot["gravity_m_s2"])
    except (HilError, KeyError):
        return 0
    return StaticWls().needs(model).least["dwells"]
