"""Datasets from run directories and MCAP files, the two kinds of *source*.

The function `load_source` reads the documents of a source (start.json and plan.json of a run, the
metadata of an imported file), cuts the rows into the series described there, and assembles a
dataset.

Operators possibly edit the documents of a source. Each value of a document is checked before use,
so that a damaged document causes one clear error instead of a wrong number inside a fit.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hil.arms import Payload, require_same_arm
from hil.core import AnyPath, DataError, FloatArray, StructArray, read_json, shown, sources_of
from hil.data import AT_REST, SAMPLES_PER_DWELL, UPRIGHT, Dataset, SeriesKind
from hil.importers.completeness import dwell_is_over
from hil.importers.passive_plan import PASSIVE_PLAN_FILE, DetectedSteps
from hil.importers.series import (
    TORQUE_TARGET,
    Origin,
    Series,
    StepNote,
    assemble,
    base_record,
    cut,
    recorded_rows,
)
from hil.planning import DwellRule
from hil.recording import (
    PARTIAL_SUFFIX,
    RecordingInfo,
    RunDirectory,
    attempt_of,
    read_info,
    read_topic,
)
from hil.robot import TARGET_TOPIC

MEASURED_KINDS: tuple[SeriesKind, ...] = ("move", "dwell", "trajectory", "reference", "warmup")

ROBOT_METADATA = "robot"
PAYLOAD_METADATA = "payload"
WINDOW_PAYLOAD = "payload of window {}"
"""Name of the metadata record with the payload of a window that has a separate payload."""


def dataset(*sources: AnyPath | Iterable[AnyPath]) -> Dataset:
    """Return the samples of run directories or MCAP files, with their measuring conditions.

    Args:
        sources: One or more paths of sources, or lists of paths, all of one robot and one kind of
            effort.

    Returns:
        Columns of N rows by column name: `t` (N,) [s]; `q` (N, n) [rad], `qd` (N, n) [rad/s],
        `effort` (N, n) [A or N·m] and all other recorded quantities.

    Raises:
        DataError: No source was passed, a source cannot be read, or the sources belong to different
            robots.
        SpecError: An element of `sources` is not a path.
    """
    return Dataset.concatenate([load_source(source) for source in sources_of(*sources)])


def load_source(
    path: str | Path, kinds: Collection[SeriesKind] | None = None, *, any_arm: bool = False
) -> Dataset:
    """Return the samples of a run directory or MCAP file as series with their conditions.

    The plan of a run assigns every sample to a step. If a step was recorded several times (stop and
    resume), its last recording is used. An imported file contains one trajectory, or one trajectory
    per window of its import map. Rows that the robot marked as unusable, rows at a different speed
    than planned and rows with repeated time stamps are omitted. A pause in the time stamps cuts a
    series in two.

    Args:
        path: Path of a run directory or MCAP file.
        kinds: Kinds of series to return; by default all kinds that contain measurements. Omitting
            the moves of a long program of dwells saves most of the reading time.
        any_arm: Whether to accept a source whose arm description has changed since the recording;
            for callers that specify an arm themselves or need no arm.

    Raises:
        DataError: The source is missing, damaged or from a newer version of hil, does not identify
            its robot, or contains no samples; or the description of its arm has changed.
    """
    source, wanted = Path(path), MEASURED_KINDS if kinds is None else tuple(kinds)
    if not source.exists():
        raise DataError(
            f"{source} does not exist", hint="pass a run directory (see hil runs) or an MCAP file"
        )
    if not any_arm:
        require_arm_as_recorded(source, gone=True)
    samples = _from_run(source, wanted) if source.is_dir() else _from_file(source, wanted)
    return replace(samples, gravity=gravity_of(source))


def with_payload(dataset: Dataset, payload: Payload) -> Dataset:
    """Return the same samples with a different payload declared for them."""
    conditions = tuple(replace(c, payload=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)


# Robot of a source


def gravity_of(source: Path) -> tuple[float, float, float]:
    """Return gravity in the base frame of the robot of a source [m/s²].

    For a source without this value, the gravity of an upright base is returned.

    Raises:
        DataError: The source is missing, damaged or from a newer version of hil, or its gravity
            value is invalid.
    """
    with reading(f"{source}: its robot description"):
        return _vector(_robot_of(source).get("gravity_m_s2", UPRIGHT), "gravity_m_s2")


def serial_of(path: str | Path) -> str:
    """Return the serial number of the robot of a source; empty text if unknown.

    Raises:
        DataError: The source is missing, damaged or from a newer version of hil.
    """
    robot = _robot_of(Path(path))
    identity = robot.get("identity")
    read_back = identity.get("serial") if isinstance(identity, Mapping) else None
    return str(robot.get("serial") or read_back or "")


def require_arm_as_recorded(path: str | Path, *, gone: bool = False) -> None:
    """Raise if the description of a custom arm has changed since the recording of a source.

    Args:
        path: Path of a run directory or MCAP file.
        gone: Whether to accept a description file that cannot be read on this computer.

    Raises:
        DataError: The arm description has changed, or the source is missing, damaged or from a
            newer version of hil.
    """
    source = Path(path)
    otherwise = "pass the description of the arm: --robot FILE (hil fit, hil drive-gains)"
    require_same_arm(_robot_of(source), source, otherwise, gone=gone)


def _robot_of(source: Path) -> Mapping[str, Any]:
    """Return the robot description of a run, a recording of a run or an imported file."""
    if source.is_dir():
        return robot_of_run(RunDirectory.open(source).start)
    info = read_info(source)
    if "start.json" in info.attachments:
        return robot_of_run(_attached(info, "start.json"))
    robot: dict[str, Any] = dict(info.metadata.get(ROBOT_METADATA, {}))
    if "gravity_m_s2" in robot:
        with reading(f"{source}: gravity_m_s2"):
            robot["gravity_m_s2"] = json.loads(robot["gravity_m_s2"])
    return robot


def robot_of_run(start: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the robot description in a start document; empty if the document has none."""
    robot = start.get("robot")
    return robot if isinstance(robot, Mapping) else {}


# Run directories


def _from_run(path: Path, kinds: Collection[SeriesKind]) -> Dataset:
    run = RunDirectory.open(path)
    plan, plan_file = _plan_of(run)
    if not run.recordings:
        hint = "it was deleted on purpose: see pruned.json" if run.pruned else ""
        raise DataError(f"{path} contains no recording", hint=hint)
    described = DescribedRun(path, run.start, plan, plan_file, _unsettled(run))
    return dataset_of_attempts(described, _attempts_of(run), kinds)


@dataclass(frozen=True, slots=True, eq=False)
class DescribedRun:
    """Documents of a run that describe its recorded rows.

    Attributes:
        source: Path of the run directory.
        start: Start document.
        plan: Plan document.
        plan_file: Path of the plan, used in error messages.
        unsettled: Indices of the steps whose dwell ended by its time-out.
    """

    source: Path
    start: Mapping[str, Any]
    plan: Mapping[str, Any]
    plan_file: Path
    unsettled: Collection[int]


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """Recorded rows of one attempt of a run.

    Attributes:
        number: Number of the attempt, starting at 0.
        rows: All rows of the attempt, in order of time.
        completed: Whether the attempt ran to its end; a stop or kill cuts the last dwell short.
    """

    number: int
    rows: StructArray
    completed: bool


def dataset_of_attempts(
    run: DescribedRun, attempts: Iterable[Attempt], kinds: Collection[SeriesKind]
) -> Dataset:
    """Return the samples of a run whose rows have been read.

    Args:
        run: Documents of the run.
        attempts: Attempts of the run, in order of their numbers. For each step, the last attempt
            that recorded the step is used.
        kinds: Kinds of series that are returned.

    Raises:
        DataError: A document is invalid, or no sample is usable.
    """
    steps = steps_of_plan(run.plan, run.plan_file, run.unsettled, kinds)
    origin = _origin_of_run(run.start, str(run.source))
    rule = dwell_rule_of(run.plan, run.plan_file)
    latest: dict[int, list[Series]] = {}
    for attempt in attempts:
        pieces = cut(attempt.rows, steps, attempt.number)
        if not attempt.completed:
            pieces = _without_torn_dwell(pieces, attempt.rows, rule)
        latest |= {piece.step: [] for piece in pieces}
        for piece in pieces:
            latest[piece.step].append(piece)
    series = [piece for step in sorted(latest) for piece in latest[step]]
    return assemble(series, origin, rule.samples)


def _without_torn_dwell(pieces: list[Series], rows: StructArray, rule: DwellRule) -> list[Series]:
    """Return the series without an interrupted last dwell, which has possibly not settled."""
    last = int(rows["segment"][-1]) if len(rows) else -1
    return [
        piece
        for piece in pieces
        if piece.step != last or piece.note.kind not in AT_REST or dwell_is_over(piece.rows, rule)
    ]


def _attempts_of(run: RunDirectory) -> Iterator[Attempt]:
    for number, files in groupby(run.recordings, attempt_of):
        parts = [rows for file in files if (rows := _part(file)) is not None]
        if not parts:
            continue
        if len({part.dtype for part in parts}) > 1:
            raise DataError(
                f"{run.path}: the recordings of attempt {number} differ in their joints"
            )
        completed = (run.stop_of(number) or {}).get("outcome") == "completed"
        yield Attempt(number, np.concatenate(parts), completed)


def _part(file: Path) -> StructArray | None:
    """Return the rows of one recording of a run.

    The function returns None if the recording was torn before its first row.
    """
    if file.name.endswith(PARTIAL_SUFFIX):
        return recorded_rows(file)
    return base_record(file, read_topic(file, salvage=False))


def _plan_of(run: RunDirectory) -> tuple[dict[str, Any], Path]:
    """Return the plan of a run and the path of its file.

    For a passive recording, the plan that was detected is returned.

    If a passive recording was killed before its plan was stored, the plan is detected from the
    rows.
    """
    start, file = run.start, run.path / "plan.json"
    if start.get("passive"):
        file = run.path / PASSIVE_PLAN_FILE
    if file.exists() or not start.get("passive"):
        return read_json(file), file
    detected = DetectedSteps()
    for part in run.recordings:
        if (rows := _part(part)) is not None:
            detected.add(rows)
    with reading(run.path / "start.json"):
        payload = payload_of(start["loads"][0])
        name, robot = str(start["experiment"]), robot_of_run(start)
        return detected.document(name=name, robot=robot, payload=payload), file


def _unsettled(run: RunDirectory) -> set[int]:
    """Return the indices of all dwells that reached their time-out, over all attempts.

    The event log is read in addition to the stop document, because the event log survives a kill of
    the process.
    """
    events = (event for event in run.events() if event.get("kind") == "dwell")
    logged = {
        step: event.get("settled") for event in events if isinstance(step := event.get("step"), int)
    }
    listed = (run.stop or {}).get("unsettled", ())
    stopped = [step for step in listed if isinstance(step, int)] if isinstance(listed, list) else []
    return {step for step, settled in logged.items() if settled is False} | set(stopped)


# MCAP files


def _from_file(path: Path, kinds: Collection[SeriesKind]) -> Dataset:
    info = read_info(path)
    rows = base_record(path, read_topic(path, salvage=not info.complete))
    if "plan.json" in info.attachments and "start.json" in info.attachments:
        start, plan = (_attached(info, name) for name in ("start.json", "plan.json"))
        # A single recording contains no information about the completion of its attempt.
        return dataset_of_attempts(
            DescribedRun(path, start, plan, path, ()), [Attempt(0, rows, completed=True)], kinds
        )
    if ROBOT_METADATA not in info.metadata:
        raise DataError(
            f"{path} does not describe the robot of its samples",
            hint="convert files of other tools with: hil import FILE --map MAP.yaml -o OUT",
        )
    origin = _origin_of_import(info.metadata[ROBOT_METADATA], str(path))
    rows = _with_torque_target(info, rows)
    numbers = np.unique(rows["segment"]).tolist() if "trajectory" in kinds else []
    steps = _windows(info, [n for n in numbers if n >= 0])
    return assemble(cut(rows, steps, 0), origin, SAMPLES_PER_DWELL)


def _attached(info: RecordingInfo, name: str) -> dict[str, Any]:
    with reading(f"{info.path}: its {name}"):
        try:
            document = json.loads(info.attachments[name].data)
        except RecursionError as error:
            raise ValueError("it is nested too deeply") from error
        return dict(_mapping(document, "it"))


def _with_torque_target(info: RecordingInfo, rows: StructArray) -> StructArray:
    """Return the rows with the field `torque_target` if an import has it for all rows."""
    if TARGET_TOPIC not in info.topics:
        return rows
    target = read_topic(info.path, TARGET_TOPIC, salvage=not info.complete)
    if not np.array_equal(target["device_time"], rows["device_time"]):
        return rows
    fields = [(name, rows.dtype[name]) for name in rows.dtype.names or ()]
    out = np.empty(len(rows), [*fields, (TORQUE_TARGET, target.dtype[TORQUE_TARGET])])
    for name, _ in fields:
        out[name] = rows[name]
    out[TORQUE_TARGET] = target[TORQUE_TARGET]
    return out


def _windows(info: RecordingInfo, numbers: Sequence[int]) -> dict[int, StepNote]:
    """Return the trajectories of an imported file.

    Each distinct payload of the windows of an imported file gets a number.
    """
    declared = _imported_payload(info, PAYLOAD_METADATA)
    windows = {n: WINDOW_PAYLOAD.format(n) for n in numbers}
    own = {
        n: _imported_payload(info, name) if name in info.metadata else declared
        for n, name in windows.items()
    }
    loads = list(dict.fromkeys((declared, *own.values())))
    return {
        n: StepNote("trajectory", trajectory=n, load=loads.index(own[n]), payload=own[n])
        for n in numbers
    }


def _imported_payload(info: RecordingInfo, name: str) -> Payload:
    """Return a payload from a metadata record, whose values are JSON texts."""
    record = info.metadata.get(name)
    if not record:
        return Payload()
    with reading(f"{info.path}: its {name}"):
        return payload_of({key: json.loads(value) for key, value in record.items()})


# Documents


def _origin_of_run(start: Mapping[str, Any], source: str) -> Origin:
    """Return the origin of the samples of a run: robot and source.

    Raises `DataError`.
    """
    with reading(f"{source}: the robot in start.json"):
        return _origin(_mapping(start["robot"], "robot"), source)


def _origin_of_import(robot: Mapping[str, str], source: str) -> Origin:
    """Return the origin of the samples of an imported file, whose lists are JSON texts."""
    with reading(f"{source}: its robot description"):
        as_json = ("joint_names", "drive_gains")
        lists = {key: json.loads(robot[key]) for key in as_json if robot.get(key)}
        return _origin({**robot, **lists}, source)


def _origin(robot: Mapping[str, Any], source: str) -> Origin:
    model, names = robot["model"], robot["joint_names"]
    if not isinstance(model, str):
        raise TypeError(f"model is {shown(repr(model))}, not a name")
    if not (isinstance(names, list) and names and all(isinstance(one, str) for one in names)):
        raise TypeError(f"joint_names is {shown(repr(names))}, not a list of names")
    return Origin(
        source=source,
        robot=model,
        joint_names=tuple(names),
        effort_kind=_effort_kind(robot["effort_kind"]),
        drive_gains=_gains(robot.get("drive_gains"), len(names)),
        drive_gains_source=str(robot.get("drive_gains_source") or ""),
    )


def _effort_kind(kind: Any) -> Literal["current", "torque"]:
    if kind == "current":
        return "current"
    if kind == "torque":
        return "torque"
    raise ValueError(f"effort_kind is {shown(repr(kind))}, neither 'current' nor 'torque'")


def _gains(value: Any, n: int) -> FloatArray | None:
    return np.array(_numbers(value, "drive_gains", n)) if value else None


def steps_of_plan(
    plan: Mapping[str, Any],
    where: object,
    unsettled: Collection[int],
    kinds: Collection[SeriesKind],
) -> dict[int, StepNote]:
    """Return the descriptions of the steps of a plan document, by step index.

    Raises:
        DataError: The document is not a plan.
    """
    with reading(f"{where} is not a plan: it"):
        loads = [payload_of(load) for load in plan["loads"]]
        return {
            _index(step, "index"): _note(step, loads, unsettled)
            for step in plan["steps"]
            if _mapping(step, "a step")["kind"] in kinds
        }


def _note(step: Mapping[str, Any], loads: list[Payload], unsettled: Collection[int]) -> StepNote:
    load = _index(step, "load", 0)
    if not 0 <= load < len(loads):
        raise ValueError(f"load {load} does not exist")
    return StepNote(
        kind=step["kind"],
        trajectory=_index(step, "trajectory", -1),
        pose=_index(step, "pose", -1),
        approach=_index(step, "approach", 0),
        load=load,
        payload=loads[load],
        settled=step["index"] not in unsettled,
    )


def dwell_rule_of(plan: Mapping[str, Any], where: object) -> DwellRule:
    """Return the dwell rule of a plan document.

    Raises:
        DataError: The document is not a plan.
    """
    with reading(f"{where} is not a plan: dwell"):
        raw = dict(_mapping(plan.get("dwell", {}), "it"))
        samples = _index(raw, "samples", DwellRule().samples)
        if samples < 1:
            raise ValueError(f"samples is {samples}")
        rest = {key: _number(raw[key], key) for key in raw if key != "samples"}
        return DwellRule(samples=samples, **rest)


def payload_of(raw: Mapping[str, Any]) -> Payload:
    """Return the payload that a document describes.

    Raises `KeyError`, `ValueError` or `TypeError` if the document does not describe a payload.
    """
    raw = _mapping(raw, "the load")
    mass = _number(raw["mass_kg"], "mass_kg")
    if mass < 0:
        raise ValueError(f"mass_kg is {mass:g}, less than 0")
    ixx, iyy, izz, ixy, ixz, iyz = _numbers(raw.get("inertia_kgm2", [0.0] * 6), "inertia_kgm2", 6)
    com = _vector(raw.get("com_m", [0.0] * 3), "com_m")
    return Payload(mass, com, (ixx, iyy, izz, ixy, ixz, iyz))


@contextlib.contextmanager
def reading(where: object) -> Iterator[None]:
    """Convert errors about values of a document into a `DataError` starting with `where`."""
    try:
        yield
    except KeyError as error:
        raise DataError(f"{where} lacks {error}") from error
    except (IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{where} cannot be used: {shown(str(error), 200)}") from error


def _mapping(value: Any, what: str) -> Mapping[str, Any]:
    """Return a JSON object.

    Raises `TypeError` for a value of any other type.
    """
    if not isinstance(value, Mapping):
        raise TypeError(f"{what} is {shown(repr(type(value).__name__))}, not a mapping")
    return value


def _index(values: Mapping[str, Any], key: str, default: int | None = None) -> int:
    """Return an integer that is stored under a key of a document.

    Raises `KeyError` if the key is missing, and `ValueError` if the value is not an integer.
    """
    value = values[key] if default is None else values.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 2**31:
        raise ValueError(f"{key} is {shown(repr(value))}, not an index")
    return value


def _number(value: Any, what: str) -> float:
    """Return a finite number.

    Raises `ValueError` for any other value of the document.
    """
    if isinstance(value, bool | str) or not math.isfinite(number := float(value)):
        raise ValueError(f"{what} is {shown(repr(value))}, not a finite number")
    return number


def _numbers(value: Any, what: str, length: int) -> tuple[float, ...]:
    """Return a list of finite numbers of the expected length.

    Raises `ValueError` for other values or for a list of a different length.
    """
    if not isinstance(value, list | tuple):
        raise ValueError(f"{what} is {shown(repr(value))}, not a list of numbers")
    numbers = tuple(_number(item, what) for item in value)
    if len(numbers) != length:
        raise ValueError(f"{what} has {len(numbers)} values, not {length}")
    return numbers


def _vector(value: Any, what: str) -> tuple[float, float, float]:
    """Return a vector of three finite numbers.

    Raises `ValueError` for any other value of the document.
    """
    x, y, z = _numbers(value, what, 3)
    return x, y, z
