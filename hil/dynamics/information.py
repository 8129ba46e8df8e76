"""How well samples identify: scalar functions of the information matrix and their gradients.

With Y the regressor of some samples, G = YᵀY is the information they hold on its parameters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.linalg

from hil.core import FloatArray

LEAST_SHARE = 1e-15
"""Eigenvalues below this share of the largest are rounding; so is their logarithm."""


class Measure(NamedTuple):
    """A function of the information matrix.

    Attributes:
        value: The smaller, the better the samples identify.
        gradient: (b, b) its derivative, symmetric: dvalue = Σ gradient ∘ dG.
        exact: What `value` stands for: a condition number, or a log determinant.
    """

    value: float
    gradient: FloatArray
    exact: float


def log_condition(G: FloatArray, sharpness: float, scaled: bool = False) -> Measure:
    """Log cond(Y), smooth: where singular values meet, the condition number itself has a kink.

    The largest and the least eigenvalue are replaced by the ends of a p-norm over all,
    (Σ λᵖ)^(1/p) and (Σ λ⁻ᵖ)^(−1/p), which is above log cond by (log b)/p at most.

    Args:
        G: (b, b).
        sharpness: p.
        scaled: Condition number of Y with its columns scaled to length 1.
    """
    if scaled:
        return _scaled(G, sharpness)
    values, V = scipy.linalg.eigh(G, check_finite=False)
    logs = np.log(np.maximum(values, LEAST_SHARE * values[-1]))
    high, low = np.exp(sharpness * (logs - logs[-1])), np.exp(sharpness * (logs[0] - logs))
    spread = logs[-1] - logs[0]
    value = 0.5 * (spread + np.log(high.sum() * low.sum()) / sharpness)
    by_values = 0.5 * (high / high.sum() - low / low.sum()) * np.exp(-logs)
    return Measure(float(value), (V * by_values) @ V.T, float(np.exp(0.5 * spread)))


def neg_log_det(G: FloatArray) -> Measure:
    """−log det(YᵀY)/(2b): how far the axes of the confidence ellipsoid are, in the mean."""
    size = len(G)
    values, V = scipy.linalg.eigh(G, check_finite=False)
    values = np.maximum(values, LEAST_SHARE * values[-1])
    log_det = float(np.log(values).sum())
    return Measure(-0.5 * log_det / size, (V * (-0.5 / size / values)) @ V.T, log_det)


def _scaled(G: FloatArray, sharpness: float) -> Measure:
    length = np.sqrt(np.maximum(np.diag(G), LEAST_SHARE * np.diag(G).max()))
    shape = G / np.outer(length, length)
    value, by_shape, exact = log_condition(shape, sharpness)
    by_length = np.einsum("ij,ij->i", by_shape, shape) / length**2
    gradient = by_shape / np.outer(length, length) - np.diag(by_length)
    return Measure(value, gradient, exact)
