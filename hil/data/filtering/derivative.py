"""Time derivatives of sampled signals, over the time stamps as they are."""

from __future__ import annotations

import numpy as np

from hil.core import DataError, FloatArray

BLOCK = 8192
"""Samples whose polynomials are fitted at once; bounds memory on long series."""


def derivative(values: FloatArray, t: FloatArray) -> FloatArray:
    """Time derivative along axis 0 by central differences that respect uneven time stamps.

    Second order inside, one-sided at both ends.

    Raises:
        DataError: Time does not increase strictly.
    """
    _require_increasing(t)
    slope: FloatArray = np.gradient(values, t, axis=0)
    return slope


def local_slope(values: FloatArray, t: FloatArray, window: int, degree: int) -> FloatArray:
    """Time derivative along axis 0 of a polynomial fitted about every sample.

    On even stamps that is the filter of Savitzky & Golay (Anal. Chem. 36, 1964). Here each fit
    is over the true times: stamps that alternate (10 ms, 12 ms) taken for even ones would put
    their alternation, times the speed, into the derivative. Towards the ends of the series the
    window stays inside and the polynomial is differentiated off its middle.

    Args:
        values: (N,) or (N, n).
        t: (N,).
        window: Samples per fit, odd, more than `degree`.
        degree: Of the polynomials.

    Raises:
        DataError: Time does not increase strictly, or there are fewer samples than the window.
    """
    _require_increasing(t)
    if len(t) < window:
        raise DataError(
            f"{len(t)} samples are too few for polynomials over {window}",
            hint="leave the series out, or choose a shorter window",
        )
    flat = values.reshape(len(t), -1)
    slope = np.empty(flat.shape)
    for start in range(0, len(t), BLOCK):
        rows = np.arange(start, min(start + BLOCK, len(t)))
        first = np.clip(rows - window // 2, 0, len(t) - window)
        weights = _slope_weights(t, rows, first, window, degree)
        slope[rows] = sum(weights[:, k, None] * flat[first + k] for k in range(window))
    return slope.reshape(values.shape)


def _slope_weights(
    t: FloatArray, rows: np.ndarray, first: np.ndarray, window: int, degree: int
) -> FloatArray:
    """(R, window) weights of the samples in the slope at each row."""
    time = t[first[:, None] + np.arange(window)] - t[rows, None]
    # Times of the order of 1 keep the normal equations well conditioned.
    scale = 0.5 * (time[:, -1] - time[:, 0])
    powers = (time / scale[:, None])[..., None] ** np.arange(degree + 1)
    gram = np.swapaxes(powers, 1, 2) @ powers
    wanted = np.zeros((len(rows), degree + 1, 1))
    wanted[:, 1] = 1.0
    solved = powers @ np.linalg.solve(gram, wanted)
    return np.asarray(solved[..., 0] / scale[:, None])


def _require_increasing(t: FloatArray) -> None:
    if len(t) < 2 or not np.all(np.diff(t) > 0):
        raise DataError(
            "cannot differentiate: time stamps repeat, run backwards or are fewer than two",
            hint="import the file again with --drop-bad-rows",
        )
