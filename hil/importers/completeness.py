"""Which steps of a plan were measured to their end? Judged by the recording, not by what was said.

A kill loses the newest samples, and with them dwells that the event log calls done; a resumed run
therefore asks the data. A dwell is complete when its rows alone satisfy the plan's rule, a
trajectory when its rows reach its end and as good as none are missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np

from hil.core import BoolArray, DataError, FloatArray, StructArray
from hil.planning import DwellRule, Plan, Step
from hil.recording import PARTIAL_SUFFIX, attempt_of, read_topic
from hil.robot import STATE_TOPIC, Status, n_joints_of, state_dtype

MISSING_AT_MOST = 0.05
"""Share of a trajectory's samples; one that lacks more has to be measured again."""

AT_END_RAD = 1e-3
"""So near to its last set-point a trajectory has been followed to its end."""


@dataclass(frozen=True)
class Completeness:
    """What of a plan was measured.

    Attributes:
        done: Measuring steps that are complete.
        unsettled: Dwells among them that ran into their time-out.
        expected: Measuring steps of the plan.
        slowed: Measuring steps that lack a measurement at the planned speed.
    """

    done: frozenset[int]
    unsettled: frozenset[int]
    expected: tuple[Step, ...] = field(repr=False)
    slowed: frozenset[int] = frozenset()

    @property
    def missing(self) -> tuple[int, ...]:
        """Measuring steps that are not complete, in order."""
        return tuple(step.index for step in self.expected if step.index not in self.done)

    def to_dict(self) -> dict[str, dict[str, int]]:
        """Per kind of step, how many are done of how many."""
        total = Counter(step.kind for step in self.expected)
        done = Counter(step.kind for step in self.expected if step.index in self.done)
        return {kind: {"done": done[kind], "of": n} for kind, n in sorted(total.items())}

    def __str__(self) -> str:
        """`650/650 dwells, 14/14 references`."""
        plural = {"trajectory": "trajectories", "weigh": "weighings"}
        return ", ".join(
            f"{n['done']}/{n['of']} {plural.get(kind, kind + 's')}"
            for kind, n in self.to_dict().items()
        )


def completeness_of(plan: Plan, recordings: Iterable[Path]) -> Completeness:
    """Judge recordings of a run; torn and damaged ones are read as far as they are whole.

    Args:
        plan: What was to be measured.
        recordings: `RunDirectory.recordings`.

    Raises:
        DataError: A recording is no MCAP file at all, or of a newer hil.
    """
    expected = {step.index: step for step in plan if step.measures}
    done: set[int] = set()
    unsettled: set[int] = set()
    slowed: set[int] = set()
    for _, files in groupby(recordings, attempt_of):
        for index, rows in _steps_in(files):
            step = expected.get(index)
            if step is None:
                continue
            if (rows["status"] & int(Status.SLOWED)).any():
                slowed.add(index)
                continue
            if not step_is_complete(step, rows, plan):
                continue
            done.add(index)
            unsettled.discard(index)
            if step.kind != "trajectory" and not dwell_settles(rows, plan.dwell_rule(step)):
                unsettled.add(index)
    return Completeness(
        frozenset(done), frozenset(unsettled), tuple(expected.values()), frozenset(slowed - done)
    )


def recorded_steps(
    recordings: Iterable[Path], wanted: Collection[int]
) -> Iterator[tuple[dict[int, StructArray], set[int]]]:
    """Per attempt, in order: the rows of the steps wanted, and every step that has any rows.

    Args:
        recordings: `RunDirectory.recordings`.
        wanted: Indices of steps.

    Raises:
        DataError: A recording is no MCAP file at all, or of a newer hil.
    """
    for _, files in groupby(recordings, attempt_of):
        found: dict[int, StructArray] = {}
        seen: set[int] = set()
        for index, rows in _steps_in(files):
            seen.add(index)
            if index in wanted:
                found[index] = rows.copy()  # a view would keep the whole recording in memory
        yield found, seen


def step_is_complete(step: Step, rows: StructArray, plan: Plan) -> bool:
    """Whether the rows of one step, of one attempt and in order, are all that it needs."""
    if step.kind == "trajectory":
        return _trajectory_is_whole(rows, step, plan)
    return dwell_is_over(rows, plan.dwell_rule(step))


def dwell_is_over(rows: StructArray, rule: DwellRule) -> bool:
    """Whether a dwell has settled, or taken as long as it may."""
    elapsed = rows["device_time"][-1] - rows["device_time"][0]
    return dwell_settles(rows, rule) or bool(elapsed >= rule.timeout_s)


def dwell_settles(rows: StructArray, rule: DwellRule) -> bool:
    """Whether the arm was at rest for long enough at some moment; the engine's own rule."""
    quiet = np.abs(rows["qd"]).max(axis=1) < rule.settle_rad_s
    late = rows["device_time"] - rows["device_time"][0] >= rule.dwell_s
    return bool((_run_lengths(quiet) >= rule.samples)[late].any())


def _run_lengths(true: BoolArray) -> FloatArray:
    """(N,) how many values in a row, up to and with each one, are true."""
    index = np.arange(1, len(true) + 1)
    last_false = np.maximum.accumulate(np.where(true, 0, index))
    return np.asarray(index - last_false, dtype=np.float64)


def _trajectory_is_whole(rows: StructArray, step: Step, plan: Plan) -> bool:
    """Whether it was followed to its end, with as good as all of its samples."""
    assert step.motion is not None
    expected = plan.step_duration_s(step) * plan.rate_hz
    moving = rows[(rows["status"] & int(Status.MOVING)) != 0]
    if len(moving) < (1 - MISSING_AT_MOST) * expected - 1:
        return False
    # An arm that was stopped also came to rest, but somewhere else.
    off = np.abs(rows["q_target"][-1] - step.motion.q_end)
    return bool(np.nanmax(off, initial=0.0) < AT_END_RAD)


def _steps_in(files: Iterable[Path]) -> Iterator[tuple[int, StructArray]]:
    """(step, its rows) of one attempt, in order; a step may go on in the next part."""
    held: StructArray | None = None
    for file in files:
        rows = rows_of(file)
        if rows is None:
            continue
        if held is not None:
            rows = _joined(held, rows, file)
        edges = np.flatnonzero(np.diff(rows["segment"])) + 1
        *whole, held = np.split(rows, edges)
        yield from ((int(piece["segment"][0]), piece) for piece in whole)
    if held is not None and len(held):
        yield int(held["segment"][0]), held


def _joined(before: StructArray, rows: StructArray, file: Path) -> StructArray:
    if before.dtype == rows.dtype:
        return np.concatenate((before, rows))
    raise DataError(
        f"{file} is of an arm with {n_joints_of(rows)} joints, the part before it of one with "
        f"{n_joints_of(before)}",
        hint="the files of two runs were mixed: take the run from a copy",
    )


def rows_of(file: Path) -> StructArray | None:
    """The base robot record of a run's recording; None for one that was torn before any.

    Raises:
        DataError: A finished recording cannot be read, or is of a newer hil; it holds another
            record.
    """
    try:
        rows = read_topic(file, salvage=True)
    except DataError:
        # A part that was torn before its first whole chunk has no rows and is no reason to stop.
        if file.name.endswith(PARTIAL_SUFFIX):
            return None
        raise
    return base_record(file, rows)


def base_record(file: Path, rows: StructArray) -> StructArray:
    """The rows, if they are the base robot record: another tool's topic may have the same name.

    Raises:
        DataError: They are not.
    """
    names = rows.dtype.names or ()
    n = rows.dtype["q"].shape[0] if "q" in names and rows.dtype["q"].shape else 0
    if rows.dtype == state_dtype(n):
        return rows
    raise DataError(
        f"{file}: its {STATE_TOPIC} is not the base robot record",
        hint="turn recordings of other tools into ours: hil import FILE --map MAP.yaml -o OUT",
    )
