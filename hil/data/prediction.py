"""Predictions: what every model returns, for a whole dataset or one sample at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from hil.core import BoolArray, FloatArray
from hil.data.dataset import Dataset


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Predicted efforts in the unit of the dataset they were predicted for.

    Attributes:
        effort: (N, n).
        components: Named parts that add up to `effort` (`gravity`, `inertia`, `friction`, …).
        std: (N, n) one standard deviation, NaN where the model cannot say.
        valid: (N, n) false where the model must not be used (warm-up of its memory, outside
            the range it was fitted on).
    """

    effort: FloatArray
    std: FloatArray
    valid: BoolArray
    components: Mapping[str, FloatArray] = field(default_factory=dict)


class Stream(Protocol):
    """A model fed one sample at a time; friction memory starts afresh with every stream."""

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the predicted effort (n,) for one sample, each input (n,)."""


class Model(Protocol):
    """A fitted model: what `Estimator.fit` returns and the registry stores."""

    @property
    def estimator(self) -> str:
        """Name under which the estimator is registered (`hil.estimators`)."""

    def predict(self, dataset: Dataset) -> Prediction:
        """Return predictions of all rows; friction memory is reset at the start of every series."""

    def stream(self) -> Stream:
        """Return a predictor for one sample at a time."""
