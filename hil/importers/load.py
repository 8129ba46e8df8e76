"""Datasets from run directories and MCAP files.

`hil.data` never imports it, so that estimators stay clear of the recorder
(docs/explanation/architecture.md).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hil.arms import Payload, require_same_arm
from hil.core import AnyPath, DataError, StructArray, read_json, sources_of
from hil.data import SAMPLES_PER_DWELL, UPRIGHT, Dataset, SeriesKind
from hil.importers.completeness import base_record, dwell_is_over, rows_of
from hil.importers.described import (
    dwell_rule_of,
    mapping,
    origin_of_import,
    origin_of_run,
    payload_of,
    payload_of_import,
    reading,
    robot_of_run,
    steps_of_plan,
    vector,
)
from hil.importers.passive_plan import PASSIVE_PLAN_FILE, DetectedSteps, passive_plan_document
from hil.importers.series import TARGET, Series, StepNote, assemble, cut
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

WINDOW_PAYLOAD = "payload of window {}"
"""Metadata record of an imported file: the load of one window, where it has its own."""

MEASURED_KINDS: tuple[SeriesKind, ...] = ("move", "dwell", "trajectory", "reference", "warmup")


def load_source(
    path: str | Path, kinds: Collection[SeriesKind] | None = None, *, any_arm: bool = False
) -> Dataset:
    """The samples of a run directory or of one MCAP file, cut into series with their conditions.

    A run's plan says which step every sample belongs to; a step recorded several times (after a
    stop and a resume) counts once, as it was recorded last. An imported file is one trajectory,
    or one per window of its map. Rows that the robot marked as unusable and those at another speed
    than planned are left out, repeated time stamps too, and a pause in the time stamps cuts a
    series in two.

    Args:
        path: Run directory or MCAP file.
        kinds: Only series of these kinds; all that measured something by default. Leaving out the
            moves of a long dwell program saves most of the time.
        any_arm: Take it as well when its arm's file says something else by now: whoever says so
            names an arm, or needs none.

    Raises:
        DataError: The source is missing, damaged, from a newer hil, or does not say whose samples
            it holds; or it holds none; or its arm's description was changed.
    """
    source, wanted = Path(path), MEASURED_KINDS if kinds is None else tuple(kinds)
    if not source.exists():
        raise DataError(
            f"{source} does not exist", hint="give a run directory or an MCAP file (hil runs)"
        )
    if not any_arm:
        require_arm_as_recorded(source, gone=True)
    found = _from_run(source, wanted) if source.is_dir() else _from_file(source, wanted)
    return replace(found, gravity=gravity_of(source))


def dataset(*sources: AnyPath | Iterable[AnyPath]) -> Dataset:
    """The samples of run directories or MCAP files, with their conditions.

    Args:
        sources: One or more, or lists of them, of one robot and one kind of effort.

    Returns:
        Columns of N rows by name: `t` (N,) [s]; `q` (N, n) [rad], `qd` (N, n) [rad/s], `effort`
        (N, n) [A or N·m] and what else was recorded.

    Raises:
        DataError: None was given, one cannot be read, or they are of different robots.
        SpecError: One is no path.
    """
    return Dataset.concatenate([load_source(source) for source in sources_of(*sources)])


def gravity_of(source: Path) -> tuple[float, float, float]:
    """Gravity in the base frame [m/s²] of a source; upright unless it says.

    Raises:
        DataError: The source is missing, damaged or from a newer hil, or says nonsense.
    """
    with reading(f"{source}: what it says about the robot"):
        return vector(_robot_of(source).get("gravity_m_s2", UPRIGHT), "gravity_m_s2")


def serial_of(path: str | Path) -> str:
    """Serial number of the robot a source was recorded on; empty when nobody said.

    Raises:
        DataError: The source is missing, damaged or from a newer hil.
    """
    robot = _robot_of(Path(path))
    identity = robot.get("identity")
    told = identity.get("serial") if isinstance(identity, Mapping) else None
    return str(robot.get("serial") or told or "")


def require_arm_as_recorded(path: str | Path, *, gone: bool = False) -> None:
    """Refuse a source whose arm of one's own has another description than when it was recorded.

    Args:
        path: Run directory or MCAP file.
        gone: Take it when the description cannot be read here.

    Raises:
        DataError: It has, or the source is missing, damaged or from a newer hil.
    """
    source = Path(path)
    otherwise = "name the arm to fit: --robot FILE (hil fit, hil gains)"
    require_same_arm(_robot_of(source), source, otherwise, gone=gone)


def _robot_of(source: Path) -> Mapping[str, Any]:
    """What a run, its recording or an imported file says about the robot."""
    if source.is_dir():
        return robot_of_run(RunDirectory.open(source).start)
    info = read_info(source)
    if "start.json" in info.attachments:
        return robot_of_run(_attached(info, "start.json"))
    robot: dict[str, Any] = dict(info.metadata.get("robot", {}))
    if "gravity_m_s2" in robot:
        with reading(f"{source}: gravity_m_s2"):
            robot["gravity_m_s2"] = json.loads(robot["gravity_m_s2"])
    return robot


def _from_run(path: Path, kinds: Collection[SeriesKind]) -> Dataset:
    run = RunDirectory.open(path)
    start, (plan, where) = run.start, _plan_of(run)
    steps = steps_of_plan(plan, where, _unsettled(run), kinds)
    origin, rule = origin_of_run(start, str(path)), dwell_rule_of(plan, where)
    if not run.recordings:
        hint = "it was deleted on purpose: see pruned.json" if run.pruned else ""
        raise DataError(f"{path} holds no recording", hint=hint)
    found: dict[int, list[Series]] = {}
    for attempt, files in groupby(run.recordings, attempt_of):
        parts = [rows for file in files if (rows := _part(file)) is not None]
        if not parts:
            continue
        if len({part.dtype for part in parts}) > 1:
            raise DataError(f"{path}: the recordings of attempt {attempt} differ in their joints")
        rows = np.concatenate(parts)
        pieces = cut(rows, steps, attempt)
        if (run.stop_of(attempt) or {}).get("outcome") != "completed":
            pieces = _without_torn_dwell(pieces, rows, rule)
        # A later attempt replaces what an earlier one recorded of the same step.
        found |= {piece.step: [] for piece in pieces}
        for piece in pieces:
            found[piece.step].append(piece)
    ordered = [piece for step in sorted(found) for piece in found[step]]
    return assemble(ordered, origin, rule.samples)


def _plan_of(run: RunDirectory) -> tuple[dict[str, Any], Path]:
    """The plan of a run, or the one detected in a passive recording; and the file it is from.

    The plan of a passive recording that was killed is detected from its rows.
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
        steps = detected.steps()
        return passive_plan_document(steps, name=name, robot=robot, payload=payload), file


def _part(path: Path) -> StructArray | None:
    """The rows of one recording of a run; None for one that was torn before it had any."""
    torn = path.name.endswith(PARTIAL_SUFFIX)
    if torn and rows_of(path) is None:
        return None
    return _rows_of(path, salvage=torn)


def _rows_of(path: Path, *, salvage: bool) -> StructArray:
    return base_record(path, read_topic(path, salvage=salvage))


def _unsettled(run: RunDirectory) -> set[int]:
    """Dwells that ran into their time-out, of every attempt: the log outlives what was killed."""
    events = (event for event in run.events() if event.get("kind") == "dwell")
    logged = {
        step: event.get("settled") for event in events if isinstance(step := event.get("step"), int)
    }
    told = (run.stop or {}).get("unsettled", ())
    stopped = [step for step in told if isinstance(step, int)] if isinstance(told, list) else []
    return {step for step, settled in logged.items() if settled is False} | set(stopped)


def _without_torn_dwell(pieces: list[Series], rows: StructArray, rule: DwellRule) -> list[Series]:
    """Without the dwell that a stop or a kill cut short: it may not have come to rest at all."""
    last = int(rows["segment"][-1]) if len(rows) else -1
    return [
        piece
        for piece in pieces
        if piece.step != last
        or piece.note.kind not in ("dwell", "reference")
        or dwell_is_over(piece.rows, rule)
    ]


def _from_file(path: Path, kinds: Collection[SeriesKind]) -> Dataset:
    info = read_info(path)
    rows = _rows_of(path, salvage=not info.complete)
    if "plan.json" in info.attachments and "start.json" in info.attachments:
        start, plan = (_attached(info, name) for name in ("start.json", "plan.json"))
        pieces = cut(rows, steps_of_plan(plan, path, (), kinds), 0)
        return assemble(pieces, origin_of_run(start, str(path)), dwell_rule_of(plan, path).samples)
    if "robot" not in info.metadata:
        raise DataError(
            f"{path} does not say which robot its samples are of",
            hint="turn foreign files into recordings with: hil import FILE --map MAP.yaml -o OUT",
        )
    origin = origin_of_import(info.metadata["robot"], str(path))
    rows = _with_targets(info, rows)
    numbers = np.unique(rows["segment"]).tolist() if "trajectory" in kinds else []
    steps = _windows(info, [n for n in numbers if n >= 0])
    return assemble(cut(rows, steps, 0), origin, SAMPLES_PER_DWELL)


def _with_targets(info: RecordingInfo, rows: StructArray) -> StructArray:
    """The rows with `torque_target`, where an import found one and all of it is there."""
    if TARGET_TOPIC not in info.topics:
        return rows
    told = read_topic(info.path, TARGET_TOPIC, salvage=not info.complete)
    if not np.array_equal(told["device_time"], rows["device_time"]):
        return rows
    fields = [(name, rows.dtype[name]) for name in rows.dtype.names or ()]
    out = np.empty(len(rows), [*fields, (TARGET, told.dtype[TARGET])])
    for name, _ in fields:
        out[name] = rows[name]
    out[TARGET] = told[TARGET]
    return out


def _windows(info: RecordingInfo, numbers: Sequence[int]) -> dict[int, StepNote]:
    """The trajectories of an import; windows with a load of their own count as other loads."""
    declared = _imported_payload(info, "payload")
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
    return payload_of_import(info.metadata.get(name), f"{info.path}: its {name}")


def _attached(info: RecordingInfo, name: str) -> dict[str, Any]:
    where = f"{info.path}: its {name}"
    with reading(where):
        try:
            document = json.loads(info.attachments[name].data)
        except RecursionError as error:
            raise ValueError("it is nested too deeply") from error
        return dict(mapping(document, "it"))


def with_payload(dataset: Dataset, payload: Payload) -> Dataset:
    """The same samples, declared to be recorded with another load."""
    conditions = tuple(replace(c, payload=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)
