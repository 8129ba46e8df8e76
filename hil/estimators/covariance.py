"""How certain least squares is when errors depend on each other.

The textbook's standard errors take every row for an independent observation. Robots give no such
rows: the ten samples of a dwell share what its approach left in the gears, errors of successive
samples and of all joints at one instant have much to do with each other. With B = (XᵀWX)⁻¹ the
covariance is therefore the sandwich B Ω B, and the three ways here differ in Ω:

- `clustered_covariance`: Ω = Σ_g s_g s_gᵀ with one score s_g = X_gᵀ W_g r_g per cluster g (Liang &
  Zeger, Biometrika 1986; Cameron & Miller, J. Human Resources 2015). Whatever the errors of one
  cluster have to do with each other, it holds; clusters must be independent. Few clusters make it
  too small, which two corrections mend. `CR1` multiplies by G/(G−1) · (N−1)/(N−p), with Student's t
  at G−1 degrees of freedom. `CR2` (Bell & McCaffrey, Survey Methodology 2002) multiplies each
  cluster's residual by (I − H_gg)^(−1/2), which is unbiased for errors of equal variance, with
  Student's t at Satterthwaite's degrees of freedom, one number per coefficient.
- `trajectory_covariance`: the same with whole trajectories as clusters.
- `hac_covariance`: Ω = Σ_l (1 − |l|/L) Σ_t s_t s_{t−l}ᵀ over the lags within a series, with one
  score s_t = Σ_j x_tj w_j r_tj per instant (Newey & West, Econometrica 1987), for errors that
  forget after some time.

`correlated_samples` measures after how many samples a residual forgets, and `time_blocks` cuts a
recording into clusters of a few such times.
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
    """How certain the coefficients are.

    Attributes:
        covariance: (p, p) of the coefficients.
        degrees: (p,) degrees of freedom of Student's t for each coefficient's interval.
    """

    covariance: FloatArray
    degrees: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ClusterSums:
    """All that the covariance needs to know of the rows.

    Attributes:
        gram: (G, p, p) X_gᵀ W_g X_g.
        score: (G, p) X_gᵀ W_g r_g.
        rows: Rows with a weight above zero, N.
    """

    gram: FloatArray
    score: FloatArray
    rows: int

    @staticmethod
    def of(
        X: FloatArray, residual: FloatArray, weight: FloatArray, clusters: IntArray
    ) -> ClusterSums:
        """Sums over the clusters that are numbered, in any way, by `clusters` (N,)."""
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
    """Covariance of weighted least-squares coefficients, robust to what clusters share.

    Args:
        bread: (p, p) (XᵀWX)⁻¹ over all rows.
        sums: Of the clusters.
        correction: For few clusters, see the top of the module.
    """
    if correction == "CR1":
        count, p = sums.score.shape
        factor = count / max(count - 1, 1) * (sums.rows - 1) / max(sums.rows - p, 1)
        half = sums.score @ bread
        return Clustered(factor * half.T @ half, np.full(p, max(count - 1, 1.0)))
    return _bell_mccaffrey(bread, sums)


MOST_LEVERAGE = 1.0 - 1e-9
"""A cluster with all the leverage there is in some direction leaves no residual there."""


def _bell_mccaffrey(bread: FloatArray, sums: ClusterSums) -> Clustered:
    """CR2 in the coordinates Z = W^½ X L with B = L Lᵀ, in which H_gg = Z_g Z_gᵀ.

    There Z_gᵀ (I − H_gg)^(−½) = V (1 − λ)^(−½) Vᵀ Z_gᵀ with Z_gᵀ Z_g = V λ Vᵀ: p × p is enough.
    """
    L = _root(bread)
    share, V = np.linalg.eigh(L.T @ sums.gram @ L)
    # No residual is left along a direction that one cluster decides alone: nothing to scale up.
    grown = np.where(share < MOST_LEVERAGE, 1.0 / np.sqrt(1.0 - np.minimum(share, 1 - 1e-12)), 1.0)
    adjust = (V * grown[:, None, :]) @ V.transpose(0, 2, 1)
    score = np.einsum("gij,gj->gi", adjust, sums.score @ L)
    half = score @ L.T
    # Column k of `to` is F_g l_k, that of `seen` is G_g F_g l_k, for coefficient k = l_kᵀ z.
    to = adjust @ L.T
    seen = ((V * share[:, None, :]) @ V.transpose(0, 2, 1)) @ to
    degrees = [_satterthwaite(to[:, :, k], seen[:, :, k]) for k in range(bread.shape[0])]
    return Clustered(half.T @ half, np.array(degrees))


def _root(bread: FloatArray) -> FloatArray:
    """L (p, p) with L Lᵀ = bread, also where directions are not determined."""
    length = np.sqrt(np.diag(bread))
    length[length == 0] = 1.0
    values, vectors = np.linalg.eigh(bread / np.outer(length, length))
    root: FloatArray = length[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _satterthwaite(to: FloatArray, seen: FloatArray) -> float:
    """Degrees of freedom for errors of equal variance; `to`, `seen` (G, p) of a coefficient.

    The variance estimate is a quadratic form in the errors with the G × G matrix
    P = diag(d) − U Uᵀ; its degrees of freedom are tr(P)² / tr(P²).
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
    """(p, 2) intervals of Student's t; NaN where the standard error is.

    Raises:
        ValueError: `level` is no share between 0 and 1.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level!r}, but must be between 0 and 1")
    reach = student_quantile(0.5 + level / 2, degrees) * std_error
    return np.stack([coefficients - reach, coefficients + reach], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What the covariance needs to know of the observations.

    Attributes:
        score: (N, p) one per instant, all series behind each other.
        gram: (S, p, p) XᵀWX of every series.
        offsets: (S + 1,) row at which each series begins.
        joints: Observations per instant.
    """

    score: FloatArray
    gram: FloatArray
    offsets: IntArray
    joints: int


def hac_covariance(bread: FloatArray, scores: Scores, window: int) -> Clustered:
    """Newey & West's covariance with Bartlett's kernel over lags below `window`.

    Every lag's weighted sum is the mean over all windows of `window` instants, those that overlap
    an end included, of the window's own sum times itself: one pass, however wide the window.

    Args:
        bread: (p, p) (XᵀWX)⁻¹.
        scores: Of the observations.
        window: Lags from 0 that count, at least 1.

    Returns:
        The covariance, times N/(N − p), and Student's degrees of freedom: a Bartlett kernel of
        N/window windows tells a variance as 1.5 times as many independent ones would (Sun, 2014).
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
    """(N + window − 1, p) sums over `window` successive rows, zeros before and after."""
    padded = np.zeros((len(score) + 2 * window - 1, score.shape[1]))
    padded[window : window + len(score)] = score
    total = np.cumsum(padded, axis=0)
    sums: FloatArray = total[window:] - total[:-window]
    return sums


HAC_TIMES = 10.0
"""The window of `hac` in correlation times: it then misses about a tenth of the variance."""

FEWEST_WINDOWS = 8
"""A window is at most this share of the samples: longer ones see the fit's own zero sum."""


def hac_window(correlated: FloatArray, samples: int) -> int:
    """Instants after which errors with these correlation times (n,) count as forgotten."""
    wanted = int(np.ceil(HAC_TIMES * float(np.max(correlated))))
    return max(min(wanted, samples // FEWEST_WINDOWS), 1)


def trajectory_covariance(bread: FloatArray, scores: Scores) -> Clustered:
    """CR2 with Satterthwaite's degrees of freedom; every series is one cluster."""
    sums = np.add.reduceat(scores.score, scores.offsets[:-1], axis=0)
    rows = len(scores.score) * scores.joints
    return clustered_covariance(bread, ClusterSums(scores.gram, sums, rows))


SOKAL_TIMES = 5.0
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
    enough = lags >= SOKAL_TIMES * times
    enough[-1] = True
    beyond = np.arange(longest)[:, None] > np.argmax(enough, axis=0)
    return np.asarray(np.max(np.where(beyond, 1.0, times), axis=0, initial=1.0))


def _autocovariance(values: FloatArray) -> FloatArray:
    """(N, n) sums of products at lags 0…N − 1, by FFT."""
    size = 1 << (2 * len(values) - 1).bit_length() if len(values) else 1
    spectrum = np.fft.rfft(values, size, axis=0)
    sums: FloatArray = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: len(values)]
    return sums


BLOCK_TIMES = 4.0
"""A block lasts so many correlation times of the residual: then blocks hardly know of another."""

FEWEST_BLOCKS = 10
"""Blocks that are made even if they have to be shorter for it: fewer tell no variance."""


def time_blocks(residual: FloatArray, offsets: IntArray) -> IntArray:
    """(N,) number of the block each row belongs to; no block reaches over the end of a series.

    Args:
        residual: (N, n) of a fit; its slowest joint decides how long blocks are.
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
