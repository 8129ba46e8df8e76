"""Leaving out samples that, after the low-pass filter, say nothing their neighbours do not."""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, DataError, FloatArray
from hil.data.dataset import Conditions, Dataset, rows_of
from hil.data.filtering.butterworth import CLOCK, MAX_NYQUIST_FRACTION, sample_rate
from hil.data.filtering.settings import FilterSettings

AT_REST = ("dwell", "reference")
"""Series kinds that stand still: too short to filter, and with nothing to differentiate."""

STRIDE = "stride"
"""Column (N,) of a down-sampled dataset: how many recorded samples each row stands for."""


def downsample(dataset: Dataset, settings: FilterSettings) -> Dataset:
    """The rows a fit uses: every so manyth of each motion, counted from its first.

    For fits only: predictions are of every row. Columns computed from neighbouring samples
    (filtered ones, states of friction) are added before.

    Args:
        dataset: Prepared with the same settings.
        settings: Their `every` or `rate_hz`; without either all rows stay.

    Raises:
        DataError: So few samples cannot tell what the filters let through.
    """
    if not settings.thins:
        return dataset
    stride = _strides(dataset, settings)
    return rows_of(dataset.with_columns(**{STRIDE: stride}), _kept(dataset, stride))


def kept_rows(dataset: Dataset, settings: FilterSettings) -> BoolArray:
    """(N,) the rows that `downsample` keeps; all of dwells and references.

    Raises:
        DataError: So few samples cannot tell what the filters let through.
    """
    return _kept(dataset, _strides(dataset, settings))


def stride_of(dataset: Dataset, rows: slice) -> float:
    """How many recorded samples each row of a series stands for: 1 before `downsample`."""
    return float(dataset.columns[STRIDE][rows.start]) if STRIDE in dataset.columns else 1.0


def motion_rates(dataset: Dataset) -> list[tuple[float, str]]:
    """Samples per second and id of every series of at least two samples that does not rest.

    Raises:
        DataError: Time does not increase.
    """
    return [
        (_rate(dataset, condition, rows), condition.id)
        for condition, rows in dataset.slices()
        if condition.kind not in AT_REST and rows.stop - rows.start > 1
    ]


def _rate(dataset: Dataset, condition: Conditions, rows: slice) -> float:
    try:
        return sample_rate(dataset["t"][rows])
    except DataError as error:
        raise DataError(f"series {condition.id}: {error.message}", hint=error.hint) from error


def _kept(dataset: Dataset, stride: FloatArray) -> BoolArray:
    within = np.arange(len(dataset)) - dataset.offsets[:-1][dataset.series_index()]
    return np.asarray(within % stride == 0)


def _strides(dataset: Dataset, settings: FilterSettings) -> FloatArray:
    """(N,) every how manyth sample of its series stays."""
    stride = np.ones(len(dataset))
    for condition, rows in dataset.slices():
        if condition.kind not in AT_REST and rows.stop - rows.start > 1:
            stride[rows] = _step(condition, dataset["t"][rows], settings)
    return stride


def _step(condition: Conditions, t: FloatArray, settings: FilterSettings) -> int:
    """Every how manyth sample stays."""
    rate = sample_rate(t)
    every = settings.every
    if settings.rate_hz is not None:
        every = max(1, round(rate / settings.rate_hz))
    present = (settings.velocity, settings.acceleration, settings.effort, settings.position)
    highest = max(cutoff for cutoff in present if cutoff is not None)
    passed = highest * 0.5 * rate if settings.unit == "nyquist" else highest
    # The same bound as that of the filter: what is beyond would come back as a lower frequency.
    most = max(1, int(MAX_NYQUIST_FRACTION * 0.5 * rate / passed * (1 + CLOCK)))
    if every > most:
        raise DataError(
            f"series {condition.id}: one sample in {every} at {rate:.4g} Hz is too few for "
            f"signals filtered at {passed:.4g} Hz",
            hint=f"keep one in {most} (every: {most}, or rate_hz: {rate / most:.4g}), "
            "or lower the cut-offs",
        )
    return every
