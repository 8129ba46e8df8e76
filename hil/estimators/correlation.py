"""How many independent samples a residual is worth."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hil.core import FloatArray, IntArray

WINDOW = 5.0
"""Lags are summed up to so many correlation times (Sokal's automatic windowing)."""


def correlated_samples(residual: FloatArray, offsets: IntArray) -> FloatArray:
    """(n,) how many successive samples count as one, at least 1.

    The integrated autocorrelation time τ = 1 + 2 Σ ρ(k) of each joint's residual, with the
    autocovariances of all series pooled and the sum cut where k ≥ 5 τ(k) (Sokal, 'Monte Carlo
    methods in statistical mechanics', 1997, §3). The variance of a sum of N such samples is τ
    times that of independent ones. The largest partial sum counts: a fit takes the slow part out
    of its residual, and what is left would otherwise cancel itself (a filtered signal came out as
    if it were white). Correlation between series is not seen.

    Args:
        residual: (N, n), all series behind each other.
        offsets: (S + 1,) row at which each series begins.
    """
    lengths = np.diff(offsets)
    longest = int(lengths.max(initial=0))
    if longest < 2:
        return np.ones(residual.shape[1])
    pooled = np.zeros((longest, residual.shape[1]))
    for start, stop in pairwise(offsets.tolist()):
        pooled[: stop - start] += _autocovariance(residual[start:stop])
    variance = pooled[0]
    rho = pooled / np.where(variance > 0, variance, 1.0)
    times = 2.0 * np.cumsum(rho, axis=0) - rho[0]
    lags = np.arange(longest)[:, None]
    enough = lags >= WINDOW * times
    enough[-1] = True
    beyond = np.arange(longest)[:, None] > np.argmax(enough, axis=0)
    return np.asarray(np.max(np.where(beyond, 1.0, times), axis=0, initial=1.0))


def _autocovariance(values: FloatArray) -> FloatArray:
    """(N, n) sums of products at lags 0…N − 1, by FFT."""
    size = 1 << (2 * len(values) - 1).bit_length() if len(values) else 1
    spectrum = np.fft.rfft(values, size, axis=0)
    sums: FloatArray = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: len(values)]
    return sums
