"""Completeness of a run: determination of the plan steps that were measured completely.

Completeness is determined from the recording and not from the event log: a kill loses the newest
samples, including samples of dwells that the log already lists as done. A dwell counts as complete
if its recorded rows satisfy the dwell rule of the plan. A trajectory counts as complete if its
recorded rows reach its end and few samples are missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

import numpy as np

from hil.core import DataError, StructArray
from hil.importers.series import recorded_rows
from hil.planning import DwellRule, Plan, Step
from hil.recording import attempt_of
from hil.robot import Status, n_joints_of


@dataclass(frozen=True)
class Completeness:
    """Measuring steps of a plan, and which of them are complete.

    Attributes:
        done: Indices of the measuring steps that are complete.
        unsettled: Indices of the complete dwells that ended by their time-out.
        expected: Indices of all measuring steps of the plan.
        slowed: Indices of the measuring steps that were never measured at the planned speed.
    """

    done: frozenset[int]
    unsettled: frozenset[int]
    expected: tuple[Step, ...] = field(repr=False)
    slowed: frozenset[int] = frozenset()

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices of the measuring steps that are not complete, in order."""
        return tuple(step.index for step in self.expected if step.index not in self.done)

    def to_dict(self) -> dict[str, dict[str, int]]:
        """Return the number of complete steps and the number of planned steps, per kind of step."""
        total = Counter(step.kind for step in self.expected)
        done = Counter(step.kind for step in self.expected if step.index in self.done)
        return {kind: {"done": done[kind], "of": n} for kind, n in sorted(total.items())}

    def __str__(self) -> str:
        """Return the counts as text, such as `650/650 dwells, 14/14 references`."""
        plural = {"trajectory": "trajectories", "weigh": "weighings"}
        return ", ".join(
            f"{n['done']}/{n['of']} {plural.get(kind, kind + 's')}"
            for kind, n in self.to_dict().items()
        )


def completeness_of(plan: Plan, recordings: Iterable[Path]) -> Completeness:
    """Return the completeness of a run; intact parts of torn recordings are included.

    Args:
        plan: Plan with the measuring steps.
        recordings: Paths of the recordings, as in `RunDirectory.recordings`.

    Raises:
        DataError: A recording is not an MCAP file, or is from a newer version of hil.
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


def _steps_in(files: Iterable[Path]) -> Iterator[tuple[int, StructArray]]:
    """Yield the steps of one attempt with their rows.

    A step can continue in the next part of the recording.
    """
    last: StructArray | None = None
    for file in files:
        rows = recorded_rows(file)
        if rows is None:
            continue
        if last is not None:
            rows = _joined(last, rows, file)
        edges = np.flatnonzero(np.diff(rows["segment"])) + 1
        *whole, last = np.split(rows, edges)
        yield from ((int(piece["segment"][0]), piece) for piece in whole)
    if last is not None and len(last):
        yield int(last["segment"][0]), last


def _joined(before: StructArray, rows: StructArray, file: Path) -> StructArray:
    if before.dtype == rows.dtype:
        return np.concatenate((before, rows))
    raise DataError(
        f"{file} contains {n_joints_of(rows)} joints, but the part before it contains "
        f"{n_joints_of(before)}",
        hint="the files of two runs were mixed: restore the run from a backup",
    )


def recorded_steps(
    recordings: Iterable[Path], wanted: Collection[int]
) -> Iterator[tuple[dict[int, StructArray], set[int]]]:
    """Yield the rows of the requested steps and the indices of all steps, per attempt.

    Args:
        recordings: Paths of the recordings, as in `RunDirectory.recordings`.
        wanted: Indices of the steps whose rows are requested.

    Raises:
        DataError: A recording is not an MCAP file, or is from a newer version of hil.
    """
    for _, files in groupby(recordings, attempt_of):
        rows_of_step: dict[int, StructArray] = {}
        seen: set[int] = set()
        for index, rows in _steps_in(files):
            seen.add(index)
            if index in wanted:
                # A view would retain the whole recording in memory.
                rows_of_step[index] = rows.copy()
        yield rows_of_step, seen


def step_is_complete(step: Step, rows: StructArray, plan: Plan) -> bool:
    """Return whether the rows of one step are complete.

    The rows must belong to one attempt and be in order.
    """
    if step.kind == "trajectory":
        return _trajectory_is_whole(rows, step, plan)
    return dwell_is_over(rows, plan.dwell_rule(step))


def dwell_is_over(rows: StructArray, rule: DwellRule) -> bool:
    """Return whether a dwell has settled or has reached its time-out."""
    elapsed = rows["device_time"][-1] - rows["device_time"][0]
    return dwell_settles(rows, rule) or bool(elapsed >= rule.timeout_s)


def dwell_settles(rows: StructArray, rule: DwellRule) -> bool:
    """Return whether the arm was static for the time that the dwell rule requires."""
    quiet = np.abs(rows["qd"]).max(axis=1) < rule.settle_rad_s
    late = rows["device_time"] - rows["device_time"][0] >= rule.dwell_s
    # Number of consecutive static samples up to and including each sample.
    index = np.arange(1, len(rows) + 1)
    in_a_row = index - np.maximum.accumulate(np.where(quiet, 0, index))
    return bool((in_a_row >= rule.samples)[late].any())


MISSING_AT_MOST = 0.05
"""Maximum share of missing samples of a trajectory that counts as complete."""

AT_END_RAD = 1e-3
"""Maximum distance between the last position of a complete trajectory and its last set-point
[rad]."""


def _trajectory_is_whole(rows: StructArray, step: Step, plan: Plan) -> bool:
    """Return whether a trajectory was followed to its end with nearly all of its samples."""
    assert step.motion is not None
    expected = plan.step_duration_s(step) * plan.rate_hz
    moving = rows[(rows["status"] & int(Status.MOVING)) != 0]
    if len(moving) < (1 - MISSING_AT_MOST) * expected - 1:
        return False
    # A stopped arm is static as well, but at a different position.
    off = np.abs(rows["q_target"][-1] - step.motion.q_end)
    return bool(np.nanmax(off, initial=0.0) < AT_END_RAD)
