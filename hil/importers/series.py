"""Series of a recording: rows grouped by plan step and divided at pauses and unusable rows.

The function `recorded_rows` reads the rows of one file of a run, `cut` divides the rows of an
attempt into series, and `assemble` combines the series of all attempts into a dataset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, DataError, FloatArray, IntArray, StructArray
from hil.data import (
    ARRIVAL_POINTS,
    AT_REST,
    Conditions,
    Dataset,
    SeriesKind,
    Track,
    arrival,
    is_pause,
)
from hil.recording import PARTIAL_SUFFIX, read_topic
from hil.robot import STATE_TOPIC, Status, state_dtype

SHORTEST_PIECE = 20
"""Minimum number of rows of a piece of a divided trajectory; shorter pieces cannot be filtered."""


@dataclass(frozen=True, slots=True)
class StepNote:
    """Description of one step of a plan, or of one window of an imported file; see `Conditions`."""

    kind: SeriesKind
    trajectory: int = -1
    pose: int = -1
    approach: int = 0
    load: int = 0
    payload: Payload = field(default_factory=Payload)
    settled: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Rows of one step that are not interrupted by a pause.

    Attributes:
        step: Index of the step in the plan.
        piece: Number of the piece of a step that pauses divide; 0 for an undivided step.
        attempt: Number of the attempt.
        note: Description of the step as text.
        rows: Recorded rows.
        track: Motion of the arm during the whole attempt.
    """

    step: int
    piece: int
    attempt: int
    note: StepNote
    rows: StructArray
    track: Track


@dataclass(frozen=True, slots=True, eq=False)
class Origin:
    """Robot that was measured and source of the samples; see `Dataset`."""

    source: str
    robot: str
    joint_names: tuple[str, ...]
    effort_kind: Literal["current", "torque"]
    drive_gains: FloatArray | None
    drive_gains_source: str


# Rows of a recording


def recorded_rows(file: Path) -> StructArray | None:
    """Return the base robot record in a recording of a run.

    The function returns None if the recording was torn before its first row.

    Raises:
        DataError: A finished recording cannot be read, is from a newer version of hil, or contains
            a different record.
    """
    try:
        rows = read_topic(file, salvage=True)
    except DataError:
        # A part that was torn before its first complete chunk has no rows, which is not an error.
        if file.name.endswith(PARTIAL_SUFFIX):
            return None
        raise
    return base_record(file, rows)


def base_record(file: Path, rows: StructArray) -> StructArray:
    """Return the rows after checking that they are the base robot record.

    A topic of a different tool can have the name of the base robot record.

    Raises:
        DataError: The rows belong to a different record.
    """
    names = rows.dtype.names or ()
    n = rows.dtype["q"].shape[0] if "q" in names and rows.dtype["q"].shape else 0
    if rows.dtype == state_dtype(n):
        return rows
    raise DataError(
        f"{file}: its {STATE_TOPIC} is not the base robot record",
        hint="convert recordings of other tools with: hil import FILE --map MAP.yaml -o OUT",
    )


# From rows to series


def cut(rows: StructArray, steps: Mapping[int, StepNote], attempt: int) -> list[Series]:
    """Return the series in a recording, in order; a repeated step has only its last visit.

    Args:
        rows: All rows of the recording; two visits of a step are separated by the rows between
            them.
        steps: Descriptions of the steps whose series are returned, by step index.
        attempt: Number of the attempt that was recorded.
    """
    unusable = int(Status.MASKED | Status.SLOWED)
    usable = np.flatnonzero((rows["status"] & unusable) == 0)
    usable = usable[_advancing(rows["device_time"][usable])]
    if not len(usable):
        return []
    track = Track(*(rows[name][usable] for name in ("device_time", "q", "qd")))
    segment = rows["segment"][usable]
    pause = is_pause(np.diff(rows["device_time"][usable]))
    breaks = np.flatnonzero((np.diff(segment) != 0) | pause) + 1
    edges = np.concatenate(([0], breaks, [len(usable)]))
    last: dict[int, list[IntArray]] = {}
    previous = None
    for (start, stop), step in zip(pairwise(edges), segment[edges[:-1]].tolist(), strict=True):
        # After a pause within a step its rows continue; a later visit of the step replaces them.
        if step != previous:
            last[step] = []
        last[step].append(usable[start:stop])
        previous = step
    return [
        Series(step, i, attempt, steps[step], rows[piece], track)
        for step, pieces in last.items()
        if step in steps
        for i, piece in enumerate(_worth_keeping(pieces))
    ]


def _advancing(t: FloatArray) -> BoolArray:
    """Return a mask of rows whose time is known and later than the time of all previous rows."""
    before = np.concatenate(([-np.inf], np.fmax.accumulate(t)[:-1])) if len(t) else t
    later: BoolArray = t > before
    return later


def _worth_keeping(pieces: list[IntArray]) -> list[IntArray]:
    if len(pieces) == 1:
        return pieces
    return [piece for piece in pieces if len(piece) >= SHORTEST_PIECE] or pieces[-1:]


# From series to a dataset


COLUMNS = (
    "q", "qd", "effort", "temperature", "q_target", "qd_target", "qdd_target", "effort_target",
)  # fmt: skip

TORQUE_TARGET = "torque_target"
"""Name of the column with the torque set-points of the controller [N·m], in imports with current
set-points."""


def assemble(series: Sequence[Series], origin: Origin, dwell_samples: int) -> Dataset:
    """Return the dataset that contains all series of a list.

    Args:
        series: Series in the order in which the dataset contains them.
        origin: Robot that was measured and source of the samples.
        dwell_samples: Number of rows at the end of each dwell or reference that are used.

    Raises:
        DataError: No sample is usable, or the number of joints differs from the description.
    """
    kept = [one.rows[-dwell_samples:] if one.note.kind in AT_REST else one.rows for one in series]
    if not sum(len(rows) for rows in kept):
        raise DataError(
            f"{origin.source} contains no usable samples",
            hint="check whether the run was stopped before its first measurement",
        )
    rows = np.concatenate(kept)
    recorded = rows.dtype["q"].shape[0]
    if recorded != len(origin.joint_names):
        raise DataError(
            f"{origin.source} has {recorded} joints, but describes {len(origin.joint_names)}"
        )
    known = COLUMNS + ((TORQUE_TARGET,) if TORQUE_TARGET in (rows.dtype.names or ()) else ())
    columns = {name: np.ascontiguousarray(rows[name]) for name in known}
    present = {name: values for name, values in columns.items() if not np.all(np.isnan(values))}
    for needed in ("q", "effort"):
        present.setdefault(needed, columns[needed])
    return Dataset(
        robot=origin.robot,
        joint_names=origin.joint_names,
        effort_kind=origin.effort_kind,
        columns={"t": np.ascontiguousarray(rows["device_time"]), **present},
        offsets=np.concatenate(([0], np.cumsum([len(r) for r in kept]))).astype(np.int64),
        conditions=tuple(_conditions(one, origin.source) for one in series),
        drive_gains=origin.drive_gains,
        drive_gains_source=origin.drive_gains_source,
        arrivals=_arrivals(series, kept),
    )


def _conditions(series: Series, source: str) -> Conditions:
    note = series.note
    piece = f"/{series.piece}" if series.piece else ""
    return Conditions(
        id=f"{Path(source).name}:{note.kind}{series.step}{piece}",
        kind=note.kind,
        source=source,
        trajectory=note.trajectory,
        pose=note.pose,
        approach=note.approach,
        load=note.load,
        payload=note.payload,
        attempt=series.attempt,
        settled=note.settled,
    )


def _arrivals(series: Sequence[Series], kept: Sequence[StructArray]) -> FloatArray | None:
    """Return the motion of the arm before each dwell (S, K, 2, n); None without dwells."""
    if not any(one.note.kind in AT_REST for one in series):
        return None
    n = kept[0].dtype["q"].shape[0]
    out = np.full((len(series), ARRIVAL_POINTS, 2, n), np.nan)
    for i, (one, rows) in enumerate(zip(series, kept, strict=True)):
        if one.note.kind in AT_REST and len(rows):
            first, last = rows["device_time"][[0, -1]].tolist()
            out[i] = arrival(one.track, first, last)
    return out
