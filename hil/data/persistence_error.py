"""The trivial observer: what was measured a moment ago is measured still.

Whoever may look at past torque has to beat this. At 1 kHz, and after filters without phase shift,
which put the future into the past, torque a few milliseconds old is nearly the answer; a model
with such an input says something only where it is better than its input alone.
"""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, FloatArray, SpecError
from hil.data.dataset import Dataset
from hil.data.metrics import rmse

ROUNDING_S = 1e-6
"""Time stamps that differ by less are the same: 20 steps of 1 ms are 20 ms."""


def persistence(dataset: Dataset, latency_s: float, column: str = "effort") -> FloatArray:
    """(N, n) the newest value that is at least `latency_s` old; NaN before there is one.

    Args:
        dataset: Series by series; nothing is carried over from one to the next.
        latency_s: Age of the newest value that is known [s], above 0.
        column: What is held.

    Raises:
        SpecError: The latency is not above 0: that would be the answer itself.
        DataError: There is no such column.
    """
    if not (np.isfinite(latency_s) and latency_s > 0):
        raise SpecError(
            f"a latency of {latency_s!r} s is none",
            hint="state how old the newest torque is when a prediction is made, 0.02 for 20 ms",
        )
    values = dataset[column]
    held = np.full_like(values, np.nan, dtype=np.float64)
    for _, rows in dataset.slices():
        t = dataset["t"][rows]
        newest = np.searchsorted(t, t - latency_s + ROUNDING_S, side="right") - 1
        known = newest >= 0
        held[rows][known] = values[rows][newest[known]]
    return held


def persistence_rmse(
    dataset: Dataset, latency_s: float, column: str = "effort", rows: BoolArray | None = None
) -> FloatArray:
    """(n,) error of `persistence`, where it says something, in the unit of the column.

    Args:
        dataset: What is judged.
        latency_s: See `persistence`.
        column: What is held, and judged against.
        rows: (N,) those that are judged; all by default.
    """
    held = persistence(dataset, latency_s, column)
    judged = np.all(np.isfinite(held), axis=1)
    if rows is not None:
        judged &= rows
    return rmse(dataset[column][judged], held[judged])
