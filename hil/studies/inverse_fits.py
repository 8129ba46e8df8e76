"""Fits of the inverse-dynamics study, the evaluation of each fit, and the ranking of the methods.

`family_task` fits a model and its correction networks in one task, so that the model is fitted only
once. `judged` reduces a fitted model to the values that the tables and figures need; these values
are small enough to be sent back from another process. `Found` contains these reduced values for
every table row and every seed under one protocol.

Two methods are ranked only if the function `apart` returns true. The random splits and networks are
paired: both methods use the same seeds. Assume that two methods have equal errors, and that their
differences are normally distributed and independent between the draws. The two methods are
nevertheless ranked in 21 % of all studies with two draws, in 7.4 % with three draws and in 1.1 %
with five draws. The three rates of wrong rankings (21 %, 7.4 %, 1.1 %) follow from Student's t
distribution with (draws − 1) degrees of freedom and the limit `APART`·√draws.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from hil.core import BoolArray, FloatArray, HilError, IntArray
from hil.data import Dataset, Prediction, motion_rates, nyquist_fraction, sample_rate, zero_phase
from hil.dynamics import RobotModel
from hil.estimators import RobotEstimator
from hil.networks import Curves
from hil.studies.dynamic_methods import MOVING, SHOWN, percent_where, rmse_where
from hil.studies.inverse_cases import Case, Held, forgotten, persistence_of, white_noise_left
from hil.studies.inverse_methods import LATENCY_S, PREVIOUS_S, ROWS, unfitted
from hil.studies.tasks import Task

COSTS = {"lagrangian": 10.0, "rigid-hysteresis": 8.0, "residual": 8.0, "rigid-irls": 2.0}
"""Fit duration of each estimator relative to the other estimators; the longest fits start first."""


def family_task(
    root: str, keys: Sequence[str], case: Case, robot: RobotModel, sign_width: float, effort: float
) -> Task:
    """Return a task that fits the model `root` and its corrections.

    The result of the task is a dictionary with one `Judged` for each key in `keys`.
    """
    cost = sum(COSTS.get(ROWS[key].estimator, 1.0) for key in {root, *keys})
    name = f"{ROWS[root].estimator} ({', '.join(keys)}), {case.protocol}, seed {case.seed}"
    run = partial(fit_family, root, tuple(keys), case, robot, sign_width, effort)
    return Task(run, cost, name, _what_failed)


def _what_failed(found: Mapping[str, Judged]) -> str:
    """Return a text about the failed rows of a family for a progress report (`Ended.failed`)."""
    failed = [key for key, one in found.items() if one.failed]
    if len(failed) == len(found):
        return "failed"
    return f"without {', '.join(failed)}, which failed" if failed else ""


def fit_family(
    root: str, keys: Sequence[str], case: Case, robot: RobotModel, sign_width: float, effort: float
) -> dict[str, Judged]:
    """Fit and evaluate the model `root` and its corrections, as described in `family_task`.

    An error of a fit is returned in `Judged.failed` instead of being raised.

    Raises:
        DataError: Some test rows are among the training rows.
    """
    case.require_honest()

    def new(key: str) -> RobotEstimator:
        return unfitted(ROWS[key], case.seed, sign_width, case.filters, effort)

    return {
        key: nothing(robot.n, failed) if model is None else _judged(model, case, robot, seconds)
        for key, model, seconds, failed in fitted_family(root, keys, new, case.learn, robot)
    }


New = Callable[[str], RobotEstimator]

Fitted = tuple[str, RobotEstimator | None, float, str]
"""Tuple of row key, model or None, CPU time [s], and reason of a failure.

The CPU time of a correction includes the fit of the corrected model.
"""


def fitted_family(
    root: str, keys: Sequence[str], new: New, learn: Dataset, robot: RobotModel
) -> Iterator[Fitted]:
    """Yield the model `root` and its corrections; a failed fit is yielded as text, not raised.

    Args:
        root: Key of a row in `ROWS` that does not correct another row.
        keys: Keys of the requested rows: the row `root` itself or corrections of the model `root`.
        new: Function that returns an unfitted estimator for a row key.
        learn: Training data.
        robot: Model of the arm.
    """
    base, seconds, failed = _timed(lambda: new(root).fit(learn, robot))
    for key in keys:
        if key == root or base is None:
            yield key, base, seconds, failed
            continue
        model, more, why = _timed(partial(_corrected, new, key, base, learn, robot))
        yield key, model, seconds + more, why


def _corrected(
    new: New, key: str, base: RobotEstimator, learn: Dataset, robot: RobotModel
) -> RobotEstimator:
    correction: Any = new(key)
    fitted: RobotEstimator = correction.fit_on(base, learn, robot)
    return fitted


def _judged(model: RobotEstimator, case: Case, robot: RobotModel, seconds: float) -> Judged:
    found, failed = _tried(lambda: judged(model, case, seconds))
    return nothing(robot.n, failed) if found is None else found


def _timed(fit: Callable[[], RobotEstimator]) -> tuple[RobotEstimator | None, float, str]:
    """Return the fitted model or None, the CPU time of the fit [s], and the reason of a failure."""
    begin = time.process_time()
    model, failed = _tried(fit)
    return model, time.process_time() - begin, failed


def _tried(make: Callable[[], Any]) -> tuple[Any, str]:
    """Return the result of a function and an empty text; or None and the error message."""
    try:
        return make(), ""
    except HilError as error:
        return None, error.message
    # Estimators are plug-ins: an unexpected error of one must not discard the results of others.
    except Exception as error:
        return None, f"it failed with {type(error).__name__}: {error}"


CLOUD = 400
"""Number of test samples in the friction figure, evenly spaced over all test samples."""

F_CUT_HZ = 2.0
"""Default frequency [Hz] that separates low and high frequencies of a residual (eq. 24)."""

ORDER = 5


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Evaluation of one fit of one table row, per joint [N·m]; NaN if a joint has no test samples.

    Attributes:
        filtered, raw: (n,) RMSE relative to the filtered effort and to the unfiltered measured
            effort.
        moving: (n,) RMSE relative to the filtered effort in samples with a moving joint.
        percent: (n,) largest error divided by the largest torque (MEP) [%].
        within: (n,) share [%] of the measured torques that differ from the prediction by at most
            1.645 standard deviations predicted by the model.
        known: Share of the test rows for which the model makes a prediction.
        seconds: CPU time of the fit [s]; for a correction, including the fit of the corrected
            model.
        aware, unaware: (n,) RMSE by payload number, for the model with and without payload
            information.
        curves: (epochs,) training loss and validation error, by name.
        decided: (n,) texts about the decision to keep or to drop a residual network. Each text
            contains the errors without and with the network on rows outside its training data, the
            relative change, and whether the network was dropped.
        shown: Values that the figures show.
        failed: Reason why the fit failed; empty if the fit succeeded.
    """

    filtered: FloatArray
    raw: FloatArray
    moving: FloatArray
    percent: FloatArray
    within: FloatArray
    known: float = 0.0
    seconds: float = float("nan")
    aware: dict[int, FloatArray] = field(default_factory=dict)
    unaware: dict[int, FloatArray] = field(default_factory=dict)
    curves: dict[str, FloatArray] = field(default_factory=dict)
    decided: tuple[str, ...] = ()
    shown: Shown = field(default_factory=lambda: Shown(np.zeros((0, 0))))
    failed: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """Values of one fit for the figures [N·m].

    Attributes:
        torque: (rows, n) predicted torque on the first test trajectory.
        friction, rigid: (cloud, n) friction and rigid-body torque over all test samples; empty if
            the model has no separate friction.
        residual: (2, rows, n) low-frequency and high-frequency part of the correction; empty
            without a correction.
        left: (2, rows, n) low-frequency and high-frequency part of the residual of the model
            without correction.
    """

    torque: FloatArray
    friction: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    rigid: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    residual: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    left: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))


def judged(model: RobotEstimator, case: Case, seconds: float) -> Judged:
    """Return the errors and the figure values of a fitted model.

    Raises:
        DataError: The model cannot be applied to the test data.
    """
    data, scale = case.judge, case.scale
    predicted = model.predict(data)
    torque = _told(predicted) * scale
    known = np.isfinite(torque) & case.rows[:, None]
    filtered, raw = data["effort_f"] * scale, data["effort"] * scale
    return Judged(
        filtered=rmse_where(filtered, torque, known),
        raw=rmse_where(raw, torque, known),
        moving=rmse_where(filtered, torque, known & (data[MOVING] > 0)),
        percent=percent_where(filtered, torque, known),
        within=_within(raw - torque, predicted.std * scale, known),
        known=float(np.mean(known[case.rows])),
        seconds=seconds,
        aware=_under_loads(model, case.loaded, scale),
        unaware=_under_loads(model, case.loaded and forgotten(case.loaded), scale),
        curves=_curves(model),
        decided=_decided(model, scale),
        shown=_shown(predicted, torque, case),
    )


def _told(predicted: Prediction) -> FloatArray:
    """Return the (N, n) predicted effort, with NaN in rows that the model marks as invalid."""
    return np.where(predicted.valid, predicted.effort, np.nan)


def _within(error: FloatArray, deviation: FloatArray, known: BoolArray) -> FloatArray:
    inside = np.abs(error) <= 1.645 * deviation
    told = known & np.isfinite(deviation)
    counts = np.count_nonzero(told, axis=0)
    share = 100.0 * np.count_nonzero(inside & told, axis=0) / np.maximum(counts, 1)
    return np.where(counts > 0, share, np.nan)


def _under_loads(
    model: RobotEstimator, data: Dataset | None, scale: FloatArray
) -> dict[int, FloatArray]:
    if data is None:
        return {}
    torque = _told(model.predict(data)) * scale
    loads = np.array([condition.load for condition in data.conditions])[data.series_index()]
    filtered, known = data["effort_f"] * scale, np.isfinite(torque)
    return {
        int(load): rmse_where(filtered, torque, known & (loads == load)[:, None])
        for load in np.unique(loads)
    }


def _curves(model: RobotEstimator) -> dict[str, FloatArray]:
    told: Curves | None = getattr(model, "curves_", None)
    if told is None:
        return {}
    both = {"loss": told.loss, "validation": told.validation}
    return {name: np.asarray(values, dtype=np.float64) for name, values in both.items()}


def _decided(model: RobotEstimator, scale: FloatArray) -> tuple[str, ...]:
    selection = getattr(model, "selection_", None)
    if selection is None:
        return ()
    without, corrected = selection.without * scale, selection.corrected * scale
    percent = 100.0 * (corrected / without - 1.0)
    return tuple(
        f"{'' if kept else 'dropped: '}{without[j]:.3g} → {corrected[j]:.3g} ({percent[j]:+.1f} %)"
        for j, kept in enumerate(selection.kept)
    )


def _shown(predicted: Prediction, torque: FloatArray, case: Case) -> Shown:
    rows, cloud, scale = shown_rows(case), cloud_rows(case), case.scale
    parts = predicted.components
    if "friction" not in parts:
        return Shown(torque[rows])
    friction = parts["friction"] * scale
    correction = parts["residual"] * scale if "residual" in parts else np.zeros_like(friction)
    rigid = torque - friction - correction
    if "residual" not in parts:
        return Shown(torque[rows], friction[cloud], rigid[cloud])
    left = case.judge["effort_f"] * scale - (torque - correction)
    both = [_low_and_high(values, case, rows) for values in (correction, left)]
    return Shown(torque[rows], friction[cloud], rigid[cloud], *both)


def _low_and_high(values: FloatArray, case: Case, rows: IntArray) -> FloatArray:
    """Return the (2, rows, n) parts of a signal (N, n) below and above `F_CUT_HZ`.

    Only rows of the first test trajectory are returned.
    """
    end = int(case.judge.offsets[1])
    first = np.nan_to_num(values[:end])
    fraction = nyquist_fraction(F_CUT_HZ, "hz", sample_rate(case.judge["t"][:end]))
    low = zero_phase(first, fraction, ORDER)
    return np.stack([low[rows], (first - low)[rows]])


def nothing(n: int, failed: str) -> Judged:
    """Return the `Judged` of a fit that failed, without any errors."""
    empty = np.full(n, np.nan)
    return Judged(empty, empty, empty, empty, empty, failed=failed)


def shown_rows(case: Case) -> IntArray:
    """Return the row numbers of the first test trajectory that are shown in figures over time."""
    return evenly(np.flatnonzero(case.rows[: case.judge.offsets[1]]), SHOWN)


def cloud_rows(case: Case) -> IntArray:
    """Return the numbers of the test rows that the friction figure shows."""
    return evenly(np.flatnonzero(case.rows), CLOUD)


def evenly(numbers: IntArray, most: int) -> IntArray:
    """Return at most `most` evenly spaced row numbers, including the first and the last row."""
    ends = np.linspace(0, len(numbers) - 1, min(most, len(numbers)))
    return np.asarray(numbers[np.unique(ends.astype(np.int64))])


APART = 2.0
"""Minimum mean of the paired error differences for a ranking, in standard deviations over the
seeds.
"""

FEWEST_SEEDS = 3
"""Minimum number of random seeds for a ranking of two methods."""


def apart(found: Found, a: str, b: str) -> bool:
    """Return whether the errors of the rows a and b differ significantly.

    The mean of the paired error differences of the two rows must exceed two standard deviations
    over the seeds (`APART`).
    """
    difference = found.by_seed(a) - found.by_seed(b)
    if len(difference) < FEWEST_SEEDS:
        return False
    return abs(float(np.mean(difference))) > APART * float(np.std(difference, ddof=1))


def doubt(found: Found) -> str:
    """Return the reason why two table rows cannot be ranked."""
    seeds = len(found.seen)
    if seeds >= FEWEST_SEEDS:
        return "they differ by less than two standard deviations over the seeds"
    return f"a ranking requires {FEWEST_SEEDS} seeds, this study has {seeds}"


def beside(found: Found, key: str, reference: str, name: str) -> str:
    """Return a text that states how much lower the error of a row is than that of a reference row.

    If the difference of the two errors is not significant, the text also states this fact.

    Args:
        found: Results of a protocol.
        key: Key of the row that is compared.
        reference: Key of the reference row.
        name: Display name of the reference row.
    """
    error, against = found.average(key), found.average(reference)
    if error == against:
        return f"the same as {name}"
    told = f"{_less(error, against)} than {name}"
    return told if apart(found, key, reference) else f"{told} (not significant: {doubt(found)})"


def _less(error: float, reference: float) -> str:
    percent = 100 * (1 - error / reference)
    size = f"{abs(percent):.0f} %" if abs(percent) >= 0.5 else "under 0.5 %"
    return f"{size} {'less' if percent >= 0 else 'more'}"


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Measured values and reference errors of a case, independent of any model [N·m].

    Attributes:
        t, measured: (rows,) time [s] and (rows, n) filtered torque of the first test trajectory.
        speeds, cloud: (cloud, n) velocity [rad/s] and (cloud, n) filtered torque over all test
            rows.
        removed: (n,) RMS of the part of the measured torque that the filter removes.
        noise: (n,) RMS of the noise in the filtered torque, assuming white measurement noise.
        persistence: Error of predicting each torque by the newest torque of at least a given age,
            by age [s].
        rate_hz: Recorded sample rate [Hz], as the median over the test trajectories.
    """

    t: FloatArray
    measured: FloatArray
    speeds: FloatArray
    cloud: FloatArray
    removed: FloatArray
    noise: FloatArray
    persistence: Mapping[float, Held]
    rate_hz: float

    @staticmethod
    def of(case: Case) -> Seen:
        """Compute the measured values and reference errors of one case."""
        data, rows, cloud = case.judge, shown_rows(case), cloud_rows(case)
        torque = data["effort_f"] * case.scale
        removed = np.sqrt(np.mean((data["effort"] - data["effort_f"])[case.rows] ** 2, axis=0))
        return Seen(
            data["t"][rows] - data["t"][0],
            torque[rows],
            data["qd_f"][cloud],
            torque[cloud],
            removed * case.scale,
            white_noise_left(removed * case.scale, case),
            {latency: persistence_of(case, latency) for latency in (PREVIOUS_S, LATENCY_S)},
            # For display only, so a trajectory with missing samples must not raise an error.
            float(np.median([rate for rate, _ in motion_rates(data)])),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Results of one protocol; all methods of a protocol use the same cases.

    Attributes:
        protocol: Name of the protocol.
        scores: Evaluations by row key, one evaluation per seed; a row that failed for any seed is
            omitted.
        failed: Reasons why rows failed, by row key.
        seen: Measured values and reference errors of the cases, one entry per seed.
        loads: Display name of every payload except the first one, by payload number.
    """

    protocol: str
    scores: Mapping[str, Sequence[Judged]]
    failed: Mapping[str, str]
    seen: Sequence[Seen]
    loads: Mapping[int, str]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.seen[0].noise)

    def words(self, key: str) -> str:
        """Return the display name of a row, with its latency at the sample rate of the data."""
        return ROWS[key].words_at(self.seen[0].rate_hz)

    def mean(self, key: str, measure: str) -> FloatArray:
        """Return the (n,) mean of a measure over all seeds."""
        return np.asarray(np.mean([getattr(s, measure) for s in self.scores[key]], axis=0))

    def by_seed(self, key: str, measure: str = "filtered") -> FloatArray:
        """Return the (seeds,) mean of a measure over all joints."""
        return np.array([float(np.mean(getattr(s, measure))) for s in self.scores[key]])

    def spread(self, key: str, measure: str) -> float:
        """Return the standard deviation over the seeds of the joint mean; NaN for a single seed."""
        means = self.by_seed(key, measure)
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def average(self, key: str, measure: str = "filtered") -> float:
        """Return the mean of a measure over all joints and all seeds."""
        return float(np.mean(self.by_seed(key, measure)))

    def beside(self, what: str) -> FloatArray:
        """Return the values of an attribute of `Seen`, (n,) per seed, as an array (seeds, n)."""
        return np.stack([getattr(seen, what) for seen in self.seen])

    def persistence(self, latency_s: float) -> Held:
        """Return the error of predicting a torque by an earlier torque, averaged over the seeds."""
        every = [seen.persistence[latency_s] for seen in self.seen]
        error = np.mean([one.error for one in every], axis=0)
        return Held(float(np.mean([one.age_s for one in every])), error)


def gathered(
    protocol: str,
    results: Iterable[tuple[Sequence[str], Sequence[Mapping[str, Judged]]]],
    seen: Sequence[Seen],
    loads: Mapping[int, str],
) -> Found:
    """Combine the results of all model families under one protocol.

    Args:
        protocol: Name of the protocol.
        results: Row keys of each model family, and the results of these rows, one per seed.
        seen: Measured values and reference errors of the cases, one entry per seed.
        loads: Display names of the payloads by payload number.
    """
    scores: dict[str, list[Judged]] = {}
    failed: dict[str, str] = {}
    for keys, by_seed in results:
        for key in keys:
            found = [one[key] for one in by_seed]
            reason = next((score.failed for score in found if score.failed), "")
            if reason:
                failed[key] = reason
            else:
                scores[key] = found
    return Found(protocol, scores, failed, seen, loads)
