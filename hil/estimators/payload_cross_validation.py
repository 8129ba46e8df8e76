"""A load from one half of a recording, tested on the other: what the estimate is worth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, FloatArray
from hil.data import Dataset, sample_rate
from hil.estimators.base import RobotEstimator
from hil.estimators.payload_estimate import PayloadEstimate
from hil.estimators.payload_fit import estimate_payload
from hil.estimators.payload_problem import Friction, with_identified

GAP_S = 0.5
"""Rows so close to the cut are not fitted to: the filter of the effort sees across it."""


@dataclass(frozen=True, slots=True, eq=False)
class HalfTested:
    """An estimate and its errors on the half it did not see, against the effort as measured.

    Attributes:
        fitted: `first` or `second`, the half the load was fitted to.
        estimate: The load.
        rmse_raw: (n,) with the load.
        rmse_ignored: (n,) with nothing at the flange.
    """

    fitted: str
    estimate: PayloadEstimate
    rmse_raw: FloatArray
    rmse_ignored: FloatArray

    @property
    def mean_raw(self) -> float:
        """Mean over the joints."""
        return float(np.mean(self.rmse_raw))


def payload_halves(
    model: RobotEstimator, dataset: Dataset, *, friction: Friction | Literal["auto"] = "auto"
) -> tuple[HalfTested, HalfTested]:
    """Fit the load to each half of every series, test it on the other.

    The model sees the motion of the whole, as its memory of friction needs; the effort of the half
    tested, and of the rows next to the cut, is not looked at.

    Args:
        model: Fitted without the recording.
        dataset: Loaded recording, as measured (not yet filtered).
        friction: As in `estimate_payload`.
    """
    first, near = halves(dataset)
    return (
        _tested("first", model, dataset, first & ~near, ~first, friction),
        _tested("second", model, dataset, ~first & ~near, first, friction),
    )


def halves(dataset: Dataset) -> tuple[BoolArray, BoolArray]:
    """(N,) which rows are in the first half of their series, and which are near the cut."""
    first, near = np.zeros(len(dataset), dtype=bool), np.zeros(len(dataset), dtype=bool)
    for _, rows in dataset.slices():
        middle = (rows.start + rows.stop) // 2
        first[rows.start : middle] = True
        gap = int(np.ceil(GAP_S * sample_rate(dataset["t"][rows])))
        near[max(rows.start, middle - gap) : min(rows.stop, middle + gap)] = True
    return first, near


def _tested(
    fitted: str,
    model: RobotEstimator,
    dataset: Dataset,
    train: BoolArray,
    test: BoolArray,
    friction: Friction | Literal["auto"],
) -> HalfTested:
    estimate = estimate_payload(model, dataset, friction=friction, rows=train)
    bare = model.predict(with_identified(dataset, Payload()))
    loaded = model.predict(with_identified(dataset, estimate.payload))
    effort = loaded.effort + estimate.correction.of(loaded)
    rows = test & np.all(loaded.valid, axis=1)
    measured = dataset["effort"][rows]
    error, ignored = measured - effort[rows], measured - bare.effort[rows]
    return HalfTested(fitted, estimate, *(np.sqrt(np.mean(e**2, axis=0)) for e in (error, ignored)))
