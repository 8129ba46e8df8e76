"""How certain weighted least squares is of robot parameters when errors depend on each other.

Errors of successive samples, and of all joints at one instant, have much to do with each other.
With one score s_t = Σ_j x_tj w_j r_tj per instant and B = (XᵀWX)⁻¹, the covariance is B Ω B, where

- `hac`: Ω = Σ_l (1 − |l|/L) Σ_t s_t s_{t−l}ᵀ over the lags within a series (Newey & West,
  Econometrica 1987), for errors that forget after some time;
- `clustered`: Ω sums whole trajectories, whatever their samples share, with the corrections of
  `hil.estimators.clustered` for few of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.clustered import Clustered, ClusterSums, clustered_covariance

WINDOW_TIMES = 10.0
"""The window of `hac` in correlation times: it then misses about a tenth of the variance."""

FEWEST_WINDOWS = 8
"""A window is at most this share of the samples: longer ones see the fit's own zero sum."""


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


def trajectory_covariance(bread: FloatArray, scores: Scores) -> Clustered:
    """CR2 with Satterthwaite's degrees of freedom; every series is one cluster."""
    sums = np.add.reduceat(scores.score, scores.offsets[:-1], axis=0)
    rows = len(scores.score) * scores.joints
    return clustered_covariance(bread, ClusterSums(scores.gram, sums, rows))


def hac_window(correlated: FloatArray, samples: int) -> int:
    """Instants after which errors with these correlation times (n,) count as forgotten."""
    wanted = int(np.ceil(WINDOW_TIMES * float(np.max(correlated))))
    return max(min(wanted, samples // FEWEST_WINDOWS), 1)


def _windowed(score: FloatArray, window: int) -> FloatArray:
    """(N + window − 1, p) sums over `window` successive rows, zeros before and after."""
    padded = np.zeros((len(score) + 2 * window - 1, score.shape[1]))
    padded[window : window + len(score)] = score
    total = np.cumsum(padded, axis=0)
    sums: FloatArray = total[window:] - total[:-window]
    return sums
