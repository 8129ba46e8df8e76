"""Error measures per joint. All take measured and predicted efforts (N, n) and return (n,).

Without a single row they return NaN.
"""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray


def rmse(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Root-mean-square error, in the unit of the effort."""
    return _root_mean_square(measured - predicted)


def nrmse(
    measured: FloatArray, predicted: FloatArray, scale: FloatArray | None = None
) -> FloatArray:
    """RMSE over `scale` (n,), by default the standard deviation of the measured signal.

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
    """Maximum error percentage: largest error over the largest measured magnitude [%].

    The PINN paper names the measure (its Fig. 7b) without defining it; this is the usual meaning.
    """
    if len(measured) == 0:
        return np.full(measured.shape[1], np.nan)
    largest = np.max(np.abs(measured), axis=0)
    worst = np.max(np.abs(measured - predicted), axis=0)
    return np.where(largest > 0, 100.0 * worst / np.where(largest > 0, largest, 1.0), np.nan)


def correlation(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """Pearson's R between measured and predicted; NaN where either does not vary."""
    if len(measured) < 2:
        return np.full(measured.shape[1], np.nan)
    a, b = measured - measured.mean(axis=0), predicted - predicted.mean(axis=0)
    size = np.sqrt(np.sum(a**2, axis=0) * np.sum(b**2, axis=0))
    return np.where(size > 0, np.sum(a * b, axis=0) / np.where(size > 0, size, 1.0), np.nan)


def _root_mean_square(error: FloatArray) -> FloatArray:
    if len(error) == 0:
        return np.full(error.shape[1], np.nan)
    squares: FloatArray = np.sqrt(np.mean(error**2, axis=0))
    return squares
