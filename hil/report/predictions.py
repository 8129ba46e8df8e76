"""What a model predicts of held-out data, as a page draws it.

`held_out_of` selects the series a model was judged on, `predict_with` predicts them. Dwells are
averaged: their rows are repeats of one measurement. Trajectories keep their rows. Friction is shown
apart: the measured effort less everything the model attributes to something else, beside the
friction of the model. It is in N·m where the model knows the drive gains.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.core import BoolArray, DataError, FloatArray, IntArray
from hil.data import (
    Conditions,
    Dataset,
    FilterSettings,
    Model,
    Prediction,
    derivative,
    is_prepared,
    prepare,
    series_means,
)
from hil.estimators import FrictionCurve, HasFrictionCurve, RobotEstimator, load_model_file
from hil.report.documents import as_names
from hil.report.fit_facts import HONEST, FitFacts

if TYPE_CHECKING:
    from hil.evaluation import Judged


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """What can be drawn of one model on one held-out dataset; every part may be missing."""

    dwells: DwellPredictions | None
    motions: MotionPredictions | None
    friction: Friction | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DwellPredictions:
    """Means over each held-out dwell.

    Attributes:
        t: (D,) when [s].
        q: (D, n) where [rad].
        measured, predicted: (D, n) mean effort.
        approach: (D,) +1 approached from below, −1 from above, 0 unknown.
        pose, load: (D,) pose numbers; indices of the loads.
    """

    t: FloatArray
    q: FloatArray
    measured: FloatArray
    predicted: FloatArray
    approach: IntArray
    pose: IntArray
    load: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class MotionPredictions:
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
class Friction:
    """What is known of a model's friction; either part may be missing.

    Attributes:
        unit: `N·m`, or `A` if the drive gains are unknown.
        at_rest, in_motion: In that unit.
    """

    unit: str
    at_rest: FrictionAtRest | None = None
    in_motion: FrictionInMotion | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrictionAtRest:
    """Friction of held-out dwells: means over the rows the model is valid in, NaN without any.

    Attributes:
        q: (D, n) where [rad].
        measured: (D, n) mean effort less the model's gravity, offset and load.
        predicted: (D, n) friction of the model, with what its network adds; None where it knows
            none at rest.
        approach: (D,) +1 approached from below, −1 from above, 0 unknown.
        pose: (D,) pose numbers.
    """

    q: FloatArray
    measured: FloatArray
    predicted: FloatArray | None
    approach: IntArray
    pose: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class FrictionInMotion:
    """Friction along held-out trajectories, rows the model calls valid.

    Attributes:
        qd: (N, n) [rad/s].
        measured: (N, n) effort less the model's gravity, inertia and load.
        predicted: (N, n) friction of the model, with what its network adds.
        law_qd: (M, n) velocities of the curve, rising over those of the data [rad/s].
        curve: The same at these velocities; None, as `law_qd`, where the model gives none.
        learned: Whether a network adds something.
    """

    qd: FloatArray
    measured: FloatArray
    predicted: FloatArray
    law_qd: FloatArray | None
    curve: FrictionCurve | None
    learned: bool = False


def held_out_of(fit: FitFacts, data: Dataset) -> Dataset:
    """The series of a run that a model was judged on, as its `evaluation.json` names them.

    Ids begin with the name the run directory had then; it may have been renamed since.

    Raises:
        DataError: It was judged on another recording, or names no series that are in this one.
    """
    recorded = {Path(condition.source).name for condition in data.conditions}
    if fit.source and Path(fit.source).name not in recorded:
        raise DataError(
            f"it was judged on {fit.source}, not on this recording",
            hint="plots of other recordings: hil fit SOURCE --validate OTHER_RUN --report PAGE",
        )
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


def predict_with_file(folder: Path, data: Dataset, judged: Judged | None = None) -> Predictions:
    """Predict held-out data with a saved model; predictions in `judged` are reused.

    Raises:
        HilError: The model cannot be loaded, or does not fit the data.
    """
    from hil.evaluation import usable_part

    model = load_model_file(folder)
    return predict_with(model, usable_part(data, model), judged)


def predict_with(model: Model, data: Dataset, judged: Judged | None = None) -> Predictions:
    """Predict held-out data with a model; whatever is no dwell counts as a trajectory."""
    held, moved = (
        _within_limit(data.of_kind("dwell")),
        _within_limit(data.of_kind("trajectory", "move")),
    )
    _, unit = _scale_of(model)
    dwells = motions = None
    friction = Friction(unit)
    if held.conditions:
        prediction = judged.predict(model, held) if judged else model.predict(held)
        dwells = _dwells(held, prediction)
        friction = replace(friction, at_rest=_at_rest(model, held, prediction))
    if moved.conditions:
        prediction = judged.predict(model, moved) if judged else model.predict(moved)
        motions = _motions(moved, prediction, _velocity(model, moved))
        friction = replace(friction, in_motion=_in_motion(model, moved, prediction, motions.qd))
    return Predictions(dwells, motions, friction)


MOST_ROWS = 60_000
"""More rows than this are not predicted for a plot; whole series are left out."""


def _within_limit(data: Dataset) -> Dataset:
    """Whole series, evenly spread over the dataset, of together at most `MOST_ROWS` rows."""
    lengths = np.diff(data.offsets)
    usable = [i for i, length in enumerate(lengths) if length > 0]
    total = int(lengths.sum())
    every = max(1, -(-total // MOST_ROWS))
    chosen = {id(data.conditions[i]) for i in usable[::every]}
    return data.select(lambda condition: id(condition) in chosen)


def _dwells(data: Dataset, prediction: Prediction) -> DwellPredictions:
    return DwellPredictions(
        t=data["t"][data.offsets[:-1]],
        q=series_means(data, data["q"]),
        measured=series_means(data, data["effort"]),
        predicted=series_means(data, prediction.effort),
        approach=_of_conditions(data, "approach"),
        pose=_of_conditions(data, "pose"),
        load=_of_conditions(data, "load"),
    )


def _of_conditions(data: Dataset, name: str) -> IntArray:
    """(D,) a number of each series."""
    return np.array([getattr(each, name) for each in data.conditions], dtype=np.int64)


def _motions(data: Dataset, prediction: Prediction, qd: FloatArray) -> MotionPredictions:
    predicted = np.where(prediction.valid, prediction.effort, np.nan)
    measured = data["effort"]
    spans = list(data.slices())
    errors = [_relative_error(measured[rows], predicted[rows], measured) for _, rows in spans]
    worst, rows = spans[int(np.argmax(errors))]
    t = data["t"][rows]
    return MotionPredictions(
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
    """Return the RMSE relative to the deviation of each joint over valid samples; −1 if none."""
    good = np.isfinite(predicted)
    if not good.any():
        return -1.0
    scale = np.maximum(all_measured.std(axis=0), 1e-12)
    error = (measured - predicted) / scale
    return float(np.sqrt(np.mean(error**2, where=good)))


def _velocity(model: Model, data: Dataset) -> FloatArray:
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


FRICTION, RESIDUAL = "friction", "residual"
"""Components of a prediction that count as friction. The residual network's output is included
because it mostly corrects friction; subtracting it would hide that."""


def _scale_of(model: Model) -> tuple[FloatArray, str]:
    """What turns efforts of a model into its friction's unit, (n,) or (1,), and that unit."""
    if isinstance(model, RobotEstimator) and model.knows_gains:
        return model.torque_scale_, "N·m"
    return np.ones(1), "A"


def _at_rest(model: Model, data: Dataset, prediction: Prediction) -> FrictionAtRest | None:
    """Friction of dwells; None when no approach is known, or the target was among the inputs.

    None, too, where the model is valid nowhere.
    """
    approach = _of_conditions(data, "approach")
    if not approach.any() or getattr(model, "protocol", HONEST) != HONEST:
        return None
    if not prediction.valid.any():
        return None
    scale, _ = _scale_of(model)
    friction = _model_friction(prediction)
    knows = FRICTION in prediction.components
    return FrictionAtRest(
        q=series_means(data, data["q"]),
        measured=_means(data, data["effort"] - prediction.effort + friction, prediction.valid)
        * scale,
        predicted=_means(data, friction, prediction.valid) * scale if knows else None,
        approach=approach,
        pose=_of_conditions(data, "pose"),
    )


def _model_friction(prediction: Prediction) -> FloatArray:
    """(N, n) what may be friction, in the unit of the effort; 0 where the model has none."""
    parts = [
        prediction.components[name]
        for name in (FRICTION, RESIDUAL)
        if name in prediction.components
    ]
    friction: FloatArray = np.sum([np.zeros_like(prediction.effort), *parts], axis=0)
    return friction


def _means(data: Dataset, values: FloatArray, valid: BoolArray) -> FloatArray:
    """(D, n) mean of values (N, n) over the valid rows of each dwell; NaN without any."""
    share = series_means(data, valid.astype(np.float64))
    sums = series_means(data, np.where(valid, values, 0.0))
    return np.divide(sums, share, out=np.full_like(sums, np.nan), where=share > 0)


def _in_motion(
    model: Model, data: Dataset, prediction: Prediction, qd: FloatArray
) -> FrictionInMotion | None:
    """Friction along trajectories; None when the model has none, or is for arms at rest."""
    friction = prediction.components.get(FRICTION)
    if friction is None or getattr(model, "protocol", HONEST) != HONEST:
        return None
    modelled = _model_friction(prediction)
    known = prediction.valid & np.isfinite(modelled)
    if not (known & (np.abs(friction) > 0)).any():
        return None
    learned = bool(np.any(known & (modelled != friction)))
    scale, _ = _scale_of(model)
    measured = data["effort"] - prediction.effort + modelled
    predicted = np.where(known, modelled * scale, np.nan)
    law_qd, curve = (None, None) if learned else _law(model, np.where(known, qd, np.nan))
    measured = np.where(known, measured * scale, np.nan)
    return FrictionInMotion(qd, measured, predicted, law_qd, curve, learned)


NEAR_ZERO = 0.05
"""Up to this speed [rad/s] curves are drawn finely: friction turns there."""


def _law(model: Model, qd: FloatArray) -> tuple[FloatArray, FrictionCurve] | tuple[None, None]:
    """Return velocities (M, n) over those of the data, and the model's friction at them."""
    if not isinstance(model, HasFrictionCurve):
        return None, None
    good = np.isfinite(qd)
    low = np.min(qd, axis=0, where=good, initial=np.inf)
    high = np.max(qd, axis=0, where=good, initial=-np.inf)
    low, high = (np.where(good.any(axis=0), edge, np.nan) for edge in (low, high))
    places = np.linspace(low, high, 161)
    near = np.linspace(-NEAR_ZERO, NEAR_ZERO, 41)[:, None] + np.zeros(qd.shape[1])
    places = np.sort(np.vstack([places, np.clip(near, low, high)]), axis=0)
    curve = model.friction_curve(places)
    return (None, None) if curve is None else (places, curve)
