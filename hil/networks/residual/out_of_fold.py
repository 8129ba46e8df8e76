"""What physics leaves of trajectories it was not fitted to.

A model has an easier life on its training data than anywhere else. A network that learns from
those residuals, or bands that are calibrated on them, would take the model to be better than it
is. So the trajectories are dealt into folds, and each fold is predicted by a model of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.data import Dataset, group_of, groups, rows_to_fit, told_by_sample
from hil.estimators import RobotEstimator

NO_FOLD = -1


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """A fitted base model, and what models like it say of rows they have not seen.

    Attributes:
        model: Fitted to everything that may be learned from.
        predicted: (N, n) effort of every row by a model of the other folds; by `model` itself in
            rows without a fold.
        valid: (N,) rows for which they stand by their prediction in every joint.
        fold: (N,) number of the fold; −1 where the rows belong to none.
    """

    model: RobotEstimator
    predicted: FloatArray
    valid: BoolArray
    fold: IntArray


def physics_of(
    dataset: Dataset,
    model: RobotEstimator,
    folds: int,
    seed: int,
    fit: Callable[[Dataset, int], RobotEstimator],
) -> Physics:
    """Predict every row by a model like the fitted one that has not seen its trajectory.

    Args:
        dataset: All rows; those that are judged are predicted, never learned from.
        model: Fitted to everything that may be learned from.
        folds: How many; with 1 the model itself predicts every row.
        seed: Of the deal.
        fit: A fresh model of its kind, fitted to a dataset without the fold of this number.
    """
    fold = fold_of_rows(dataset, folds, seed)
    prediction = model.predict(dataset)
    predicted, valid = np.array(prediction.effort), np.all(prediction.valid, axis=1)
    series = dataset.series_index()
    for number in range(int(fold.max(initial=NO_FOLD)) + 1):
        held = fold == number
        others = np.setdiff1d(np.arange(len(dataset.conditions)), np.unique(series[held]))
        left_out = dataset.take(np.unique(series[held]))
        told = fit(dataset.take(others), number).predict(left_out)
        predicted[held] = told.effort
        valid[held] = np.all(told.valid, axis=1)
    return Physics(model, predicted, valid & np.all(np.isfinite(predicted), axis=1), fold)


def fold_of_rows(dataset: Dataset, folds: int, seed: int) -> IntArray:
    """(N,) fold of every row: whole trajectories, all their loads together.

    Without at least two trajectories there are no folds. Nor are there any where a study tears
    trajectories row by row: a row's neighbours are then learned from in any case.
    """
    fold = np.full(len(dataset), NO_FOLD)
    if told_by_sample(dataset):
        return fold
    fitted = dataset.take(_whole(dataset))
    dealt = groups(fitted, "trajectory")
    count = min(folds, len(dealt))
    if count < 2:
        return fold
    order = np.random.default_rng(seed).permutation(len(dealt))
    number = {dealt[g]: k % count for k, g in enumerate(order)}
    wanted = rows_to_fit(dataset)
    for condition, rows in dataset.slices():
        group = group_of(condition, "trajectory")
        if group in number and np.any(wanted[rows]):
            fold[rows] = number[group]
    return fold


def _whole(dataset: Dataset) -> list[int]:
    """Numbers of the series of which anything may be learned."""
    wanted = rows_to_fit(dataset)
    return [i for i, (_, rows) in enumerate(dataset.slices()) if np.any(wanted[rows])]
