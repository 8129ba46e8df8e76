"""Losses that grow slower than squares, as weights for iteratively reweighted least squares."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hil.core import FloatArray

Loss = Literal["huber", "tukey"]
LOSSES = ("huber", "tukey")

HUBER, TUKEY = 1.345, 4.685
"""Tuning constants at which 95 % of the efficiency on Gaussian errors is kept."""

NORMAL = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


def robust_weights(z: FloatArray, loss: Loss) -> FloatArray:
    """ψ(z)/z of residuals in standard deviations: 1 at 0, less further out."""
    size = np.abs(z)
    if loss == "huber":
        return np.asarray(HUBER / np.maximum(size, HUBER))
    return np.asarray(np.maximum(1.0 - (size / TUKEY) ** 2, 0.0) ** 2)


def influence_slope(z: FloatArray, loss: Loss) -> FloatArray:
    """ψ′(z): how much an observation still counts where it is."""
    size = np.abs(z)
    if loss == "huber":
        return np.asarray(size <= HUBER, dtype=np.float64)
    ratio = (size / TUKEY) ** 2
    return np.asarray(np.where(ratio < 1.0, (1.0 - ratio) * (1.0 - 5.0 * ratio), 0.0))


def robust_scale(residual: FloatArray) -> FloatArray:
    """(n,) standard deviation of residuals (N, n) about 0 that outliers leave alone (MAD)."""
    return np.asarray(NORMAL * np.median(np.abs(residual), axis=0))
