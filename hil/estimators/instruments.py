"""Instrumental variables: a regression whose regressors are noisy, through exact stand-ins."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import FloatArray, IntArray


class Instrumental(NamedTuple):
    """Coefficients (p,) and their cluster-robust standard errors (p,), inf if not determined."""

    coefficients: FloatArray
    std_error: FloatArray


def instrumental(X: FloatArray, y: FloatArray, Z: FloatArray, clusters: IntArray) -> Instrumental:
    """β = (ZᵀX)⁻¹ Zᵀy, with as many instruments as regressors.

    Consistent when Z is independent of the noise in X and y, where least squares is not. The
    covariance is the sandwich over clusters, times G/(G−1) · (N−1)/(N−p) as `CR1` in
    `hil.estimators.clustered`.

    Args:
        X: (N, p) regressors.
        y: (N,) target.
        Z: (N, p) instruments.
        clusters: (N,) rows of one number depend on each other.
    """
    N, p = X.shape
    scale_X, scale_Z = (np.maximum(np.linalg.norm(M, axis=0), 1e-300) for M in (X, Z))
    moments = (Z / scale_Z).T @ (X / scale_X)
    if np.linalg.cond(moments) > 1e8:
        return Instrumental(np.full(p, np.nan), np.full(p, np.inf))
    inverse = np.linalg.inv(moments) / scale_X[:, None]
    coefficients = inverse @ ((Z / scale_Z).T @ y)
    _, number = np.unique(clusters, return_inverse=True)
    score = np.zeros((number.max() + 1, p))
    np.add.at(score, number, Z / scale_Z * (y - X @ coefficients)[:, None])
    G = len(score)
    factor = G / max(G - 1, 1) * (N - 1) / max(N - p, 1)
    half = score @ inverse.T
    return Instrumental(coefficients, np.sqrt(factor * np.sum(half**2, axis=0)))
