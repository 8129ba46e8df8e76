"""Model predictions of held-out data for the figures of a page.

The function `held_out_of` selects the series on which a model was evaluated; `predict_with`
predicts the effort of these series. The samples of a dwell are averaged, because all of them repeat
one measurement. The samples of trajectories are not averaged. Measured friction is the measured
effort minus all components of the model except friction. Figures compare the measured friction with
the friction of the model. The unit is N·m if the model knows the drive gains.
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
    """Predictions of one model for one hold-out set; a part without data is None."""

    dwells: DwellPredictions | None
    motions: MotionPredictions | None
    friction: Friction | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DwellPredictions:
    """Mean values over each held-out dwell.

    Attributes:
        t: (D,) start time of each dwell [s].
        q: (D, n) joint angles [rad].
        measured, predicted: (D, n) mean measured effort and mean predicted effort.
        approach: (D,) approach direction: +1 from below, −1 from above, 0 if unknown.
        pose, load: (D,) pose numbers and payload numbers.
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
    """Predictions in held-out trajectories; NaN for rows that the model marks as invalid.

    Attributes:
        worst: `Conditions` of the trajectory with the largest relative error.
        t, measured, predicted: Time (M,) and effort (M, n) of the trajectory with the largest
            relative error.
        q, qd, all_measured, all_predicted: Values (N, n) of all held-out trajectories.
        count: Number of held-out trajectories.
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
    """Measured friction and friction of a model; an attribute is None if unknown.

    Attributes:
        unit: Unit of friction: `N·m`, or `A` if the drive gains are unknown.
        at_rest, in_motion: Friction at standstill, and friction along trajectories, in `unit`.
    """

    unit: str
    at_rest: FrictionAtRest | None = None
    in_motion: FrictionInMotion | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrictionAtRest:
    """Friction in held-out dwells, as mean over the valid rows of each dwell.

    The friction is NaN for a dwell without valid rows.

    Attributes:
        q: (D, n) joint angles [rad].
        measured: (D, n) mean measured effort minus gravity, offset and payload effort of the model.
        predicted: (D, n) friction of the model, including the output of a residual network; None if
            the model has no static friction.
        approach: (D,) approach direction: +1 from below, −1 from above, 0 if unknown.
        pose: (D,) pose numbers.
    """

    q: FloatArray
    measured: FloatArray
    predicted: FloatArray | None
    approach: IntArray
    pose: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class FrictionInMotion:
    """Friction along held-out trajectories; NaN for rows that the model marks as invalid.

    Attributes:
        qd: (N, n) velocities [rad/s].
        measured: (N, n) measured effort minus gravity, inertia and payload effort of the model.
        predicted: (N, n) friction of the model, including the output of a residual network.
        law_qd: (M, n) increasing velocities of the friction curve, within the range of the data
            [rad/s]; None if the model has no friction curve.
        curve: Friction curve evaluated at the velocities `law_qd`; None if the model has no
            friction curve.
        learned: Whether a residual network contributes to the friction.
    """

    qd: FloatArray
    measured: FloatArray
    predicted: FloatArray
    law_qd: FloatArray | None
    curve: FrictionCurve | None
    learned: bool = False


def held_out_of(fit: FitFacts, data: Dataset) -> Dataset:
    """Return the series of a run on which a model was evaluated, as listed in `evaluation.json`.

    The ids of the series contain the former name of the run directory; therefore, only the part
    after the colon is compared.

    Raises:
        DataError: The model was evaluated on a different recording, or none of the series of the
            evaluation exist in this recording.
    """
    recorded = {Path(condition.source).name for condition in data.conditions}
    if fit.source and Path(fit.source).name not in recorded:
        raise DataError(
            f"the model was evaluated on {fit.source}, not on this recording",
            hint="plot other recordings: hil fit SOURCE --validate OTHER_RUN --report PAGE",
        )
    judged = {_within_run(str(name)) for name in as_names(fit.held_out.get("series"))}
    held_out = data.select(lambda condition: _within_run(condition.id) in judged)
    if not held_out.conditions:
        raise DataError(
            f"{fit.folder.name}/evaluation.json lists no held-out series of this recording",
            hint="fit and evaluate again: hil fit RUN --estimator NAME --validate OTHER_RUN",
        )
    return held_out


def _within_run(name: str) -> str:
    return name.rpartition(":")[2]


def predict_with_file(folder: Path, data: Dataset, judged: Judged | None = None) -> Predictions:
    """Predict the held-out data with a saved model; predictions in `judged` are reused.

    Raises:
        HilError: The model cannot be loaded, or cannot be applied to the held-out data.
    """
    from hil.evaluation import usable_part

    model = load_model_file(folder)
    return predict_with(model, usable_part(data, model), judged)


def predict_with(model: Model, data: Dataset, judged: Judged | None = None) -> Predictions:
    """Predict the held-out data with a model; moves count as trajectories."""
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
"""Maximum number of rows that are predicted for plots; if there are more, whole series are
omitted.
"""


def _within_limit(data: Dataset) -> Dataset:
    """Return whole series, selected evenly, with a total of at most about `MOST_ROWS` rows."""
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
    """Return the (D,) values of an integer attribute in the conditions of each series."""
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
    """Return the RMSE of all joints, relative to the standard deviation of each joint.

    The relative RMSE is −1 if no sample is valid.
    """
    good = np.isfinite(predicted)
    if not good.any():
        return -1.0
    scale = np.maximum(all_measured.std(axis=0), 1e-12)
    error = (measured - predicted) / scale
    return float(np.sqrt(np.mean(error**2, where=good)))


def _velocity(model: Model, data: Dataset) -> FloatArray:
    """Return (N, n) velocities [rad/s].

    The recorded velocities are preferred, then the filtered velocities used by the model, then the
    derivative of the position. The velocity is NaN for a series without velocities.
    """
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
"""Names of the prediction components that are part of the friction.

The output of a residual network is part of the friction, because the network mainly corrects the
friction.
"""


def _scale_of(model: Model) -> tuple[FloatArray, str]:
    """Return the (n,) or (1,) factor from effort to the unit of friction, and this unit."""
    if isinstance(model, RobotEstimator) and model.knows_gains:
        return model.torque_scale_, "N·m"
    return np.ones(1), "A"


def _at_rest(model: Model, data: Dataset, prediction: Prediction) -> FrictionAtRest | None:
    """Return the measured and the predicted friction of dwells.

    None is returned if no approach direction is known, if the model uses the target as an input, or
    if no row is valid.
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
    """Return the (N, n) friction in the prediction, in effort units; 0 without friction."""
    parts = [
        prediction.components[name]
        for name in (FRICTION, RESIDUAL)
        if name in prediction.components
    ]
    friction: FloatArray = np.sum([np.zeros_like(prediction.effort), *parts], axis=0)
    return friction


def _means(data: Dataset, values: FloatArray, valid: BoolArray) -> FloatArray:
    """Return the (D, n) mean over the valid rows of each dwell; NaN without valid rows."""
    share = series_means(data, valid.astype(np.float64))
    sums = series_means(data, np.where(valid, values, 0.0))
    return np.divide(sums, share, out=np.full_like(sums, np.nan), where=share > 0)


def _in_motion(
    model: Model, data: Dataset, prediction: Prediction, qd: FloatArray
) -> FrictionInMotion | None:
    """Return the measured and the predicted friction along trajectories.

    None is returned if the model predicts no friction or uses the target as an input.
    """
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
"""Speed [rad/s] below which friction curves are sampled finely, around the velocity reversal."""


def _law(model: Model, qd: FloatArray) -> tuple[FloatArray, FrictionCurve] | tuple[None, None]:
    """Return velocities (M, n) in the range of the data, and the friction curve of the model.

    Velocities and curve are None if the model has no friction curve.
    """
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
