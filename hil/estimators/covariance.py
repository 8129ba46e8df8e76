"""Standard errors of least squares with correlated errors.

Textbook standard errors assume that every row is an independent observation. Independence of all
rows is a wrong assumption for robots: the ten samples of a dwell share the friction of its
approach, and errors of successive samples and of all joints at one instant are correlated. The
covariance is therefore the sandwich B Ω B with B = (XᵀWX)⁻¹. The three methods of this module
differ in the matrix Ω:

- `clustered_covariance`: Ω = Σ_g s_g s_gᵀ with one score s_g = X_gᵀ W_g r_g per cluster g (Liang &
  Zeger, Biometrika 1986; Cameron & Miller, J. Human Resources 2015). Within a cluster, errors may
  be correlated in any way, but different clusters must be independent. With few clusters, the
  covariance estimate is too small; two corrections are available. The correction `CR1` multiplies
  the covariance estimate by G/(G−1) · (N−1)/(N−p) and uses Student's t with G−1 degrees of freedom.
  The correction `CR2` (Bell & McCaffrey, Survey Methodology 2002) multiplies the residual of each
  cluster by (I − H_gg)^(−1/2), which makes the estimate unbiased for errors of equal variance, and
  uses Student's t with Satterthwaite's degrees of freedom for each coefficient.
- `trajectory_covariance`: the clustered covariance in which each trajectory is one cluster.
- `hac_covariance`: Ω = Σ_l (1 − |l|/L) Σ_t s_t s_{t−l}ᵀ over the lags within a series, with one
  score s_t = Σ_j x_tj w_j r_tj per instant (Newey & West, Econometrica 1987), for errors whose
  correlation decays with time.

`correlated_samples` estimates the correlation time of a residual in samples, and `time_blocks`
divides a recording into clusters of a few correlation times.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.distributions import student_quantile

Correction = Literal["CR1", "CR2"]


class Clustered(NamedTuple):
    """Covariance of coefficients, with the degrees of freedom of their intervals.

    Attributes:
        covariance: (p, p) covariance of the coefficients.
        degrees: (p,) degrees of freedom of Student's t distribution for the confidence interval of
            each coefficient.
    """

    covariance: FloatArray
    degrees: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ClusterSums:
    """Sums over clusters that determine the clustered covariance.

    Attributes:
        gram: (G, p, p) matrices X_gᵀ W_g X_g.
        score: (G, p) scores X_gᵀ W_g r_g.
        rows: Number N of rows with a weight above zero.
    """

    gram: FloatArray
    score: FloatArray
    rows: int

    @staticmethod
    def of(
        X: FloatArray, residual: FloatArray, weight: FloatArray, clusters: IntArray
    ) -> ClusterSums:
        """Return the sums over the rows of each cluster, for cluster labels `clusters` (N,)."""
        _, number = np.unique(clusters, return_inverse=True)
        order = np.argsort(number, kind="stable")
        ends = np.flatnonzero(np.diff(number[order])) + 1
        pieces = np.split(order, ends)
        weighted = X * weight[:, None]
        gram = np.stack([X[rows].T @ weighted[rows] for rows in pieces])
        score = np.stack([residual[rows] @ weighted[rows] for rows in pieces])
        return ClusterSums(gram, score, int(np.count_nonzero(weight)))


def clustered_covariance(
    bread: FloatArray, sums: ClusterSums, correction: Correction = "CR2"
) -> Clustered:
    """Return the covariance of weighted least-squares coefficients with correlated clusters.

    Args:
        bread: (p, p) matrix (XᵀWX)⁻¹ over all rows.
        sums: Sums over the clusters, from `ClusterSums.of`.
        correction: Correction for few clusters, `CR1` or `CR2`; see the module docstring.
    """
    if correction == "CR1":
        count, p = sums.score.shape
        factor = count / max(count - 1, 1) * (sums.rows - 1) / max(sums.rows - p, 1)
        half = sums.score @ bread
        return Clustered(factor * half.T @ half, np.full(p, max(count - 1, 1.0)))
    return _bell_mccaffrey(bread, sums)


MOST_LEVERAGE = 1.0 - 1e-9
"""Leverage of a cluster above which its residual in a direction counts as zero."""


def _bell_mccaffrey(bread: FloatArray, sums: ClusterSums) -> Clustered:
    """Return the CR2 covariance in coordinates Z = W^½ X L with B = L Lᵀ and H_gg = Z_g Z_gᵀ.

    In these coordinates, Z_gᵀ (I − H_gg)^(−½) = V (1 − λ)^(−½) Vᵀ Z_gᵀ with Z_gᵀ Z_g = V λ Vᵀ, so
    only p × p matrices are needed.
    """
    L = _root(bread)
    share, V = np.linalg.eigh(L.T @ sums.gram @ L)
    # A direction that one cluster determines alone has no residual, so it is not scaled.
    grown = np.where(share < MOST_LEVERAGE, 1.0 / np.sqrt(1.0 - np.minimum(share, 1 - 1e-12)), 1.0)
    adjust = (V * grown[:, None, :]) @ V.transpose(0, 2, 1)
    score = np.einsum("gij,gj->gi", adjust, sums.score @ L)
    half = score @ L.T
    # For coefficient k = l_kᵀ z, column k of `to` is F_g l_k and that of `seen` is G_g F_g l_k.
    to = adjust @ L.T
    seen = ((V * share[:, None, :]) @ V.transpose(0, 2, 1)) @ to
    degrees = [_satterthwaite(to[:, :, k], seen[:, :, k]) for k in range(bread.shape[0])]
    return Clustered(half.T @ half, np.array(degrees))


def _root(bread: FloatArray) -> FloatArray:
    """Return L (p, p) with L Lᵀ = bread, even if the data leave some directions undetermined."""
    length = np.sqrt(np.diag(bread))
    length[length == 0] = 1.0
    values, vectors = np.linalg.eigh(bread / np.outer(length, length))
    root: FloatArray = length[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _satterthwaite(to: FloatArray, seen: FloatArray) -> float:
    """Return the degrees of freedom for errors of equal variance.

    The arguments `to` and `seen` (G, p) refer to one coefficient. The variance estimate is a
    quadratic form in the errors with the G × G matrix P = diag(d) − U Uᵀ; its degrees of freedom
    are tr(P)² / tr(P²).
    """
    diagonal = np.einsum("gi,gi->g", to, seen)
    length = np.einsum("gi,gi->g", seen, seen)
    trace = float(np.sum(diagonal - length))
    inner = seen.T @ seen
    square = float(np.sum(diagonal**2) - 2 * diagonal @ length + np.sum(inner**2))
    return max(trace**2 / square, 1.0) if square > 0 else 1.0


def interval(
    coefficients: FloatArray, std_error: FloatArray, degrees: FloatArray, level: float
) -> FloatArray:
    """Return (p, 2) confidence intervals from Student's t; NaN if the standard error is NaN.

    Raises:
        ValueError: The confidence level `level` is not between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level!r}, but must be between 0 and 1")
    reach = student_quantile(0.5 + level / 2, degrees) * std_error
    return np.stack([coefficients - reach, coefficients + reach], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Scores of the observations, from which the covariance is computed.

    Attributes:
        score: (N, p) one score per instant, with all series in sequence.
        gram: (S, p, p) matrix XᵀWX of every series.
        offsets: (S + 1,) row at which each series begins.
        joints: Number n of joints, which is the number of observations per instant.
    """

    score: FloatArray
    gram: FloatArray
    offsets: IntArray
    joints: int


def hac_covariance(bread: FloatArray, scores: Scores, window: int) -> Clustered:
    """Return Newey & West's covariance with Bartlett's kernel over lags below `window`.

    The weighted sum over all lags equals the mean of the outer product of window sums over all
    windows of `window` instants, including windows that overlap an end. The covariance therefore
    needs one pass through the data for any window.

    Args:
        bread: (p, p) matrix (XᵀWX)⁻¹.
        scores: Scores of the observations, one per instant.
        window: Number of lags, counted from lag 0; at least 1.

    Returns:
        Covariance times N/(N − p), and the degrees of freedom of Student's t: the estimate with a
        Bartlett kernel of N/window windows is as precise as an estimate from 1.5 · N/window
        independent windows (Sun, 2014).
    """
    p = bread.shape[0]
    omega = np.zeros((p, p))
    for start, stop in pairwise(scores.offsets.tolist()):
        sums = _windowed(scores.score[start:stop], window)
        omega += sums.T @ sums / window
    count = len(scores.score) * scores.joints
    covariance = count / max(count - p, 1) * bread @ omega @ bread
    degrees = max(1.5 * len(scores.score) / window, 1.0)
    return Clustered(covariance, np.full(p, degrees))


def _windowed(score: FloatArray, window: int) -> FloatArray:
    """Return (N + window − 1, p) sums over `window` successive rows, padded with zeros."""
    padded = np.zeros((len(score) + 2 * window - 1, score.shape[1]))
    padded[window : window + len(score)] = score
    total = np.cumsum(padded, axis=0)
    sums: FloatArray = total[window:] - total[:-window]
    return sums


HAC_TIMES = 10.0
"""Window length of the `hac` covariance, in correlation times of the residual.

A window of this length misses about a tenth of the variance.
"""

FEWEST_WINDOWS = 8
"""Minimum number of windows that the samples of a fit must contain.

The scores of a fit sum to zero, which biases the covariance estimate for longer windows.
"""


def hac_window(correlated: FloatArray, samples: int) -> int:
    """Return the window length in samples for errors with these correlation times (n,)."""
    wanted = int(np.ceil(HAC_TIMES * float(np.max(correlated))))
    return max(min(wanted, samples // FEWEST_WINDOWS), 1)


def trajectory_covariance(bread: FloatArray, scores: Scores) -> Clustered:
    """Return the CR2 covariance in which every series is one cluster."""
    sums = np.add.reduceat(scores.score, scores.offsets[:-1], axis=0)
    rows = len(scores.score) * scores.joints
    return clustered_covariance(bread, ClusterSums(scores.gram, sums, rows))


SOKAL_TIMES = 5.0
"""Largest lag of the autocorrelation sum in correlation times (Sokal's automatic windowing)."""


def correlated_samples(residual: FloatArray, offsets: IntArray) -> FloatArray:
    """Return (n,) the number of successive samples that count as one independent sample.

    This number of samples is the integrated autocorrelation time τ = 1 + 2 Σ ρ(k) of the residual
    of each joint. The autocovariances of all series are pooled, and the sum ends at k ≥ 5 τ(k)
    (Sokal, 'Monte Carlo methods in statistical mechanics', 1997, §3). The variance of a sum of N
    correlated samples is τ times that of independent samples. The largest partial sum of the
    autocorrelations is used: a fit removes slow components from its residual, so that the later
    terms could cancel and the residual of a filtered signal would look white. Correlation between
    series is not included.

    Args:
        residual: (N, n) residual, all series in sequence.
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
    enough = lags >= SOKAL_TIMES * times
    enough[-1] = True
    beyond = np.arange(longest)[:, None] > np.argmax(enough, axis=0)
    return np.asarray(np.max(np.where(beyond, 1.0, times), axis=0, initial=1.0))


def _autocovariance(values: FloatArray) -> FloatArray:
    """Return (N, n) sums of products at lags 0…N − 1, computed by FFT."""
    size = 1 << (2 * len(values) - 1).bit_length() if len(values) else 1
    spectrum = np.fft.rfft(values, size, axis=0)
    sums: FloatArray = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: len(values)]
    return sums


BLOCK_TIMES = 4.0
"""Length of a block in correlation times of the residual; blocks are then nearly independent."""

FEWEST_BLOCKS = 10
"""Minimum number of blocks; blocks are shortened if necessary, because few give no variance."""


def time_blocks(residual: FloatArray, offsets: IntArray) -> IntArray:
    """Return (N,) the index of the block of each row; no block crosses the end of a series.

    Args:
        residual: (N, n) residual of a fit; the joint with the longest correlation time defines the
            block length.
        offsets: (S + 1,) row at which each series begins.
    """
    slowest = float(np.max(correlated_samples(residual, offsets), initial=1.0))
    longest = max(1, len(residual) // FEWEST_BLOCKS)
    length = int(np.clip(np.ceil(BLOCK_TIMES * slowest), 1, longest))
    number, first = np.empty(len(residual), dtype=np.int64), 0
    for start, stop in pairwise(offsets.tolist()):
        count = max(1, (stop - start) // length)
        number[start:stop] = first + np.arange(stop - start) * count // max(stop - start, 1)
        first += count
    return number
