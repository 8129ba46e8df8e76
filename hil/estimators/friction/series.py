"""The motion of every series of a dataset, ready for friction columns."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hil.core import FloatArray
from hil.data import (
    AT_REST,
    Conditions,
    Dataset,
    FilterSettings,
    nyquist_fraction,
    sample_rate,
    zero_phase,
)
from hil.estimators.friction.motion import FrictionMotion, Shapes


def motions(
    dataset: Dataset,
    steps: FloatArray,
    transmitted: FloatArray,
    shapes: Shapes,
    usual: FloatArray | None = None,
) -> Iterator[tuple[Conditions, slice, FrictionMotion]]:
    """Conditions, rows and motion of every series that has rows.

    Args:
        dataset: Prepared.
        steps: (N, n) from `path_steps` [rad].
        transmitted: (N, n) torque through the gears [N·m].
        shapes: Of the friction.
        usual: (n,) joint temperatures where none were recorded.
    """
    celsius = temperatures(dataset, usual)
    for condition, rows in dataset.slices():
        if rows.stop > rows.start:
            yield (
                condition,
                rows,
                FrictionMotion(
                    dataset["q"][rows],
                    dataset["qd_f"][rows],
                    transmitted[rows],
                    shapes,
                    steps[rows],
                    None if celsius is None else celsius[rows],
                ),
            )


def temperatures(dataset: Dataset, usual: FloatArray | None) -> FloatArray | None:
    """(N, n) recorded joint temperatures, the usual ones where there are none."""
    recorded = dataset.columns.get("temperature")
    if usual is None:
        return recorded
    if recorded is None:
        return np.broadcast_to(usual, dataset["q"].shape)
    return np.where(np.isfinite(recorded), recorded, usual)


def usual_temperatures(dataset: Dataset) -> FloatArray | None:
    """(n,) median joint temperatures; None where they were not recorded throughout."""
    recorded = dataset.columns.get("temperature")
    if recorded is None or not len(recorded) or not np.all(np.isfinite(recorded)):
        return None
    return np.asarray(np.median(recorded, axis=0))


def temperatures_vary(dataset: Dataset, least_k: float = 1.0) -> bool:
    """Whether joint temperatures were recorded and changed by `least_k` or more in some joint."""
    celsius = dataset.columns.get("temperature")
    if celsius is None or not np.all(np.isfinite(celsius)) or not len(celsius):
        return False
    return bool(np.max(np.ptp(celsius, axis=0)) >= least_k)


def smoothed(
    values: FloatArray,
    condition: Conditions,
    t: FloatArray,
    settings: FilterSettings,
    *,
    cutoff: float | None = None,
) -> FloatArray:
    """Columns (N, …) of one series through a low-pass filter; at rest as they are.

    Args:
        values: A row per sample.
        condition: Of the series.
        t: (N,) [s].
        settings: Order and unit of the filter.
        cutoff: By default that of the effort the columns are to explain.
    """
    if condition.kind in AT_REST:
        return values
    chosen = settings.effort if cutoff is None else cutoff
    fraction = nyquist_fraction(chosen, settings.unit, sample_rate(t))
    return zero_phase(values, fraction, settings.order)
