"""Quantiles and tails of Student's t, the normal and Fisher's F distribution.

They are those of `scipy.stats`, to the last bit, which takes a second to import.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from hil.core import FloatArray

Values = FloatArray | float


def student_quantile(probability: Values, degrees: Values) -> Any:
    """Return the value that Student's t is below with a probability above 0, shaped alike."""
    return special.stdtrit(degrees, probability)


def normal_quantile(probability: Values) -> Any:
    """Return the value that a standard normal variable is below with this probability."""
    return special.ndtri(probability)


def student_tail(value: Values, degrees: Values) -> Any:
    """Return the probability that Student's t exceeds a value."""
    return special.stdtr(degrees, -np.asarray(value))


def fisher_tail(ratio: float, degrees: float, degrees_below: float) -> float:
    """Return the probability that Fisher's F exceeds a ratio of two variances.

    Args:
        ratio: Of the two variances [1]; one that rounding has made negative counts as 0.
        degrees: Of freedom of the numerator.
        degrees_below: Of freedom of the denominator.
    """
    return float(special.fdtrc(degrees, degrees_below, max(ratio, 0.0)))
