"""Predictions of fitted models, for a whole dataset or for one sample at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from hil.core import BoolArray, FloatArray
from hil.data.dataset import Dataset


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Predicted efforts of a model, in the effort unit of the dataset.

    Attributes:
        effort: (N, n) predicted effort.
        components: Effort components by name, whose sum is `effort` (`gravity`, `inertia`,
            `friction`, …).
        std: (N, n) standard deviation of the prediction; NaN if the model does not provide it.
        valid: (N, n) mask that is false for rows in which the model is not valid (warm-up of its
            memory, or outside the range of the training data).
    """

    effort: FloatArray
    std: FloatArray
    valid: BoolArray
    components: Mapping[str, FloatArray] = field(default_factory=dict)


class Stream(Protocol):
    """Predictor that receives one sample at a time; each stream has a separate friction memory."""

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the predicted effort (n,) for one sample; each input has the shape (n,)."""


class Model(Protocol):
    """Interface of a fitted model, as returned by `Estimator.fit` and stored in the registry."""

    @property
    def estimator(self) -> str:
        """Name under which the estimator is registered (`hil.estimators`)."""

    def predict(self, dataset: Dataset) -> Prediction:
        """Return the predictions of all rows; every series starts without friction memory."""

    def stream(self) -> Stream:
        """Return a predictor for one sample at a time."""
