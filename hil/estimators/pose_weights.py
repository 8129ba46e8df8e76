"""How much a row counts in weighted least squares, by the pose or the dwell it belongs to.

The static paper weights every sample by 1/σ² with a variance of its own, from the residual of a
least-squares fit. A variance from one residual is no variance: where the residual happens to be 0
the weight is infinite, and the fit goes through that sample. So a variance here is that of a whole
pose or dwell, and it is drawn towards the mean variance of its joint as if `PRIOR` further
observations had had that one: (PRIOR·s² + m·v) / (PRIOR + m), v from m observations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hil.core import FloatArray, IntArray

PRIOR = 4.0
"""Observations' worth of the joint's mean variance. With one residual per pose the weights are
those of one step towards the maximum likelihood of Student's t with 4 degrees of freedom."""


class PoseWeights(NamedTuple):
    """Weights, and how they answer to the residuals they were made of.

    Attributes:
        weight: (N,).
        answer: (G,) κ_g: to first order a change of the scores' sum by errors of the first fit is
            −Σ κ_g s_g s_gᵀ times the change of its coefficients, s_g = X_gᵀ r_g.
    """

    weight: FloatArray
    answer: FloatArray


def residual_weights(residual: FloatArray, pose: IntArray, floor: float) -> PoseWeights:
    """1/variance per pose, from the residual of a first fit.

    All rows of a pose are one observation of its variance: they share what friction left.

    Args:
        residual: (N,) of one joint.
        pose: (N,) from 0, none left out.
        floor: Least variance; data without noise would weigh 1/0.
    """
    count = np.bincount(pose)
    mean_square = np.bincount(pose, residual**2) / count
    common = max(float(np.mean(mean_square)), floor)
    variance = (PRIOR * common + mean_square) / (PRIOR + 1.0)
    return PoseWeights(1.0 / variance[pose], 2.0 / ((PRIOR + 1.0) * count * variance**2))


def repeat_weights(
    variance: FloatArray, samples: IntArray, dwell: IntArray, floor: float
) -> FloatArray:
    """(N,) 1/variance of the repeats of the dwell a row belongs to.

    Args:
        variance: (D,) of the samples of each dwell about their mean; of no account with one.
        samples: (D,) how many there were.
        dwell: (N,) dwell of each row, from 0.
        floor: Least variance; quantised samples may all be equal.
    """
    degrees = samples - 1.0
    common = max(float(variance @ degrees) / max(float(np.sum(degrees)), 1.0), floor)
    drawn = (PRIOR * common + degrees * variance) / (PRIOR + degrees)
    weight: FloatArray = 1.0 / drawn[dwell]
    return weight


def pose_counts(pose: IntArray) -> FloatArray:
    """(N,) weights with which every pose counts once, however many dwells and samples it has."""
    weight: FloatArray = 1.0 / np.bincount(pose)[pose]
    return weight
