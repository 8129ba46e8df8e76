"""Methods of the dynamic-identification study, their training and test data, and their errors.

`trajectories_of` filters all trajectories of a run before they are split. A protocol splits the
trajectories either by single samples, as in section IV of the PINN paper, or by whole trajectories.
`Protocol` lists one fit per method and split (`fit_and_score`), and collects the `Score` of each
fit in `Found`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from hil.core import BoolArray, DataError, FloatArray, HilError, IntArray, plugins
from hil.data import (
    CLOCK,
    MAX_NYQUIST_FRACTION,
    Dataset,
    FilterSettings,
    Split,
    downsample,
    groups,
    mep,
    paper_sample_split,
    prepare,
    rmse,
    sample_rate,
    split,
)
from hil.dynamics import RobotModel
from hil.estimators import GROUP, Needs, RobotEstimator, estimator, require_robot, torque_scale
from hil.studies.tasks import Task

NEEDS = Needs({"trajectories": 3}, gains=True)
"""Required data: drive gains, and one trajectory each for training, validation and testing."""

SHARES = (0.6, 0.2, 0.2)
"""Shares of the samples for training, validation and testing (section IV of the PINN paper)."""

OF_TWELVE = (7, 2, 3)
"""Numbers of training, validation and test trajectories out of twelve trajectories; close to
`SHARES`.
"""

MOVING_RAD_S = 0.05
"""Minimum joint speed [rad/s] at which a sample counts as moving, away from reversals."""

REVERSAL_S = 0.05
"""Maximum time between a reversal and a sample that is marked as near the reversal [s]."""

MOVING, REVERSAL = "joint_moving", "joint_reversal"
"""Names of the columns (N, n) that mark samples with moving joints and samples near reversals: 1 if
marked, 0 otherwise.

The marks of the samples are stored as columns because every split of the data preserves columns.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """Filtered trajectories of a run for a study of dynamics.

    Attributes:
        data: Filtered data with the columns `MOVING` and `REVERSAL`.
        thinned: Rows of `data` that remain after downsampling.
        filters: Filter and downsampling settings that are passed to the estimators.
        scale: (n,) torque per unit of effort.
        notes: Texts that describe differences from the data of the paper.
    """

    data: Dataset
    thinned: Dataset
    filters: FilterSettings
    scale: FloatArray
    notes: tuple[str, ...]


def trajectories_of(
    whole: Dataset, robot: RobotModel, cutoff_hz: float, rate_hz: float
) -> Trajectories:
    """Return the trajectories of a run, filtered at the recorded rate and then downsampled.

    Args:
        whole: Data of the whole run, including moves between the trajectories.
        robot: Model of the arm.
        cutoff_hz: Cut-off frequency [Hz] of the zero-phase fifth-order Butterworth filter.
        rate_hz: Target rate after downsampling [Hz]; the downsampling factor is rounded to an
            integer.

    Raises:
        FitError: There are too few trajectories, or the data are from a different robot.
        DataError: The cut-off frequency is too high for the recorded or the downsampled rate.
    """
    require_robot(whole, robot)
    data = whole.of_kind("trajectory")
    found = len(groups(data, "trajectory"))
    NEEDS.require(trajectories=found)
    recorded = sample_rate(data["t"][slice(*data.offsets[:2])])
    every = max(1, round(recorded / rate_hz))
    _require_below(cutoff_hz, recorded, every)
    cut = dict.fromkeys(("velocity", "acceleration", "effort"), cutoff_hz)
    filters = FilterSettings.model_validate({"unit": "hz", "every": every, **cut})
    filtered = marked(prepare(data, filters))
    thinned = downsample(filtered, filters)
    notes = [] if found == sum(OF_TWELVE) else [f"{found} trajectories; the paper has twelve"]
    if recorded < 0.99e3:
        notes.append(f"recorded at {recorded:.0f} Hz; the paper at 1000 Hz")
    return Trajectories(filtered, thinned, filters, torque_scale(data), tuple(notes))


def highest_cutoff(data: Dataset, rate_hz: float) -> float:
    """Return the highest cut-off frequency [Hz] that `trajectories_of` accepts.

    The highest accepted cut-off frequency is rounded down to 0.1 Hz.
    """
    recorded = sample_rate(data["t"][slice(*data.offsets[:2])])
    every = max(1, round(recorded / rate_hz))
    return _floor(0.5 * MAX_NYQUIST_FRACTION * recorded / every)


def _require_below(cutoff_hz: float, recorded_hz: float, every: int) -> None:
    """Raise if the cut-off frequency is too high for the filter or the downsampling.

    The error message names the parameters of the study instead of the parameters of the filter.
    """
    kept, highest = (_floor(0.5 * MAX_NYQUIST_FRACTION * recorded_hz / n) for n in (every, 1))
    if cutoff_hz <= kept * (1 + CLOCK):
        return
    thinned = f" and downsampled by rate_hz to {recorded_hz / every:.4g} Hz" if every > 1 else ""
    more = f", or up to {highest:g} Hz with a higher rate_hz" if every > 1 else ""
    raise DataError(
        f"cutoff_hz is {cutoff_hz:g} Hz: too high for data recorded at "
        f"{recorded_hz:.4g} Hz{thinned}",
        hint=f"choose at most {kept:g} Hz{more}",
    )


def _floor(hz: float) -> float:
    """Round a frequency down to 0.1 Hz.

    A small tolerance compensates for rounding errors in frequencies computed from time stamps.
    """
    return math.floor(10.0 * hz * (1.0 + 1e-9)) / 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Training, validation and test data of one split."""

    train: Dataset
    validation: Dataset
    test: Dataset


def paper_parts(of: Trajectories, seed: int) -> Parts:
    """Split the downsampled rows at random: 60 % training, 20 % validation, 20 % test rows.

    Samples that are neighbours in time can belong to different parts of the split.
    """
    return Parts(*paper_sample_split(of.thinned, SHARES, seed))


def honest_parts(of: Trajectories, seed: int) -> Parts:
    """Split whole trajectories: 7, 2 and 3 of twelve, or the same shares of a different number.

    The estimators downsample the data later; this function does not downsample the data.
    """
    outer = held_out(of, seed)
    chosen_by = max(1, round(OF_TWELVE[1] * _twelfths(of)))
    inner = split(outer.train, "trajectory", chosen_by, seed)
    return Parts(inner.train, inner.test, outer.test)


def held_out(of: Trajectories, seed: int) -> Split:
    """Split off whole trajectories for testing: 3 of twelve, or the same share of others."""
    return split(of.data, "trajectory", max(1, round(OF_TWELVE[2] * _twelfths(of))), seed)


def _twelfths(of: Trajectories) -> float:
    return len(groups(of.data, "trajectory")) / sum(OF_TWELVE)


def marked(data: Dataset) -> Dataset:
    """Return the data with the columns `MOVING` and `REVERSAL`."""
    moving = np.abs(data["qd_f"]) > MOVING_RAD_S
    reversal = np.zeros_like(moving)
    for start, stop in pairwise(data.offsets.tolist()):
        rows = slice(start, stop)
        reversal[rows] = near_reversals(data["t"][rows], data["qd_f"][rows])
    flags = {MOVING: moving, REVERSAL: reversal}
    return data.with_columns(**{name: flag.astype(np.float64) for name, flag in flags.items()})


def near_reversals(t: FloatArray, qd: FloatArray) -> BoolArray:
    """Return (N, n) flags of samples within `REVERSAL_S` of a direction change of a joint.

    Args:
        t: (N,) increasing times [s].
        qd: (N, n) filtered velocities.
    """
    found = np.zeros(qd.shape, dtype=bool)
    for j in range(qd.shape[1]):
        moves = np.flatnonzero(qd[:, j])  # a pause in between is part of the reversal
        turned = np.diff(np.sign(qd[moves, j])) != 0
        turns = t[moves[1:][turned]]
        if len(turns):
            after = np.searchsorted(turns, t)
            before, behind = np.clip([after - 1, after], 0, len(turns) - 1)
            gap = np.minimum(np.abs(t - turns[before]), np.abs(t - turns[behind]))
            found[:, j] = gap <= REVERSAL_S
    return found


@dataclass(frozen=True, slots=True)
class Method:
    """Method for predicting joint torques, to be compared by the study.

    Attributes:
        key: Key of the method in the spec.
        words: Name of the method in the tables of results.
        estimator: Name under which the estimator is registered.
        params: Parameters of the estimator in addition to the parameters that all methods share.
        memory: Whether the friction model depends on the path of the joint. A friction model with
            memory needs whole motions and uses no smoothed sign function.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    memory: bool = False


AS_PUBLISHED: Mapping[str, Any] = {"filter_columns": False}
"""Estimator parameters as published: friction columns are computed from the filtered velocity."""

METHODS = {
    method.key: method
    for method in (
        Method("ols", "least squares", "rigid-wls", {"weighted": False}),
        Method("wls", "Method 1: WLS", "rigid-wls"),
        Method("lmi", "Method 2: OLS, physical constraints", "rigid-lmi", AS_PUBLISHED),
        Method(
            "lmi-weighted", "WLS, physical constraints", "rigid-lmi",
            {**AS_PUBLISHED, "weighted": True},
        ),
        Method("irls", "Method 3: three loops of IRLS", "rigid-irls", AS_PUBLISHED),
        Method("ridge", "ridge", "rigid-linear", {**AS_PUBLISHED, "method": "ridge"}),
        Method("tls", "total least squares", "rigid-linear", {**AS_PUBLISHED, "method": "tls"}),
        Method("diffnea", "differentiable Newton–Euler", "rigid-diffnea"),
        Method("hysteresis", "ours: friction with memory", "rigid-hysteresis", memory=True),
    )
}  # fmt: skip

METHOD_KEYS = tuple(METHODS)


def missing(method: Method) -> bool:
    """Return whether the estimator of a method is not installed."""
    return method.estimator not in plugins.names(GROUP)


def unfitted(method: Method, sign_width: float, filters: FilterSettings) -> RobotEstimator:
    """Return an unfitted estimator for a method, with the parameters that all methods share.

    Raises:
        PluginError, SpecError: The estimator does not exist, or rejects one of its parameters.
    """
    shared: dict[str, Any] = {"filters": filters}
    if not method.memory:
        shared["sign_width"] = sign_width
    return estimator(method.estimator, **method.params, **shared)


SHOWN = 250
"""Number of samples of the first test trajectory in a figure, evenly spaced over the trajectory."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Prediction errors of one fit per joint [N·m]; NaN if a joint has no test samples.

    Attributes:
        filtered, raw: (n,) RMSE relative to the filtered effort and to the unfiltered measured
            effort.
        moving, reversal: (n,) RMSE relative to the filtered effort, in samples with a moving joint
            and in samples near reversals.
        percent: (n,) largest error divided by the largest torque (MEP) [%], relative to the
            filtered effort.
        training: (n,) RMSE on the training samples, relative to the filtered effort.
        seconds: CPU time of the fit [s].
        condition: Condition number of the column-scaled regressor; NaN if the method has no
            regressor.
        parameters: Number of fitted parameters; 0 if the estimator does not report the number.
        uncertain: Share of the parameters that differ from 0 by less than two standard errors; NaN
            if the method has no standard errors.
        shown: (·, n) predicted torque in the rows `shown_rows`, for a figure.
        failed: Reason why the fit failed; empty if the fit succeeded.
    """

    filtered: FloatArray
    raw: FloatArray
    moving: FloatArray
    reversal: FloatArray
    percent: FloatArray
    training: FloatArray
    seconds: float = 0.0
    condition: float = float("nan")
    parameters: int = 0
    uncertain: float = float("nan")
    shown: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    failed: str = ""


def fit_and_score(
    method: Method, parts: Parts, robot: RobotModel, sign_width: float, filters: FilterSettings
) -> Score:
    """Fit a method to the training data and evaluate the model on the test data.

    An error of the fit is returned in `Score.failed` instead of being raised.
    """
    begin = time.process_time()
    try:
        model = unfitted(method, sign_width, filters).fit(parts.train, robot)
        return score(model, parts, time.process_time() - begin)
    except HilError as error:
        return _nothing(robot.n, error.message)
    # Estimators are plug-ins: an unexpected error of one must not discard the results of others.
    except Exception as error:
        return _nothing(robot.n, f"it failed with {type(error).__name__}: {error}")


def _nothing(n: int, failed: str) -> Score:
    empty = np.full(n, np.nan)
    return Score(empty, empty, empty, empty, empty, empty, failed=failed)


def score(model: RobotEstimator, parts: Parts, seconds: float = 0.0) -> Score:
    """Return the prediction errors of a fitted model on the test data.

    Args:
        model: Model fitted to the training data.
        parts: Training, validation and test data with the columns `MOVING` and `REVERSAL`.
        seconds: CPU time of the fit [s].
    """
    test, scale = parts.test, model.torque_scale_
    predicted = model.predict(test)
    torque = np.where(predicted.valid, predicted.effort, np.nan) * scale
    filtered, raw = test["effort_f"] * scale, test["effort"] * scale
    known = np.isfinite(torque)
    trained = model.predict(parts.train).effort * scale
    return Score(
        filtered=rmse_where(filtered, torque, known),
        raw=rmse_where(raw, torque, known),
        moving=rmse_where(filtered, torque, known & (test[MOVING] > 0)),
        reversal=rmse_where(filtered, torque, known & (test[REVERSAL] > 0)),
        percent=percent_where(filtered, torque, known),
        training=rmse(parts.train["effort_f"] * scale, trained),
        seconds=seconds,
        condition=float(getattr(model, "condition_", np.nan)),
        parameters=len(getattr(model, "parameter_names_", ())),
        uncertain=_uncertain(model),
        shown=torque[shown_rows(test)],
    )


def _uncertain(model: RobotEstimator) -> float:
    error = np.asarray(getattr(model, "std_error_", ()), dtype=np.float64)
    values = np.asarray(getattr(model, "coefficients_", ()), dtype=np.float64)
    told = np.isfinite(error) if error.shape == values.shape else np.zeros(0, dtype=bool)
    if not np.any(told):
        return float("nan")
    return float(np.mean(np.abs(values[told]) < 2.0 * error[told]))


def rmse_where(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
    """Return the (n,) RMSE of every joint over the rows that the mask `where` (N, n) selects.

    The RMSE of a joint without selected rows is NaN.
    """
    found = [
        rmse(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def percent_where(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
    """Return the (n,) largest error over largest torque (MEP) [%] in the rows of `where` (N, n).

    The MEP of a joint without selected rows is NaN.
    """
    found = [
        mep(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def shown_rows(test: Dataset) -> IntArray:
    """Return the numbers of the rows that a figure shows."""
    end = int(test.offsets[1])
    return np.unique(np.linspace(0, end - 1, min(SHOWN, end)).astype(np.int64))


PROTOCOLS: Mapping[str, Callable[[Trajectories, int], Parts]] = {
    "paper": paper_parts,
    "honest": honest_parts,
}

COLUMNS = ("t", "q", "qd", "qdd", "effort", "temperature")
"""Names of the recorded columns that estimators may use.

Only these recorded columns and the columns added by the study are copied to other processes.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Results of one protocol; all methods of a protocol use the same splits.

    Attributes:
        protocol: Name of the protocol.
        scores: Scores by method key, one score per split; a method that failed in any split is
            omitted.
        failed: Reasons why methods failed, by method key.
        t, measured: (rows,) time and (rows, n) measured torque in the first split, for comparison
            with `Score.shown`.
        noise: (n,) RMS [N·m] of the part of the measured effort that the filter removes.
    """

    protocol: str
    scores: Mapping[str, Sequence[Score]]
    failed: Mapping[str, str]
    t: FloatArray
    measured: FloatArray
    noise: FloatArray

    def mean(self, key: str, measure: str) -> FloatArray:
        """Return the (n,) mean of a measure over all splits."""
        return np.asarray(np.mean(self._all(key, measure), axis=0))

    def spread(self, key: str, measure: str) -> float:
        """Return the standard deviation over the splits of the joint mean; NaN for one split."""
        means = np.mean(self._all(key, measure), axis=1)
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def average(self, key: str, measure: str) -> float:
        """Return the mean of a measure over joints and splits; NaN if a joint has no value."""
        return float(np.mean(self.mean(key, measure)))

    def _all(self, key: str, measure: str) -> FloatArray:
        return np.stack([getattr(score, measure) for score in self.scores[key]])


class Protocol:
    """Data splits and fits of one protocol.

    Args:
        name: Name of the protocol, a key of `PROTOCOLS`.
        trajectories: Trajectories of the run.
        robot: Model of the arm.
        methods: Methods that the protocol compares.
        seeds: Random seeds, one per split.
        sign_width: Width of the smoothed sign function [rad/s], equal for all methods that use this
            function.
    """

    def __init__(
        self,
        name: str,
        trajectories: Trajectories,
        robot: RobotModel,
        methods: Sequence[Method],
        seeds: Sequence[int],
        sign_width: float,
    ) -> None:
        self.name = name
        self._robot, self._sign_width = robot, sign_width
        self._scale = trajectories.scale
        torn = name == "paper"
        self._methods = tuple(method for method in methods if not (torn and method.memory))
        # Randomly drawn samples are not equidistant and therefore cannot be downsampled again.
        once = {"every": 1} if torn else {}
        self._filters = trajectories.filters.model_copy(update=once)
        lighter = replace(
            trajectories, data=light(trajectories.data), thinned=light(trajectories.thinned)
        )
        self._splits = [PROTOCOLS[name](lighter, seed) for seed in seeds]

    def tasks(self) -> list[Task]:
        """Return one task per fit, in the order in which `gather` reads the results."""
        return [
            Task(
                partial(fit_and_score, method, parts, self._robot, self._sign_width, self._filters),
                name=f"{method.key}, {self.name}, draw {number}",
                failed=_failed,
            )
            for method in self._methods
            for number, parts in enumerate(self._splits, start=1)
        ]

    def gather(self, results: Iterator[Score]) -> Found:
        """Collect the results of the tasks of `tasks` from the front of the iterator `results`."""
        scores: dict[str, list[Score]] = {}
        failed: dict[str, str] = {}
        for method in self._methods:
            found = [next(results) for _ in self._splits]
            reason = next((score.failed for score in found if score.failed), "")
            if reason:
                failed[method.key] = reason
            else:
                scores[method.key] = found
        test, scale = self._splits[0].test, self._scale
        noise = np.sqrt(np.mean((test["effort"] - test["effort_f"]) ** 2, axis=0)) * scale
        rows = shown_rows(test)
        shown = test["effort_f"][rows] * scale
        return Found(self.name, scores, failed, test["t"][rows], shown, noise)


def _failed(score: Score) -> str:
    """Return the failure text of a score for a progress report (`Ended.failed`)."""
    return "failed" if score.failed else ""


def light(data: Dataset) -> Dataset:
    """Return the data with only those columns that estimators may use."""
    kept = [
        name
        for name in data.columns
        if name in COLUMNS or name.endswith("_f") or name.startswith("joint_")
    ]
    return replace(data, columns={name: data[name] for name in kept})
