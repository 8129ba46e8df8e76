"""Methods of a study of dynamic identification, the motions they are fitted to, and their errors.

`trajectories_of` filters the trajectories of a run once. A protocol splits them: by single samples
as in the PINN paper, section IV, or by whole trajectories. `Protocol` lists one fit per method and
split (`fit_and_score`) and gathers their `Score`s into `Found`.
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
"""Trajectories to fit on, for methods that choose something, and to judge on."""

SHARES = (0.6, 0.2, 0.2)
"""Of the samples, to train, validate and test on: the PINN paper, section IV."""

OF_TWELVE = (7, 2, 3)
"""Trajectories to train, validate and test on, the same shares in whole trajectories."""

MOVING_RAD_S = 0.05
"""A joint that is faster is away from its reversals."""

REVERSAL_S = 0.05
"""A sample so close to a change of a joint's direction belongs to that reversal."""

MOVING, REVERSAL = "joint_moving", "joint_reversal"
"""Columns (N, n), 1 where a joint does so and 0 elsewhere: they survive any split."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """A run as a study of dynamics sees it.

    Attributes:
        data: Filtered, with the columns `MOVING` and `REVERSAL`.
        thinned: Its rows that are kept.
        filters: As it was filtered and thinned, for estimators.
        scale: (n,) torque per unit of effort.
        notes: What is not as in the paper.
    """

    data: Dataset
    thinned: Dataset
    filters: FilterSettings
    scale: FloatArray
    notes: tuple[str, ...]


def trajectories_of(
    whole: Dataset, robot: RobotModel, cutoff_hz: float, rate_hz: float
) -> Trajectories:
    """The trajectories of a run, filtered at their own rate before samples are left out.

    Args:
        whole: The run.
        robot: Model of its arm.
        cutoff_hz: Of the fifth-order Butterworth filter, forwards and backwards.
        rate_hz: Samples kept per second, as nearly as whole steps allow.

    Raises:
        FitError: There are too few trajectories, or the robot is another.
        DataError: The cut-off is too high for the recorded rate, or for the samples kept.
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
    """The highest cut-off [Hz] that `trajectories_of` takes for these trajectories, to a tenth."""
    recorded = sample_rate(data["t"][slice(*data.offsets[:2])])
    every = max(1, round(recorded / rate_hz))
    return _floor(0.5 * MAX_NYQUIST_FRACTION * recorded / every)


def _require_below(cutoff_hz: float, recorded_hz: float, every: int) -> None:
    """Refuse a cut-off that filter or thinning would, but as the parameter of the study."""
    kept, highest = (_floor(0.5 * MAX_NYQUIST_FRACTION * recorded_hz / n) for n in (every, 1))
    if cutoff_hz <= kept * (1 + CLOCK):
        return
    thinned = f", of which rate_hz keeps {recorded_hz / every:.4g} a second" if every > 1 else ""
    more = f", or up to {highest:g} Hz with a higher rate_hz" if every > 1 else ""
    raise DataError(
        f"cutoff_hz is {cutoff_hz:g} Hz: too high for data recorded at "
        f"{recorded_hz:.4g} Hz{thinned}",
        hint=f"choose at most {kept:g} Hz{more}",
    )


def _floor(hz: float) -> float:
    """To a tenth that may be asked for; rates out of time stamps are off in the last digits."""
    return math.floor(10.0 * hz * (1.0 + 1e-9)) / 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """What one split gives: to fit on, left for choices, and to judge on."""

    train: Dataset
    validation: Dataset
    test: Dataset


def paper_parts(of: Trajectories, seed: int) -> Parts:
    """60/20/20 % of the samples kept, drawn one by one: neighbours in time land on all sides."""
    return Parts(*paper_sample_split(of.thinned, SHARES, seed))


def honest_parts(of: Trajectories, seed: int) -> Parts:
    """The same shares of whole trajectories: 7, 2 and 3 of twelve; fits leave rows out."""
    outer = held_out(of, seed)
    chosen_by = max(1, round(OF_TWELVE[1] * _twelfths(of)))
    inner = split(outer.train, "trajectory", chosen_by, seed)
    return Parts(inner.train, inner.test, outer.test)


def held_out(of: Trajectories, seed: int) -> Split:
    """Whole trajectories to judge on, 3 of twelve, and the others."""
    return split(of.data, "trajectory", max(1, round(OF_TWELVE[2] * _twelfths(of))), seed)


def _twelfths(of: Trajectories) -> float:
    return len(groups(of.data, "trajectory")) / sum(OF_TWELVE)


def marked(data: Dataset) -> Dataset:
    """With the columns that say where each joint moves and where it turns round."""
    moving = np.abs(data["qd_f"]) > MOVING_RAD_S
    reversal = np.zeros_like(moving)
    for start, stop in pairwise(data.offsets.tolist()):
        rows = slice(start, stop)
        reversal[rows] = near_reversals(data["t"][rows], data["qd_f"][rows])
    flags = {MOVING: moving, REVERSAL: reversal}
    return data.with_columns(**{name: flag.astype(np.float64) for name, flag in flags.items()})


def near_reversals(t: FloatArray, qd: FloatArray) -> BoolArray:
    """(N, n) where a joint changes direction within `REVERSAL_S`.

    Args:
        t: (N,) increasing [s].
        qd: (N, n) filtered velocity.
    """
    found = np.zeros(qd.shape, dtype=bool)
    for j in range(qd.shape[1]):
        moves = np.flatnonzero(qd[:, j])  # a standstill on the way is part of the reversal
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
    """A way to predict joint torques.

    Attributes:
        key: In the spec.
        words: In tables.
        estimator: Name it is registered under.
        params: Of the estimator, beside those all share.
        memory: Whether its friction follows the path: it needs whole motions and no smooth sign.
    """

    key: str
    words: str
    estimator: str
    params: Mapping[str, Any] = field(default_factory=dict)
    memory: bool = False


AS_PUBLISHED: Mapping[str, Any] = {"filter_columns": False}
"""Friction columns are those of the filtered velocity."""

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
    """Whether no distribution installed here has the estimator."""
    return method.estimator not in plugins.names(GROUP)


def unfitted(method: Method, sign_width: float, filters: FilterSettings) -> RobotEstimator:
    """The method's estimator with the parameters all share.

    Raises:
        PluginError, SpecError: There is no such estimator, or it takes other parameters.
    """
    shared: dict[str, Any] = {"filters": filters}
    if not method.memory:
        shared["sign_width"] = sign_width
    return estimator(method.estimator, **method.params, **shared)


SHOWN = 250
"""Samples a figure shows of the first test trajectory, spread evenly over it."""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """One fit of one method, in N·m, per joint; NaN where there is nothing to judge.

    Attributes:
        filtered, raw: (n,) RMSE against the filtered and the measured effort.
        moving, reversal: (n,) RMSE against the filtered one, in those samples only.
        percent: (n,) largest error over largest torque (MEP), filtered.
        training: (n,) RMSE on the training samples, filtered.
        seconds: CPU time of the fit.
        condition: Of the column-scaled regressor; NaN where the method has none.
        parameters: How many it fits, 0 where it does not say.
        uncertain: Share of parameters not told from 0 by two standard errors; NaN without errors.
        shown: (·, n) predicted torque at `shown_rows`, for a figure.
        failed: Why there is nothing; empty when there is.
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
    """Fit to the training part and judge on the test part; a failure is told, not raised."""
    begin = time.process_time()
    try:
        model = unfitted(method, sign_width, filters).fit(parts.train, robot)
        return score(model, parts, time.process_time() - begin)
    except HilError as error:
        return _nothing(robot.n, error.message)
    # Estimators are plug-ins: one that breaks down must not cost what the others took.
    except Exception as error:
        return _nothing(robot.n, f"it broke down: {type(error).__name__}: {error}")


def _nothing(n: int, failed: str) -> Score:
    empty = np.full(n, np.nan)
    return Score(empty, empty, empty, empty, empty, empty, failed=failed)


def score(model: RobotEstimator, parts: Parts, seconds: float = 0.0) -> Score:
    """How a fitted model does on the test part.

    Args:
        model: Fitted to the training part.
        parts: With the columns `MOVING` and `REVERSAL`.
        seconds: CPU time the fit took.
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
    """(n,) RMSE of every joint over its rows of `where` (N, n); NaN where it has none."""
    found = [
        rmse(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def percent_where(measured: FloatArray, predicted: FloatArray, where: BoolArray) -> FloatArray:
    """(n,) largest error over largest torque (MEP) of every joint over its rows of `where`."""
    found = [
        mep(measured[rows, j, None], predicted[rows, j, None]) for j, rows in enumerate(where.T)
    ]
    return np.concatenate(found)


def shown_rows(test: Dataset) -> IntArray:
    """Numbers of the rows that a figure shows."""
    end = int(test.offsets[1])
    return np.unique(np.linspace(0, end - 1, min(SHOWN, end)).astype(np.int64))


PROTOCOLS: Mapping[str, Callable[[Trajectories, int], Parts]] = {
    "paper": paper_parts,
    "honest": honest_parts,
}

COLUMNS = ("t", "q", "qd", "qdd", "effort", "temperature")
"""What estimators may ask for, beside what the study added: the rest does not travel."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One protocol: the same splits for every method.

    Attributes:
        protocol: Its name.
        scores: By key of the method, one per split; methods that failed in any are left out.
        failed: By key of the method, why.
        t, measured: (rows,), (rows, n) time and torque that `Score.shown` predicts, first split.
        noise: (n,) RMS of what the filter took out of the measured effort, in N·m.
    """

    protocol: str
    scores: Mapping[str, Sequence[Score]]
    failed: Mapping[str, str]
    t: FloatArray
    measured: FloatArray
    noise: FloatArray

    def mean(self, key: str, measure: str) -> FloatArray:
        """(n,) mean over the splits."""
        return np.asarray(np.mean(self._all(key, measure), axis=0))

    def spread(self, key: str, measure: str) -> float:
        """Standard deviation over the splits of the mean over the joints; NaN with one split."""
        means = np.mean(self._all(key, measure), axis=1)
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def average(self, key: str, measure: str) -> float:
        """Mean over joints and splits, NaN where a joint has none."""
        return float(np.mean(self.mean(key, measure)))

    def _all(self, key: str, measure: str) -> FloatArray:
        return np.stack([getattr(score, measure) for score in self.scores[key]])


class Protocol:
    """Prepares the fits of one protocol, and gathers what came of them.

    Args:
        name: Key of `PROTOCOLS`.
        trajectories: Of the run.
        robot: Model of the arm.
        methods: To compare.
        seeds: One split each.
        sign_width: Of the smooth sign, the same for every method that has one.
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
        # Torn samples cannot be thinned again: no filter knows how far apart they are.
        once = {"every": 1} if torn else {}
        self._filters = trajectories.filters.model_copy(update=once)
        lighter = replace(
            trajectories, data=light(trajectories.data), thinned=light(trajectories.thinned)
        )
        self._splits = [PROTOCOLS[name](lighter, seed) for seed in seeds]

    def tasks(self) -> list[Task]:
        """Every fit, in the order `gather` wants their results."""
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
        """The results of `tasks`, taken from the front of `results`."""
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
    """As `Ended` tells it."""
    return "failed" if score.failed else ""


def light(data: Dataset) -> Dataset:
    """With no more columns than estimators may ask for."""
    kept = [
        name
        for name in data.columns
        if name in COLUMNS or name.endswith("_f") or name.startswith("joint_")
    ]
    return replace(data, columns={name: data[name] for name in kept})
