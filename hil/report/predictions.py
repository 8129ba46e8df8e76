"""Held-out data with the predictions of a model: what the plots of a fit are drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.core import DataError, FloatArray, IntArray
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
from hil.estimators import load_model_file
from hil.report.documents import as_names
from hil.report.fit_facts import FitFacts
from hil.report.friction_seen import Friction, at_rest, in_motion, scale_of

if TYPE_CHECKING:
    from hil.evaluation import Judged

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
