"""What the samples of a run show: recording health, held-out data and what models predict of it.

`read_recording` reads all attempts of a run; continuity, drift and visited poses are computed from
these rows. `measured` cuts the same rows into the series a model is judged on: reading them again
by `hil.importers.load_source`, with all moves between them, would take longer than the rest of the
report. `show` predicts held-out series with a saved model, and takes friction apart: the measured
effort less what the model says is no friction.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.core import BoolArray, DataError, FloatArray, IntArray, StructArray
from hil.data import (
    Conditions,
    Dataset,
    FilterSettings,
    Model,
    Prediction,
    SeriesKind,
    derivative,
    is_prepared,
    prepare,
    series_means,
)
from hil.estimators import HasFrictionCurve, RobotEstimator, knows_torque, load_model_file
from hil.importers import Origin, Series, assemble, cut, dwell_rule_of, origin_of_run, steps_of_plan
from hil.recording import PARTIAL_SUFFIX, Counts, RunDirectory, attempt_of, read_topic
from hil.report.run_facts import HONEST, FitFacts, RunFacts, as_index, as_names

if TYPE_CHECKING:
    from hil.evaluation import Judged


REFERENCE_SAMPLES = 10
"""Rows of a visit that are averaged: the last ones, when the arm has settled."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """All samples of a run, attempts behind each other.

    Attributes:
        attempts: Records of `state_dtype(n)`, one array per attempt.
        rows: All of them in one array.
        t: (N,) seconds since the first sample of the run.
        counts: Samples, gaps, missing, duplicates and overruns, all attempts together.
        rate_hz: Nominal rate; NaN when the run does not say.
    """

    attempts: tuple[StructArray, ...]
    rows: StructArray
    t: FloatArray
    counts: Counts
    rate_hz: float

    @property
    def begins(self) -> tuple[int, ...]:
        """Rows at which the attempts after the first begin: nothing was recorded before them."""
        ends = np.cumsum([len(rows) for rows in self.attempts])
        return tuple(int(end) for end in ends[:-1])

    @property
    def recorded_s(self) -> float:
        """Device time from the first to the last sample of every attempt, added up [s]."""
        times = (self.t[first:last] for first, last in pairwise((0, *self.begins, len(self.t))))
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
        """(N, n) position minus commanded position [rad]; NaN where nothing is commanded."""
        error: FloatArray = self.rows["q"] - self.rows["q_target"]
        return error


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
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


def read_recording(facts: RunFacts, problems: list[str]) -> Recording | None:
    """The samples of a run; None when nothing is left.

    Torn files are read as far as they go; they and unreadable ones are added to `problems`.
    """
    kept = list(_attempts(RunDirectory(facts.path).recordings, problems))
    if not kept:
        return None
    rate_hz = facts.rate_hz
    rows = kept[0] if len(kept) == 1 else np.concatenate(kept)
    return Recording(tuple(kept), rows, _times(kept), _count(kept, rate_hz), rate_hz)


def _attempts(paths: Sequence[Path], problems: list[str]) -> Iterator[StructArray]:
    """The samples of every attempt that has any, the parts of a long one behind each other."""
    for _, files in groupby(paths, attempt_of):
        parts = [rows for file in files if (rows := _read(file, problems)) is not None]
        if kept := [rows for rows in parts if len(rows)]:
            yield kept[0] if len(kept) == 1 else np.concatenate(kept)


def _read(path: Path, problems: list[str]) -> StructArray | None:
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


def drift_of(facts: RunFacts, recording: Recording) -> Drift | None:
    """How the effort at the reference pose changed; None unless a visit was repeated."""
    visits = np.array(facts.indices("reference"), dtype=np.int64)
    segment = recording.rows["segment"].astype(np.int64)
    stays = _stays(segment, visits)
    steps = [facts.steps[int(segment[first])] for first, _ in stays]
    kinds = [(as_index(step.get("load"), 0), as_index(step.get("approach"), 0)) for step in steps]
    if len(set(kinds)) == len(kinds):
        return None
    effort = np.array([_last_mean(recording.rows["effort"], *stay) for stay in stays])
    first = np.array([kinds.index(kind) for kind in kinds])
    return Drift(
        t=np.array([recording.t[last - 1] for _, last in stays]),
        change=effort - effort[first],
        approach=np.array([approach for _, approach in kinds]),
    )


def _stays(segment: IntArray, steps: IntArray) -> list[tuple[int, int]]:
    """Row ranges in which `segment` stays at one of `steps`."""
    edges = np.flatnonzero(np.diff(segment)) + 1
    starts = np.concatenate(([0], edges))
    stops = np.concatenate((edges, [len(segment)]))
    wanted = np.isin(segment[starts], steps)
    return [(int(a), int(b)) for a, b in zip(starts[wanted], stops[wanted], strict=True)]


def _last_mean(effort: FloatArray, first: int, last: int) -> FloatArray:
    mean: FloatArray = effort[max(first, last - REFERENCE_SAMPLES) : last].mean(axis=0)
    return mean


def dwell_poses(facts: RunFacts, recording: Recording) -> tuple[IntArray, FloatArray]:
    """Pose numbers (P,) and where the arm stood at them (P, n) [rad], each pose once."""
    poses, where = [], []
    segment = recording.rows["segment"].astype(np.int64)
    for _, last in _stays(segment, np.array(facts.indices("dwell"), dtype=np.int64)):
        poses.append(as_index(facts.steps[int(segment[last - 1])].get("pose")))
        where.append(recording.rows["q"][last - 1])
    if not poses:
        return np.empty(0, np.int64), np.empty((0, 0))
    number, first = np.unique(np.array(poses), return_index=True)
    return number, np.array(where)[first]


def rows_of_steps(rows: StructArray, steps: Sequence[int]) -> StructArray:
    """The rows recorded while one of these plan steps was executing."""
    wanted = np.zeros(max(steps, default=-1) + 2, np.bool_)
    wanted[list(steps)] = True
    segment = np.clip(rows["segment"], -1, len(wanted) - 1)
    chosen: StructArray = rows[wanted[segment]]
    return chosen


MEASURED: tuple[SeriesKind, ...] = ("dwell", "trajectory")


def measured(facts: RunFacts, recording: Recording) -> Dataset:
    """The dwells and trajectories of a run.

    Raises:
        DataError: There are none, or the run does not describe its robot.
    """
    notes = steps_of_plan(facts.plan, facts.path / "plan.json", facts.unsettled_steps, MEASURED)
    latest: dict[int, list[Series]] = {}
    for attempt, rows in enumerate(recording.attempts):
        pieces = cut(rows, notes, attempt)
        # A later attempt replaces what an earlier one recorded of the same step.
        latest |= {piece.step: [] for piece in pieces}
        for piece in pieces:
            latest[piece.step].append(piece)
    series = [piece for step in sorted(latest) for piece in latest[step]]
    rule = dwell_rule_of(facts.plan, facts.path / "plan.json")
    return assemble(series, _origin(facts), rule.samples)


def _origin(facts: RunFacts) -> Origin:
    robot = facts.robot
    if not robot.get("model") or not facts.joint_names:
        raise DataError(
            f"{facts.path / 'start.json'} does not describe the robot",
            hint="the run directory is damaged or was edited: take it from a copy",
        )
    described = {"joint_names": list(facts.joint_names), "effort_kind": _effort_kind(facts)}
    return origin_of_run({"robot": {**robot, **described}}, str(facts.path))


def _effort_kind(facts: RunFacts) -> str:
    return "torque" if facts.effort_unit == "N·m" else "current"


MOST_ROWS = 60_000
"""More rows than this are not predicted for a plot; whole series are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Dwells:
    """Means over each held-out dwell.

    Attributes:
        t: (D,) when [s].
        q: (D, n) where [rad].
        measured, predicted: (D, n) mean effort.
        approach, pose, load: (D,) +1, −1 or 0; pose numbers; indices of the loads.
    """

    t: FloatArray
    q: FloatArray
    measured: FloatArray
    predicted: FloatArray
    approach: IntArray
    pose: IntArray
    load: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Held-out trajectories, rows the model calls valid.

    Attributes:
        worst: Conditions of the trajectory with the largest error; shown over time.
        t, measured, predicted: Of that trajectory, (M,) and (M, n).
        q, qd, all_measured, all_predicted: Of all held-out trajectories, (N, n).
        count: How many trajectories there are.
    """

    worst: Conditions
    t: FloatArray
    measured: FloatArray
    predicted: FloatArray
    q: FloatArray
    qd: FloatArray
    all_measured: FloatArray
    all_predicted: FloatArray
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class AtRest:
    """Friction of held-out dwells: means over the rows the model is valid in, NaN without any.

    Attributes:
        q: (D, n) where [rad].
        measured: (D, n) mean effort less the model's gravity, offset and load.
        predicted: (D, n) friction of the model, with what its network adds; None where it knows
            none at rest.
        approach, pose: (D,) +1, −1 or 0; pose numbers.
    """

    q: FloatArray
    measured: FloatArray
    predicted: FloatArray | None
    approach: IntArray
    pose: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Law:
    """Friction as a function of velocity, over the velocities of the data; all arrays (M, n).

    Attributes:
        qd: Velocities of each joint, rising [rad/s].
        torque, dry, std_error, terms: See `hil.estimators.friction_curve`.
    """

    qd: FloatArray
    torque: FloatArray
    dry: FloatArray
    std_error: FloatArray
    terms: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class InMotion:
    """Friction along held-out trajectories, rows the model calls valid.

    Attributes:
        qd: (N, n) [rad/s].
        measured: (N, n) effort less the model's gravity, inertia and load.
        predicted: (N, n) friction of the model, with what its network adds.
        law: The same as a curve; None where the model gives none.
        learned: Whether a network adds something.
    """

    qd: FloatArray
    measured: FloatArray
    predicted: FloatArray
    law: Law | None
    learned: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Friction:
    """What is known of a model's friction; either part may be missing.

    Attributes:
        unit: `N·m`, or `A` where nobody knows the drive gains.
        at_rest, in_motion: In that unit.
    """

    unit: str
    at_rest: AtRest | None = None
    in_motion: InMotion | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What can be drawn of one model on one held-out dataset; every part may be missing."""

    dwells: Dwells | None
    motions: Motions | None
    friction: Friction | None = None


def held_out_of(fit: FitFacts, data: Dataset) -> Dataset:
    """The series of a run that a model was judged on, as its `evaluation.json` names them.

    Ids begin with the name the run directory had then; it may have been renamed since.

    Raises:
        DataError: The evaluation names none that are in the recording.
    """
    judged = {_within_run(str(name)) for name in as_names(fit.held_out.get("series"))}
    held_out = data.select(lambda condition: _within_run(condition.id) in judged)
    if not held_out.conditions:
        raise DataError(
            f"{fit.folder.name}/evaluation.json names no held-out series of this recording",
            hint="fit and judge again: hil fit RUN --estimator NAME --validate OTHER_RUN",
        )
    return held_out


def _within_run(name: str) -> str:
    return name.rpartition(":")[2]


def show(folder: Path, data: Dataset, judged: Judged | None = None) -> Shown:
    """Predict held-out data with a saved model, except what is known since it was judged.

    Raises:
        HilError: The model cannot be loaded, or does not fit the data.
    """
    from hil.evaluation import usable_part

    model = load_model_file(folder)
    return shown(model, usable_part(data, model), judged)


def shown(model: Model, data: Dataset, judged: Judged | None = None) -> Shown:
    """Predict held-out data with a model; whatever is no dwell counts as a trajectory."""
    held, moved = _few(data.of_kind("dwell")), _few(data.of_kind("trajectory", "move"))
    _, unit = scale_of(model)
    dwells = motions = None
    friction = Friction(unit)
    if held.conditions:
        prediction = judged.predict(model, held) if judged else model.predict(held)
        dwells = _dwells(held, prediction)
        friction = replace(friction, at_rest=at_rest(model, held, prediction))
    if moved.conditions:
        prediction = judged.predict(model, moved) if judged else model.predict(moved)
        motions = _motions(moved, prediction, velocity(model, moved))
        friction = replace(friction, in_motion=in_motion(model, moved, prediction, motions.qd))
    return Shown(dwells, motions, friction)


def _few(data: Dataset) -> Dataset:
    """Whole series, evenly spread over the dataset, of together at most `MOST_ROWS` rows."""
    lengths = np.diff(data.offsets)
    usable = [i for i, length in enumerate(lengths) if length > 0]
    total = int(lengths.sum())
    every = max(1, -(-total // MOST_ROWS))
    chosen = _ids(data.conditions, usable[::every])
    return data.select(lambda condition: id(condition) in chosen)


def _ids(conditions: Sequence[Conditions], numbers: Sequence[int]) -> set[int]:
    return {id(conditions[i]) for i in numbers}


def _dwells(data: Dataset, prediction: Prediction) -> Dwells:
    return Dwells(
        t=data["t"][data.offsets[:-1]],
        q=series_means(data, data["q"]),
        measured=series_means(data, data["effort"]),
        predicted=series_means(data, prediction.effort),
        approach=np.array([c.approach for c in data.conditions], dtype=np.int64),
        pose=np.array([c.pose for c in data.conditions], dtype=np.int64),
        load=np.array([c.load for c in data.conditions], dtype=np.int64),
    )


def _motions(data: Dataset, prediction: Prediction, qd: FloatArray) -> Motions:
    predicted = np.where(prediction.valid, prediction.effort, np.nan)
    measured = data["effort"]
    spans = list(data.slices())
    errors = [_relative_error(measured[rows], predicted[rows], measured) for _, rows in spans]
    worst, rows = spans[int(np.argmax(errors))]
    t = data["t"][rows]
    return Motions(
        worst=worst,
        t=t - t[0],
        measured=measured[rows],
        predicted=predicted[rows],
        q=data["q"],
        qd=qd,
        all_measured=measured,
        all_predicted=predicted,
        count=len(spans),
    )


def _relative_error(measured: FloatArray, predicted: FloatArray, all_measured: FloatArray) -> float:
    """Mean over the joints of RMSE over signal, −1 when the model is valid nowhere."""
    good = np.isfinite(predicted)
    if not good.any():
        return -1.0
    scale = np.maximum(all_measured.std(axis=0), 1e-12)
    error = np.where(good, (measured - predicted) / scale, 0.0)
    return float(np.sqrt(np.mean(error**2)))


def velocity(model: Model, data: Dataset) -> FloatArray:
    """(N, n) as recorded, else what the model saw; NaN for series without either [rad/s]."""
    if "qd" in data.columns:
        return data["qd"]
    if is_prepared(data):
        return data["qd_f"]
    filters = getattr(model, "filters_", None) or getattr(model, "filters", None)
    if isinstance(filters, FilterSettings):
        return prepare(data, filters)["qd_f"]
    qd = np.full_like(data["q"], np.nan)
    for _, rows in data.slices():
        with suppress(DataError):
            qd[rows] = derivative(data["q"][rows], data["t"][rows])
    return qd


PART, LEARNED = "friction", "residual"
"""Of a prediction. What a network adds to the physics is friction that the physics misses, or what
else it misses: taken away from the measured effort, it would hide just that friction."""

NEAR_ZERO = 0.05
"""Up to this speed [rad/s] curves are drawn finely: friction turns there."""


def scale_of(model: Model) -> tuple[FloatArray, str]:
    """What turns efforts of a model into its friction's unit, (n,) or (1,), and that unit."""
    if isinstance(model, RobotEstimator) and knows_torque(model):
        return model.torque_scale_, "N·m"
    return np.ones(1), "A"


def at_rest(model: Model, data: Dataset, prediction: Prediction) -> AtRest | None:
    """Friction of dwells; None when no approach is known, or the target was among the inputs.

    None, too, where the model is valid nowhere.
    """
    approach = np.array([c.approach for c in data.conditions], dtype=np.int64)
    if not approach.any() or getattr(model, "protocol", HONEST) != HONEST:
        return None
    if not prediction.valid.any():
        return None
    scale, _ = scale_of(model)
    told = _told(prediction)
    knows = PART in prediction.components
    return AtRest(
        q=series_means(data, data["q"]),
        measured=_means(data, data["effort"] - prediction.effort + told, prediction.valid) * scale,
        predicted=_means(data, told, prediction.valid) * scale if knows else None,
        approach=approach,
        pose=np.array([c.pose for c in data.conditions], dtype=np.int64),
    )


def _told(prediction: Prediction) -> FloatArray:
    """(N, n) what may be friction, in the unit of the effort; 0 where the model tells none."""
    parts = [
        prediction.components[name] for name in (PART, LEARNED) if name in prediction.components
    ]
    told: FloatArray = np.sum([np.zeros_like(prediction.effort), *parts], axis=0)
    return told


def _means(data: Dataset, values: FloatArray, valid: BoolArray) -> FloatArray:
    """(D, n) mean of values (N, n) over the valid rows of each dwell; NaN without any."""
    share = series_means(data, valid.astype(np.float64))
    sums = series_means(data, np.where(valid, values, 0.0))
    return np.divide(sums, share, out=np.full_like(sums, np.nan), where=share > 0)


def in_motion(
    model: Model, data: Dataset, prediction: Prediction, qd: FloatArray
) -> InMotion | None:
    """Friction along trajectories; None when the model does not tell it, or is for arms at rest."""
    friction = prediction.components.get(PART)
    if friction is None or getattr(model, "protocol", HONEST) != HONEST:
        return None
    told = _told(prediction)
    known = prediction.valid & np.isfinite(told)
    if not (known & (np.abs(friction) > 0)).any():
        return None
    learned = bool(np.any(known & (told != friction)))
    scale, _ = scale_of(model)
    measured = data["effort"] - prediction.effort + told
    predicted = np.where(known, told * scale, np.nan)
    law = None if learned else _law(model, np.where(known, qd, np.nan))
    return InMotion(qd, np.where(known, measured * scale, np.nan), predicted, law, learned)


def _law(model: Model, qd: FloatArray) -> Law | None:
    if not isinstance(model, HasFrictionCurve):
        return None
    good = np.isfinite(qd)
    low = np.min(qd, axis=0, where=good, initial=np.inf)
    high = np.max(qd, axis=0, where=good, initial=-np.inf)
    low, high = (np.where(good.any(axis=0), edge, np.nan) for edge in (low, high))
    places = np.linspace(low, high, 161)
    near = np.linspace(-NEAR_ZERO, NEAR_ZERO, 41)[:, None] + np.zeros(qd.shape[1])
    places = np.sort(np.vstack([places, np.clip(near, low, high)]), axis=0)
    curve = model.friction_curve(places)
    if curve is None:
        return None
    return Law(places, curve.torque, curve.dry, curve.std_error, curve.terms)
