"""Datasets from run directories and MCAP files.

The only module of `hil.data`, beside `hil.data.importing`, that reads recordings; `hil.data` itself
never imports it, so that estimators stay clear of the recorder (docs/explanation/architecture.md).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from hil.data.completeness import dwell_is_over
from hil.data.dataset import UPRIGHT, Dataset, SeriesKind
from hil.data.dwells import SAMPLES_PER_DWELL
from hil.data.series import Origin, Series, StepNote, assemble, cut
from hil.errors import DataError
from hil.payload import Payload
from hil.plan.plan import DwellRule
from hil.record.files import read_json
from hil.record.parts import attempt_of
from hil.record.reader import RecordingInfo, read_info, read_topic
from hil.record.rundir import RunDirectory
from hil.record.writer import PARTIAL_SUFFIX
from hil.typing import StructArray

WINDOW_PAYLOAD = "payload of window {}"
"""Metadata record of an imported file: the load of one window, where it has its own."""

MEASURED_KINDS: tuple[SeriesKind, ...] = ("move", "dwell", "trajectory", "reference", "warmup")


def load_source(path: str | Path, kinds: Collection[SeriesKind] | None = None) -> Dataset:
    """The samples of a run directory or of one MCAP file, cut into series with their conditions.

    A run's plan says which step every sample belongs to; a step recorded several times (after a
    stop and a resume) counts once, as it was recorded last. An imported file is one trajectory,
    or one per window of its map. Rows that the robot marked as unusable are left out, repeated
    time stamps too, and a pause in the time stamps cuts a series in two.

    Args:
        path: Run directory or MCAP file.
        kinds: Only series of these kinds; all that measured something by default. Leaving out the
            moves of a long dwell program saves most of the time.

    Raises:
        DataError: The source is missing, damaged, from a newer hil, or does not say whose samples
            it holds; or it holds none.
    """
    source, wanted = Path(path), MEASURED_KINDS if kinds is None else tuple(kinds)
    if source.is_dir():
        return replace(_from_run(source, wanted), gravity=gravity_of(source))
    if not source.exists():
        raise DataError(
            f"{source} does not exist", hint="give a run directory or an MCAP file (hil runs)"
        )
    return replace(_from_file(source, wanted), gravity=gravity_of(source))


def gravity_of(source: Path) -> tuple[float, float, float]:
    """Gravity in the base frame [m/s²] of a source; upright unless it says."""
    given = _robot_of(source).get("gravity_m_s2", UPRIGHT)
    try:
        x, y, z = (float(value) for value in given)
    except (TypeError, ValueError):
        raise DataError(f"{source}: robot.gravity_m_s2 is {given!r}, not a vector") from None
    return x, y, z


def serial_of(path: str | Path) -> str:
    """Serial number of the robot a source was recorded on; empty when nobody said.

    Raises:
        DataError: The source is missing, damaged or from a newer hil.
    """
    robot = _robot_of(Path(path))
    identity = robot.get("identity", {})
    return str(robot.get("serial") or identity.get("serial") or "")


def _robot_of(source: Path) -> Mapping[str, Any]:
    """What a run, its recording or an imported file says about the robot."""
    if source.is_dir():
        start: Mapping[str, Any] = RunDirectory.open(source).start
        return start.get("robot") or {}
    info = read_info(source)
    if "start.json" in info.attachments:
        return _attached(info, "start.json").get("robot") or {}
    return info.metadata.get("robot", {})


def _from_run(path: Path, kinds: Collection[SeriesKind]) -> Dataset:
    run = RunDirectory.open(path)
    start, plan = run.start, read_json(path / "plan.json")
    steps = _steps(plan, path / "plan.json", _unsettled(run), kinds)
    origin = _origin_of_run(start, str(path))
    if not run.recordings:
        raise DataError(f"{path} holds no recording")
    found: dict[int, list[Series]] = {}
    for attempt, files in groupby(run.recordings, attempt_of):
        parts = [read_topic(f, salvage=f.name.endswith(PARTIAL_SUFFIX)) for f in files]
        rows = np.concatenate(parts)
        pieces = cut(rows, steps, attempt)
        if (run.stop_of(attempt) or {}).get("outcome") != "completed":
            pieces = _without_torn_dwell(pieces, rows, plan.get("dwell", {}))
        # A later attempt replaces what an earlier one recorded of the same step.
        found |= {piece.step: [] for piece in pieces}
        for piece in pieces:
            found[piece.step].append(piece)
    ordered = [piece for step in sorted(found) for piece in found[step]]
    return assemble(ordered, origin, _dwell_samples(plan))


def _unsettled(run: RunDirectory) -> set[int]:
    """Dwells that ran into their time-out, of every attempt: the log outlives what was killed."""
    events = (event for event in run.events() if event.get("kind") == "dwell")
    logged = {int(event.get("step", -1)): event.get("settled") for event in events}
    told = (run.stop or {}).get("unsettled", ())
    return {step for step, settled in logged.items() if settled is False} | set(told)


def _without_torn_dwell(
    pieces: list[Series], rows: StructArray, rule: Mapping[str, Any]
) -> list[Series]:
    """Without the dwell that a stop or a kill cut short: it may not have come to rest at all."""
    last = int(rows["segment"][-1]) if len(rows) else -1
    return [
        piece
        for piece in pieces
        if piece.step != last
        or piece.note.kind not in ("dwell", "reference")
        or dwell_is_over(piece.rows, DwellRule(**rule))
    ]


def _from_file(path: Path, kinds: Collection[SeriesKind]) -> Dataset:
    info = read_info(path)
    rows = read_topic(path, salvage=not info.complete)
    if "plan.json" in info.attachments and "start.json" in info.attachments:
        start, plan = (_attached(info, name) for name in ("start.json", "plan.json"))
        pieces = cut(rows, _steps(plan, path, (), kinds), 0)
        return assemble(pieces, _origin_of_run(start, str(path)), _dwell_samples(plan))
    if "robot" not in info.metadata:
        raise DataError(
            f"{path} does not say which robot its samples are of",
            hint="turn foreign files into recordings with: hil import FILE --map MAP.yaml -o OUT",
        )
    numbers = np.unique(rows["segment"]).tolist() if "trajectory" in kinds else []
    steps = _windows(info, [n for n in numbers if n >= 0])
    return assemble(cut(rows, steps, 0), _origin_of_import(info), SAMPLES_PER_DWELL)


def _windows(info: RecordingInfo, numbers: Sequence[int]) -> dict[int, StepNote]:
    """The trajectories of an import; windows with a load of their own count as other loads."""
    declared = _imported_payload(info.metadata.get("payload", {}))
    windows = {n: info.metadata.get(WINDOW_PAYLOAD.format(n)) for n in numbers}
    own = {n: _imported_payload(raw) if raw else declared for n, raw in windows.items()}
    loads = list(dict.fromkeys((declared, *own.values())))
    return {
        n: StepNote("trajectory", trajectory=n, load=loads.index(own[n]), payload=own[n])
        for n in numbers
    }


def _steps(
    plan: Mapping[str, Any], where: Path, unsettled: Any, kinds: Collection[SeriesKind]
) -> dict[int, StepNote]:
    """What each step of a plan measured, by its index."""
    try:
        loads = [_load(load) for load in plan["loads"]]
        return {
            int(step["index"]): StepNote(
                kind=step["kind"],
                trajectory=int(step.get("trajectory", -1)),
                pose=int(step.get("pose", -1)),
                approach=int(step.get("approach", 0)),
                load=int(step.get("load", 0)),
                payload=loads[int(step.get("load", 0))],
                settled=step["index"] not in unsettled,
            )
            for step in plan["steps"]
            if step["kind"] in kinds
        }
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DataError(f"{where} is no plan: {type(error).__name__} {error}") from error


def _load(raw: Mapping[str, Any]) -> Payload:
    return Payload(
        float(raw["mass_kg"]),
        tuple(raw.get("com_m", (0.0,) * 3)),
        tuple(raw.get("inertia_kgm2", (0.0,) * 6)),
    )


def _dwell_samples(plan: Mapping[str, Any]) -> int:
    return int(plan.get("dwell", {}).get("samples", SAMPLES_PER_DWELL))


def _origin_of_run(start: Mapping[str, Any], source: str) -> Origin:
    try:
        robot = start["robot"]
        gains = robot.get("drive_gains") or ()
        return Origin(
            source=source,
            robot=robot["model"],
            joint_names=tuple(robot["joint_names"]),
            effort_kind=robot["effort_kind"],
            drive_gains=np.array(gains, dtype=np.float64) if len(gains) else None,
            drive_gains_source=robot.get("drive_gains_source", ""),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{source}: the start document lacks the robot's {error}") from error


def _origin_of_import(info: RecordingInfo) -> Origin:
    robot = info.metadata["robot"]
    try:
        gains = robot.get("drive_gains", "")
        return Origin(
            source=str(info.path),
            robot=robot["model"],
            joint_names=tuple(json.loads(robot["joint_names"])),
            effort_kind="current" if robot["effort_kind"] == "current" else "torque",
            drive_gains=np.array(json.loads(gains), dtype=np.float64) if gains else None,
            drive_gains_source=robot.get("drive_gains_source", ""),
        )
    except (KeyError, ValueError) as error:
        raise DataError(f"{info.path}: its description of the robot lacks {error}") from error


def _imported_payload(metadata: Mapping[str, str]) -> Payload:
    if not metadata:
        return Payload()
    return _load({key: json.loads(value) for key, value in metadata.items()})


def _attached(info: RecordingInfo, name: str) -> dict[str, Any]:
    try:
        document: dict[str, Any] = json.loads(info.attachments[name].data)
    except ValueError as error:
        raise DataError(f"{info.path}: its {name} is not valid JSON: {error}") from error
    return document


def with_payload(dataset: Dataset, payload: Payload) -> Dataset:
    """The same samples, declared to be recorded with another load."""
    conditions = tuple(replace(c, payload=payload) for c in dataset.conditions)
    return replace(dataset, conditions=conditions)
