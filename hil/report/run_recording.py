"""Samples of a run: all attempts on one time axis, and values that are computed from the samples.

The function `read_recording` reads every attempt once; a torn file is read up to its damage. The
function `drift_of` computes the drift at the reference pose from the samples, and `dataset_of`
creates a dataset. If `hil.importers.load_source` read the recordings a second time, the reading
would take longer than the rest of the report.
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
    """All samples of a run, with its attempts in order.

    Attributes:
        attempts: Arrays of records of `state_dtype(n)`, one array per non-empty attempt.
        numbers: Attempt numbers of the arrays in `attempts`.
        rows: Records of all attempts joined in one array.
        t: (N,) time since the first sample of the run [s].
        counts: Numbers of samples, gaps, missing samples, duplicates and overruns, summed over all
            attempts.
        rate_hz: Nominal sample rate [Hz]; NaN if unknown.
    """

    attempts: tuple[StructArray, ...]
    numbers: tuple[int, ...]
    rows: StructArray
    t: FloatArray
    counts: Counts
    rate_hz: float

    @property
    def attempt_starts(self) -> tuple[int, ...]:
        """Row numbers at which an attempt starts, except the first attempt."""
        ends = np.cumsum([len(rows) for rows in self.attempts])
        return tuple(int(end) for end in ends[:-1])

    @property
    def recorded_s(self) -> float:
        """Device time from the first to the last sample, summed over all attempts [s]."""
        times = (
            self.t[first:last] for first, last in pairwise((0, *self.attempt_starts, len(self.t)))
        )
        return float(sum(t[-1] - t[0] for t in times))

    @property
    def measured_rate_hz(self) -> float:
        """Sample rate outside of gaps [Hz]; NaN if the recording is too short."""
        steps = np.diff(self.t)
        steps = steps[(steps > 0) & (steps < 1.5 * np.median(steps))] if len(steps) else steps
        return float(1.0 / steps.mean()) if len(steps) else float("nan")

    @property
    def gaps_percent(self) -> float:
        """Missing samples as a share of the expected number of samples [%]."""
        expected = self.counts.samples + self.counts.missing
        return 100.0 * self.counts.missing / expected if expected else float("nan")

    def tracking_error(self) -> FloatArray:
        """Return (N, n) tracking errors: position q minus commanded position q_target [rad].

        The tracking errors are NaN without a command. The sign is opposite to the usual following
        error e = q_d − q in control engineering.
        """
        error: FloatArray = self.rows["q"] - self.rows["q_target"]
        return error


def read_recording(facts: RunFacts, problems: list[str]) -> Recording | None:
    """Return the samples of a run; None if the run has no samples.

    A torn file is read up to its damage. Messages about torn and unreadable files are added to the
    list `problems`.
    """
    attempts = dict(_attempts_of(RunDirectory(facts.path).recordings, problems))
    if not attempts:
        return None
    rate_hz, parts = facts.rate_hz, tuple(attempts.values())
    rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
    counts = _count(parts, rate_hz)
    return Recording(parts, tuple(attempts), rows, _times(parts), counts, rate_hz)


def _attempts_of(paths: Sequence[Path], problems: list[str]) -> Iterator[tuple[int, StructArray]]:
    """Yield number and samples of every non-empty attempt, with the files of an attempt joined."""
    for number, files in groupby(paths, attempt_of):
        parts = [rows for file in files if (rows := _samples_of(file, problems)) is not None]
        if kept := [rows for rows in parts if len(rows)]:
            yield number, kept[0] if len(kept) == 1 else np.concatenate(kept)


def _samples_of(path: Path, problems: list[str]) -> StructArray | None:
    if path.name.endswith(PARTIAL_SUFFIX):
        problems.append(f"{path.name} was not finished: only the part written to the disk is read")
    try:
        return read_topic(path, salvage=True)
    except DataError as error:
        problems.append(error.message)
        return None


def _times(blocks: Sequence[StructArray]) -> FloatArray:
    """Return the device times of all attempts on one time axis.

    If the device clock was reset between two attempts, the later attempt directly follows the
    earlier one.
    """
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
    """Return the counts summed over the attempts; pauses between attempts do not count as gaps."""
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
    """Return the row ranges in which `segment` is constant and equal to one of `steps`."""
    edges = np.flatnonzero(np.diff(segment)) + 1
    starts = np.concatenate(([0], edges))
    stops = np.concatenate((edges, [len(segment)]))
    selected = np.isin(segment[starts], steps)
    return [(int(a), int(b)) for a, b in zip(starts[selected], stops[selected], strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceDrift:
    """Change of effort at the reference pose between visits.

    Attributes:
        t: (V,) time of each visit [s].
        change: (V, n) mean effort minus the mean effort of the first visit with the same payload
            and approach direction. Only visits with the same direction are compared, because static
            friction has the sign of the approach direction.
        approach: (V,) approach direction: +1 from below, −1 from above, 0 for other visits.
    """

    t: FloatArray
    change: FloatArray
    approach: IntArray


REFERENCE_S = 0.08
"""Averaging time at the end of a visit [s], after the arm has settled."""


def drift_of(facts: RunFacts, recording: Recording) -> ReferenceDrift | None:
    """Return the change of effort at the reference pose; None if no visit was repeated."""
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
    """Return the dwells and trajectories of a run as a dataset.

    Raises:
        DataError: There are no dwells and no trajectories, or the run does not describe its robot.
    """
    robot = facts.robot
    if not robot.get("model") or not facts.joint_names:
        raise DataError(
            f"{facts.path / 'start.json'} does not describe the robot",
            hint="the run directory is damaged or was edited: restore it from a backup",
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
