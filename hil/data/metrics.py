"""Error measures per joint, and the error of the trivial observer.

The measures take measured and predicted efforts (N, n) and return (n,); without a single row they
return NaN.

The trivial observer repeats what was measured a moment ago (`persistence`). A model that has past
torque among its inputs must have a smaller error: at 1 kHz, and after filters without phase shift,
which put the future into the past, torque a few milliseconds old is nearly the answer.
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
    """Return the RMSE over `scale` (n,), by default the standard deviation of the measured signal.

    1 is what predicting the mean would reach. Give the training signal's standard deviation as
    `scale` to compare trajectories of different vigour; a joint without signal gets NaN.
    """
    if len(measured) == 0:
        return np.full(measured.shape[1], np.nan)
    deviation = np.std(measured, axis=0) if scale is None else np.asarray(scale)
    usable = deviation > 0
    ratio = rmse(measured, predicted) / np.where(usable, deviation, 1.0)
    return np.where(usable, ratio, np.nan)


def mep(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return the maximum error percentage: largest error over the largest measured magnitude [%].

    The PINN paper names the measure (its Fig. 7b) without defining it; this is the usual meaning.
    """
    if len(measured) == 0:
        return np.full(measured.shape[1], np.nan)
    largest = np.max(np.abs(measured), axis=0)
    worst = np.max(np.abs(measured - predicted), axis=0)
    return np.where(largest > 0, 100.0 * worst / np.where(largest > 0, largest, 1.0), np.nan)


def correlation(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return Pearson's R between measured and predicted; NaN where either does not vary."""
    if len(measured) < 2:
        return np.full(measured.shape[1], np.nan)
    a, b = measured - measured.mean(axis=0), predicted - predicted.mean(axis=0)
    size = np.sqrt(np.sum(a**2, axis=0) * np.sum(b**2, axis=0))
    return np.where(size > 0, np.sum(a * b, axis=0) / np.where(size > 0, size, 1.0), np.nan)


# The trivial observer


_ROUNDING_S = 1e-6
"""Time stamps that differ by less are the same: 20 steps of 1 ms are 20 ms."""


def persistence(dataset: Dataset, latency_s: float, column: str = "effort") -> FloatArray:
    """Return (N, n) the newest value that is at least `latency_s` old; NaN before there is one.

    Args:
        dataset: Series by series; nothing is carried over from one to the next.
        latency_s: Age of the newest value that is known [s], above 0.
        column: The values to repeat.

    Raises:
        SpecError: The latency is not above 0: that would be the answer itself.
        DataError: There is no such column.
    """
    if not (np.isfinite(latency_s) and latency_s > 0):
        raise SpecError(
            f"a latency of {latency_s!r} s is none",
            hint="state how old the newest torque is when a prediction is made, 0.02 for 20 ms",
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
    """Return (n,) the RMSE of `persistence` where it has a value, in the unit of the column.

    Args:
        dataset: The data to judge on.
        latency_s: See `persistence`.
        column: The values to repeat and to compare with.
        rows: (N,) rows to judge; all by default.
    """
    repeated = persistence(dataset, latency_s, column)
    judged = np.all(np.isfinite(repeated), axis=1)
    if rows is not None:
        judged &= rows
    return rmse(dataset[column][judged], repeated[judged])
