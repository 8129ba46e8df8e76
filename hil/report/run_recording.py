"""The samples of a run: all attempts on one time axis, and what is computed from their rows.

`read_recording` reads every attempt once, torn files as far as they go. Drift at the reference
pose is computed from these rows (`drift_of`), and `dataset_of` makes a dataset of the same rows.
Reading them again by `hil.importers.load_source` would take longer than the rest of the report.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from hil.core import DataError, FloatArray, IntArray, StructArray
from hil.data import Dataset, SeriesKind
from hil.importers import Attempt, DescribedRun, dataset_of_attempts
from hil.recording import (
    PARTIAL_SUFFIX,
    Counts,
    RunDirectory,
    attempt_of,
    name_of_attempt,
    read_topic,
)
from hil.report.documents import as_index, document
from hil.report.run_facts import RunFacts


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """All samples of a run, attempts behind each other.

    Attributes:
        attempts: Records of `state_dtype(n)`, one array per attempt that has any.
        numbers: Number of each of these attempts.
        rows: All of them in one array.
        t: (N,) seconds since the first sample of the run.
        counts: Samples, gaps, missing, duplicates and overruns, all attempts together.
        rate_hz: Nominal rate; NaN when the run does not say.
    """

    attempts: tuple[StructArray, ...]
    numbers: tuple[int, ...]
    rows: StructArray
    t: FloatArray
    counts: Counts
    rate_hz: float

    @property
    def attempt_starts(self) -> tuple[int, ...]:
        """First row of each attempt after the first."""
        ends = np.cumsum([len(rows) for rows in self.attempts])
        return tuple(int(end) for end in ends[:-1])

    @property
    def recorded_s(self) -> float:
        """Device time from the first to the last sample of every attempt, added up [s]."""
        times = (
            self.t[first:last] for first, last in pairwise((0, *self.attempt_starts, len(self.t)))
        )
        return float(sum(t[-1] - t[0] for t in times))

    @property
    def measured_rate_hz(self) -> float:
        """Samples per second where the recording has no gap; NaN when it is too short."""
        steps = np.diff(self.t)
        steps = steps[(steps > 0) & (steps < 1.5 * np.median(steps))] if len(steps) else steps
        return float(1.0 / steps.mean()) if len(steps) else float("nan")

    @property
    def gaps_percent(self) -> float:
        """Missing samples as a share of those there should be [%]."""
        expected = self.counts.samples + self.counts.missing
        return 100.0 * self.counts.missing / expected if expected else float("nan")

    def tracking_error(self) -> FloatArray:
        """(N, n) position q minus commanded position q_target [rad]; NaN without a command.

        The sign is the opposite of the usual e = q_d − q of control.
        """
        error: FloatArray = self.rows["q"] - self.rows["q_target"]
        return error


def read_recording(facts: RunFacts, problems: list[str]) -> Recording | None:
    """Return the samples of a run; None if nothing is left.

    Torn files are read as far as they go; they and unreadable ones are added to `problems`.
    """
    attempts = dict(_attempts_of(RunDirectory(facts.path).recordings, problems))
    if not attempts:
        return None
    rate_hz, parts = facts.rate_hz, tuple(attempts.values())
    rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
    counts = _count(parts, rate_hz)
    return Recording(parts, tuple(attempts), rows, _times(parts), counts, rate_hz)


def _attempts_of(paths: Sequence[Path], problems: list[str]) -> Iterator[tuple[int, StructArray]]:
    """Yield number and samples of every attempt that has any, the parts of a long one joined."""
    for number, files in groupby(paths, attempt_of):
        parts = [rows for file in files if (rows := _samples_of(file, problems)) is not None]
        if kept := [rows for rows in parts if len(rows)]:
            yield number, kept[0] if len(kept) == 1 else np.concatenate(kept)


def _samples_of(path: Path, problems: list[str]) -> StructArray | None:
    if path.name.endswith(PARTIAL_SUFFIX):
        problems.append(
            f"{path.name} was never finished: it is read as far as it was written to the disk"
        )
    try:
        return read_topic(path, salvage=True)
    except DataError as error:
        problems.append(error.message)
        return None


def _times(blocks: Sequence[StructArray]) -> FloatArray:
    """Device times on one axis; an attempt whose clock started afresh follows the one before."""
    out: list[FloatArray] = []
    end = 0.0
    shift = -float(blocks[0]["device_time"][0])
    for block in blocks:
        times: FloatArray = block["device_time"] + shift
        if times[0] < end:
            shift += end - float(times[0])
            times = block["device_time"] + shift
        out.append(times)
        end = float(times[-1])
    return np.concatenate(out)


def _count(blocks: Sequence[StructArray], rate_hz: float) -> Counts:
    """Counts of each attempt added up: the pause between two of them is no gap."""
    parts = [Counts().after(block, rate_hz) for block in blocks]
    names = ("samples", "gaps", "missing", "duplicates", "overruns")
    total = {name: sum(getattr(part, name) for part in parts) for name in names}
    last = parts[-1]
    return Counts(
        **total,
        first_time=parts[0].first_time,
        last_time=last.last_time,
        last_host_time=last.last_host_time,
    )


def intervals(segment: IntArray, steps: IntArray) -> list[tuple[int, int]]:
    """Row ranges in which `segment` stays at one of `steps`."""
    edges = np.flatnonzero(np.diff(segment)) + 1
    starts = np.concatenate(([0], edges))
    stops = np.concatenate((edges, [len(segment)]))
    selected = np.isin(segment[starts], steps)
    return [(int(a), int(b)) for a, b in zip(starts[selected], stops[selected], strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceDrift:
    """The effort at the reference pose, visit by visit.

    Attributes:
        t: (V,) time of each visit [s].
        change: (V, n) mean effort minus that of the first visit under the same load and from
            the same side: friction at standstill has the sign of the approach.
        approach: (V,) +1 from below, −1 from above, 0 otherwise.
    """

    t: FloatArray
    change: FloatArray
    approach: IntArray


REFERENCE_S = 0.08
"""Time of a visit that is averaged [s]: its end, when the arm has settled."""


def drift_of(facts: RunFacts, recording: Recording) -> ReferenceDrift | None:
    """How the effort at the reference pose changed; None unless a visit was repeated."""
    visits = np.array(facts.indices("reference"), dtype=np.int64)
    segment = recording.rows["segment"].astype(np.int64)
    stays = intervals(segment, visits)
    steps = [facts.steps[int(segment[first])] for first, _ in stays]
    kinds = [(as_index(step.get("load"), 0), as_index(step.get("approach"), 0)) for step in steps]
    if len(set(kinds)) == len(kinds):
        return None
    rate_hz = recording.rate_hz if recording.rate_hz > 0 else recording.measured_rate_hz
    averaged = max(1, round(REFERENCE_S * rate_hz)) if np.isfinite(rate_hz) else 1
    effort = np.array(
        [
            recording.rows["effort"][max(first, last - averaged) : last].mean(axis=0)
            for first, last in stays
        ]
    )
    first = np.array([kinds.index(kind) for kind in kinds])
    return ReferenceDrift(
        t=np.array([recording.t[last - 1] for _, last in stays]),
        change=effort - effort[first],
        approach=np.array([approach for _, approach in kinds]),
    )


JUDGED_KINDS: tuple[SeriesKind, ...] = ("dwell", "trajectory")


def dataset_of(facts: RunFacts, recording: Recording) -> Dataset:
    """Return the dwells and trajectories of a run.

    Raises:
        DataError: There are none, or the run does not describe its robot.
    """
    robot = facts.robot
    if not robot.get("model") or not facts.joint_names:
        raise DataError(
            f"{facts.path / 'start.json'} does not describe the robot",
            hint="the run directory is damaged or was edited: take it from a copy",
        )
    effort_kind = "torque" if robot.get("effort_kind") == "torque" else "current"
    described = {"joint_names": list(facts.joint_names), "effort_kind": effort_kind}
    run = DescribedRun(
        source=facts.path,
        start={"robot": {**robot, **described}},
        plan=facts.plan,
        plan_file=facts.path / "plan.json",
        unsettled=facts.unsettled_steps,
    )
    attempts = [
        Attempt(number, rows, _is_completed(facts.path, number))
        for number, rows in zip(recording.numbers, recording.attempts, strict=True)
    ]
    return dataset_of_attempts(run, attempts, JUDGED_KINDS)


def _is_completed(path: Path, attempt: int) -> bool:
    stop = document(path / name_of_attempt("stop.json", attempt), [])
    return stop.get("outcome") == "completed"
