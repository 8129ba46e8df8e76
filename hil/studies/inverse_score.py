"""What one fit of one row of Table II is judged by, small enough to be sent back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Dataset, Prediction, nyquist_fraction, sample_rate, zero_phase
from hil.estimators import RobotEstimator
from hil.networks import Curves
from hil.studies.dynamic_data import MOVING
from hil.studies.dynamic_methods import SHOWN, percent_where, rmse_where
from hil.studies.inverse_cases import Case, forgotten

CLOUD = 400
"""Judged samples whose friction a figure shows, spread evenly over all of them."""

F_CUT_HZ = 2.0
"""Between low and high frequency of a residual, where the model does not say (eq. 24)."""

ORDER = 5


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


def nothing(n: int, failed: str) -> Judged:
    """Of a fit that failed."""
    empty = np.full(n, np.nan)
    return Judged(empty, empty, empty, empty, empty, failed=failed)


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


def _within(error: FloatArray, deviation: FloatArray, known: BoolArray) -> FloatArray:
    inside = np.abs(error) <= 1.645 * deviation
    told = known & np.isfinite(deviation)
    counts = np.count_nonzero(told, axis=0)
    share = 100.0 * np.count_nonzero(inside & told, axis=0) / np.maximum(counts, 1)
    return np.where(counts > 0, share, np.nan)


def _told(predicted: Prediction) -> FloatArray:
    """(N, n) effort; NaN where the model does not vouch for it."""
    return np.where(predicted.valid, predicted.effort, np.nan)


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
