"""Error measures per joint, and error of the trivial predictor.

The measures are functions of measured and predicted efforts (N, n) and return one value per joint
(n,); the value is NaN if there are no rows.

The trivial predictor repeats a recently measured value (`persistence`). A model with past torque
among its inputs must have a smaller error than the trivial predictor. At 1 kHz, the torque changes
little within a few milliseconds, so the error of the trivial predictor is small. Filters without
phase shift reduce the error of the trivial predictor further, because their output contains future
values.
"""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, FloatArray, SpecError
from hil.data.dataset import Dataset


def rmse(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the root-mean-square error, in the unit of the effort."""
    if len(measured) == 0:
        return np.full(measured.shape[1], np.nan)
    root: FloatArray = np.sqrt(np.mean((measured - predicted) ** 2, axis=0))
    return root


def nrmse(
    measured: FloatArray, predicted: FloatArray, scale: FloatArray | None = None
) -> FloatArray:
    """Return the RMSE divided by `scale` (n,).

    The default for `scale` is the standard deviation of the measured signal; an NRMSE of 1 is then
    the error of predicting the mean. The standard deviation of the training signal is often used as
    `scale` for trajectories of different amplitude. The value is NaN for a joint without signal.
    """
    if len(measured) == 0:
        return np.full(measured.shape[1], np.nan)
    deviation = np.std(measured, axis=0) if scale is None else np.asarray(scale)
    usable = deviation > 0
    ratio = rmse(measured, predicted) / np.where(usable, deviation, 1.0)
    return np.where(usable, ratio, np.nan)


def mep(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the maximum error percentage: largest error over largest measured magnitude [%].

    The PINN paper names the maximum error percentage (its Fig. 7b) but does not define it; the
    definition used here is the usual definition.
    """
    if len(measured) == 0:
        return np.full(measured.shape[1], np.nan)
    largest = np.max(np.abs(measured), axis=0)
    worst = np.max(np.abs(measured - predicted), axis=0)
    return np.where(largest > 0, 100.0 * worst / np.where(largest > 0, largest, 1.0), np.nan)


def correlation(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return Pearson's R between measured and predicted values; NaN for a constant signal."""
    if len(measured) < 2:
        return np.full(measured.shape[1], np.nan)
    a, b = measured - measured.mean(axis=0), predicted - predicted.mean(axis=0)
    size = np.sqrt(np.sum(a**2, axis=0) * np.sum(b**2, axis=0))
    return np.where(size > 0, np.sum(a * b, axis=0) / np.where(size > 0, size, 1.0), np.nan)


# The trivial predictor


_ROUNDING_S = 1e-6
"""Tolerance [s] within which time stamps are equal, such that 20 steps of 1 ms are 20 ms."""


def persistence(dataset: Dataset, latency_s: float, column: str = "effort") -> FloatArray:
    """Return (N, n) the newest value that is at least `latency_s` old; NaN before the first value.

    Args:
        dataset: Dataset with the values; each series is treated separately.
        latency_s: Minimum age of the newest available value [s], above 0.
        column: Name of the column whose values are repeated.

    Raises:
        SpecError: The latency is not above 0; for 0, the prediction would be the measured value
            itself.
        DataError: The dataset has no column of the requested name.
    """
    if not (np.isfinite(latency_s) and latency_s > 0):
        raise SpecError(
            f"the latency is {latency_s!r} s, but must be above 0",
            hint="state the age of the newest torque at the time of a prediction, such as 0.02 "
            "for 20 ms",
        )
    values = dataset[column]
    repeated = np.full_like(values, np.nan, dtype=np.float64)
    for _, rows in dataset.slices():
        t = dataset["t"][rows]
        newest = np.searchsorted(t, t - latency_s + _ROUNDING_S, side="right") - 1
        known = newest >= 0
        repeated[rows][known] = values[rows][newest[known]]
    return repeated


def persistence_rmse(
    dataset: Dataset, latency_s: float, column: str = "effort", rows: BoolArray | None = None
) -> FloatArray:
    """Return (n,) the RMSE of `persistence` on the rows with a value, in the unit of the column.

    Args:
        dataset: Evaluation data.
        latency_s: Minimum age of the newest available value [s], as in `persistence`.
        column: Name of the column whose values are repeated and compared.
        rows: (N,) mask of the rows to evaluate; None for all rows.
    """
    repeated = persistence(dataset, latency_s, column)
    judged = np.all(np.isfinite(repeated), axis=1)
    if rows is not None:
        judged &= rows
    return rmse(dataset[column][judged], repeated[judged])
