"""Fits of a study of inverse dynamics, what each of them comes to, and the ranking of methods.

`family_task` fits a model and whatever corrects it, in one task, so that the model is fitted once.
`judged` reduces a fitted model to what tables and figures need, small enough to be sent back from
another process. `Found` holds that of every row and seed under one protocol.

Two methods are put in order only if they are `apart`. Draws of the split and of the networks are
paired: both methods have the same ones. Two methods of equal error, with differences that are
normal and independent from draw to draw, would be ranked all the same in 21 % of all studies with
two draws, in 7.4 % with three and in 1.1 % with five (Student's t with one degree of freedom less,
beyond `APART`·√draws).
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
"""How long fits take compared with the others: the longest begin first."""


def family_task(
    root: str, keys: Sequence[str], case: Case, robot: RobotModel, sign_width: float, effort: float
) -> Task:
    """Fit the model `root` and whatever corrects it; the result is a `Judged` by key of `keys`."""
    cost = sum(COSTS.get(ROWS[key].estimator, 1.0) for key in {root, *keys})
    name = f"{ROWS[root].estimator} ({', '.join(keys)}), {case.protocol}, seed {case.seed}"
    run = partial(fit_family, root, tuple(keys), case, robot, sign_width, effort)
    return Task(run, cost, name, _what_failed)


def _what_failed(found: Mapping[str, Judged]) -> str:
    """What of a family failed, as `Ended` tells it."""
    failed = [key for key, one in found.items() if one.failed]
    if len(failed) == len(found):
        return "failed"
    return f"without {', '.join(failed)}, which failed" if failed else ""


def fit_family(
    root: str, keys: Sequence[str], case: Case, robot: RobotModel, sign_width: float, effort: float
) -> dict[str, Judged]:
    """As `family_task` says; a failure is told, not raised, except that of a dishonest case.

    Raises:
        DataError: Judged rows are among those to learn from.
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
"""Key of a row, its model or None, CPU seconds with those of the model it corrects, and why."""


def fitted_family(
    root: str, keys: Sequence[str], new: New, learn: Dataset, robot: RobotModel
) -> Iterator[Fitted]:
    """The model `root`, and whatever corrects it; a failure is told, not raised.

    Args:
        root: Key of `ROWS` with a model of its own.
        keys: Wanted, of those that need it.
        new: Makes an unfitted estimator by its key.
        learn: To fit to.
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
    """What is fitted or None, CPU seconds, and why there is nothing."""
    begin = time.process_time()
    model, failed = _tried(fit)
    return model, time.process_time() - begin, failed


def _tried(make: Callable[[], Any]) -> tuple[Any, str]:
    """What is made, or None and why."""
    try:
        return make(), ""
    except HilError as error:
        return None, error.message
    # Estimators are plug-ins: one that breaks down must not cost what the others took.
    except Exception as error:
        return None, f"it broke down: {type(error).__name__}: {error}"


CLOUD = 400
"""Judged samples whose friction a figure shows, spread evenly over all of them."""

F_CUT_HZ = 2.0
"""Between low and high frequency of a residual, where the model does not say (eq. 24)."""

ORDER = 5


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One fit of one row, per joint in N·m; NaN where there is nothing to judge.

    Attributes:
        filtered, raw: (n,) RMSE against the filtered and the measured effort.
        moving: (n,) RMSE against the filtered one in motion.
        percent: (n,) largest error over largest torque (MEP).
        within: (n,) share [%] of measured torques within 1.645 standard deviations of the model.
        known: Share of the judged rows that the model predicts.
        seconds: CPU time of the fit, with that of the model it corrects.
        aware, unaware: By number of the load, (n,) RMSE with the load known and forgotten.
        curves: By name, (epochs,) losses of a training.
        decided: (n,) of a residual network: per joint the error without → with it on rows it was
            not fitted to, by how much that is more, and whether it was dropped.
        failed: Why there is nothing else.
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
    """What figures show, in N·m.

    Attributes:
        torque: (rows, n) on the first judged trajectory.
        friction, rigid: (cloud, n) over all judged samples; empty without friction of its own.
        residual: (2, rows, n) low and high frequency of the correction; empty without one.
        left: (2, rows, n) of what the model without the correction leaves.
    """

    torque: FloatArray
    friction: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    rigid: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    residual: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))
    left: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0)))


def judged(model: RobotEstimator, case: Case, seconds: float) -> Judged:
    """How a fitted model does.

    Raises:
        DataError: It cannot predict these data.
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
    """(N, n) effort; NaN where the model does not vouch for it."""
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
    """(2, rows, n) of a signal (N, n) on the first trajectory, below and above `F_CUT_HZ`."""
    end = int(case.judge.offsets[1])
    first = np.nan_to_num(values[:end])
    fraction = nyquist_fraction(F_CUT_HZ, "hz", sample_rate(case.judge["t"][:end]))
    low = zero_phase(first, fraction, ORDER)
    return np.stack([low[rows], (first - low)[rows]])


def nothing(n: int, failed: str) -> Judged:
    """Of a fit that failed."""
    empty = np.full(n, np.nan)
    return Judged(empty, empty, empty, empty, empty, failed=failed)


def shown_rows(case: Case) -> IntArray:
    """Numbers of the rows that figures over time show: of the first judged trajectory."""
    return evenly(np.flatnonzero(case.rows[: case.judge.offsets[1]]), SHOWN)


def cloud_rows(case: Case) -> IntArray:
    """Numbers of the rows whose friction figures show."""
    return evenly(np.flatnonzero(case.rows), CLOUD)


def evenly(numbers: IntArray, most: int) -> IntArray:
    """At most so many of the numbers, the first and the last among them."""
    ends = np.linspace(0, len(numbers) - 1, min(most, len(numbers)))
    return np.asarray(numbers[np.unique(ends.astype(np.int64))])


APART = 2.0
"""Standard deviations over the seeds by which paired errors must differ for a ranking."""

FEWEST_SEEDS = 3
"""Fewer draws rank nothing."""


def apart(found: Found, a: str, b: str) -> bool:
    """Whether a and b differ by more than two seed-σ of their paired differences."""
    difference = found.by_seed(a) - found.by_seed(b)
    if len(difference) < FEWEST_SEEDS:
        return False
    return abs(float(np.mean(difference))) > APART * float(np.std(difference, ddof=1))


def doubt(found: Found) -> str:
    """Why what is not apart is not told apart."""
    seeds = len(found.seen)
    if seeds >= FEWEST_SEEDS:
        return "they differ by less than two seed-σ"
    return "one draw ranks nothing" if seeds == 1 else f"{seeds} draws rank nothing"


def beside(found: Found, key: str, reference: str, name: str) -> str:
    """How much less key leaves than the reference, and whether that can be told from chance.

    Args:
        found: What came of a protocol.
        key: Of a row.
        reference: Of another one.
        name: Of the reference, for people.
    """
    error, against = found.average(key), found.average(reference)
    if error == against:
        return f"the same as {name}"
    told = f"{_less(error, against)} than {name}"
    return told if apart(found, key, reference) else f"{told} (not told apart: {doubt(found)})"


def _less(error: float, reference: float) -> str:
    percent = 100 * (1 - error / reference)
    size = f"{abs(percent):.0f} %" if abs(percent) >= 0.5 else "under half a per cent"
    return f"{size} {'less' if percent >= 0 else 'more'}"


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What a case has to show beside any model, in N·m.

    Attributes:
        t, measured: (rows,), (rows, n) of the first judged trajectory, filtered.
        speeds, cloud: (cloud, n) velocity [rad/s] and filtered torque over all judged rows.
        removed: (n,) RMS of what the filter takes out of the measured torque.
        noise: (n,) RMS of the noise that it leaves, if the noise is white.
        persistence: By latency [s], of repeating the newest torque that is so old at least.
        rate_hz: Samples per second, as recorded: the median over the judged trajectories.
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
        """Of one case."""
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
            # Never refused: samples may be missing in one trajectory, and this is only shown.
            float(np.median([rate for rate, _ in motion_rates(data)])),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """One protocol: the same cases for every method.

    Attributes:
        protocol: Its name.
        scores: By key of the row, one per seed; rows that failed in any are left out.
        failed: By key of the row, why.
        seen: One per seed.
        loads: Name of every load but the first by its number.
    """

    protocol: str
    scores: Mapping[str, Sequence[Judged]]
    failed: Mapping[str, str]
    seen: Sequence[Seen]
    loads: Mapping[int, str]

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.seen[0].noise)

    def words(self, key: str) -> str:
        """What a row is called, with the latency that it has at the rate of these data."""
        return ROWS[key].words_at(self.seen[0].rate_hz)

    def mean(self, key: str, measure: str) -> FloatArray:
        """(n,) mean over the seeds."""
        return np.asarray(np.mean([getattr(s, measure) for s in self.scores[key]], axis=0))

    def by_seed(self, key: str, measure: str = "filtered") -> FloatArray:
        """(seeds,) mean over the joints."""
        return np.array([float(np.mean(getattr(s, measure))) for s in self.scores[key]])

    def spread(self, key: str, measure: str) -> float:
        """Standard deviation over the seeds of the mean over the joints; NaN with one seed."""
        means = self.by_seed(key, measure)
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def average(self, key: str, measure: str = "filtered") -> float:
        """Mean over joints and seeds."""
        return float(np.mean(self.by_seed(key, measure)))

    def beside(self, what: str) -> FloatArray:
        """(seeds, n) of an attribute of `Seen` that is (n,)."""
        return np.stack([getattr(seen, what) for seen in self.seen])

    def persistence(self, latency_s: float) -> Held:
        """Repeated torque, in the mean over the seeds."""
        every = [seen.persistence[latency_s] for seen in self.seen]
        error = np.mean([one.error for one in every], axis=0)
        return Held(float(np.mean([one.age_s for one in every])), error)


def gathered(
    protocol: str,
    results: Iterable[tuple[Sequence[str], Sequence[Mapping[str, Judged]]]],
    seen: Sequence[Seen],
    loads: Mapping[int, str],
) -> Found:
    """All families of one protocol.

    Args:
        protocol: Its name.
        results: Per family its rows, and what came of them, once per seed.
        seen: One per seed.
        loads: Names of the loads.
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
