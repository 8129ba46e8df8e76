"""Quantiles and tail probabilities of Student's t, the normal and Fisher's F distribution.

The functions return the same values as `scipy.stats`, whose import takes a second.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from hil.core import FloatArray

Values = FloatArray | float


def student_quantile(probability: Values, degrees: Values) -> Any:
    """Return the quantile of Student's t distribution for a probability above 0.

    The returned array has the broadcast shape of the arguments.
    """
    return special.stdtrit(degrees, probability)


def normal_quantile(probability: Values) -> Any:
    """Return the quantile of the standard normal distribution for a probability."""
    return special.ndtri(probability)


def student_tail(value: Values, degrees: Values) -> Any:
    """Return the probability that a Student's t variable exceeds a value."""
    return special.stdtr(degrees, -np.asarray(value))


def fisher_tail(ratio: float, degrees: float, degrees_below: float) -> float:
    """Return the probability that a variable with Fisher's F distribution exceeds `ratio`.

    Args:
        ratio: Ratio of two variances [1]; a negative value due to rounding counts as 0.
        degrees: Number of degrees of freedom of the numerator.
        degrees_below: Number of degrees of freedom of the denominator.
    """
    return float(special.fdtrc(degrees, degrees_below, max(ratio, 0.0)))
