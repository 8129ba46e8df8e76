"""Columns of a regressor through the filter of what they explain.

A filtered effort has its reversals smeared over some samples. Columns that are not smeared alike
explain it with biased friction: filtering both sides of τ = W β by the same linear filter leaves β
where it was (parallel filtering, Gautier 1997).
"""

from __future__ import annotations

import numpy as np

from hil.data.dataset import Dataset
from hil.data.filters import AT_REST, FilterSettings, nyquist_fraction, sample_rate, zero_phase
from hil.typing import FloatArray


def filtered_like_effort(data: Dataset, values: FloatArray, settings: FilterSettings) -> FloatArray:
    """Values (N, …) filtered series by series as `hil.data.filters.prepare` filters the effort.

    Raises:
        DataError: A series is too short, or the cut-off too high for its rate.
    """
    out = np.array(values, dtype=np.float64)
    for condition, rows in data.slices():
        if condition.kind in AT_REST or rows.stop == rows.start:
            continue
        rate = sample_rate(data["t"][rows])
        fraction = nyquist_fraction(settings.effort, settings.unit, rate)
        out[rows] = zero_phase(values[rows], fraction, settings.order)
    return out
