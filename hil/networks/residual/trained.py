"""A trained residual network: what it predicts for whole recordings, and its arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import DataError, FloatArray
from hil.estimators import with_prefix, without_prefix
from hil.networks.residual.inputs import InputScales, NetworkInputs
from hil.networks.residual.motions import RATE_TOLERANCE, Motions
from hil.networks.residual.settings import ResidualSettings
from hil.networks.residual.weights import TcnWeights

SCALES, WEIGHTS = "scales.", "weights."
"""What the names of arrays begin with."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainedTcn:
    """Predicts what a physical model leaves, in that model's unit of effort.

    Attributes:
        inputs: What it sees, and how that is scaled.
        weights: Of all groups and branches.
        scale: (branches, n) size of the slow and the fast part in the rows it learned from.
        rate_hz: Samples per second it was trained at; its memory counts samples.
        f_cut_hz: Where slow and fast were parted; 0 if they were not.
    """

    inputs: NetworkInputs
    weights: TcnWeights
    scale: FloatArray
    rate_hz: float
    f_cut_hz: float

    @property
    def settings(self) -> ResidualSettings:
        """Those it was trained with."""
        return self.inputs.settings

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.scale.shape[1])

    def predict(self, motions: Motions) -> FloatArray:
        """(N, n) residual of every row; memory is reset where a series begins.

        Raises:
            DataError: The torque it hears is not there, or samples are spaced otherwise.
        """
        return np.asarray(self.parts(motions).sum(axis=0))

    def parts(self, motions: Motions) -> FloatArray:
        """(branches, N, n): the slow and the fast part, or one for both.

        Raises:
            DataError: As `predict`.
        """
        if abs(motions.rate_hz / self.rate_hz - 1.0) > RATE_TOLERANCE:
            raise DataError(
                f"the residual network was trained at {self.rate_hz:.4g} Hz, "
                f"the samples come at {motions.rate_hz:.4g} Hz",
                hint="its memory counts samples: record at the same rate, or fit again",
            )
        inputs = self.inputs.of(motions)
        out = np.zeros((len(self.scale), len(motions), self.n))
        for rows in motions.slices():
            branched = np.tile(inputs[rows], (1, len(self.scale), 1))
            out[:, rows] = self._scaled(self.weights.series(branched))
        return out

    def _scaled(self, outputs: FloatArray) -> FloatArray:
        """(branches, N, n) from (N, G, O)."""
        parts = outputs.reshape(len(outputs), *self.scale.shape) * self.scale
        return np.asarray(parts.transpose(1, 0, 2))

    def to_arrays(self) -> dict[str, FloatArray]:
        """For a model file; `settings.to_json()` goes beside them."""
        scales = with_prefix(SCALES, self.inputs.scales.to_arrays())
        weights = with_prefix(WEIGHTS, self.weights.to_arrays())
        rates = {"rate_hz": np.array([self.rate_hz]), "f_cut_hz": np.array([self.f_cut_hz])}
        return {"scale": self.scale, **rates, **scales, **weights}

    @staticmethod
    def from_arrays(arrays: Mapping[str, FloatArray], settings: dict[str, Any]) -> TrainedTcn:
        """Inverse of `to_arrays`.

        Raises:
            DataError: Arrays are missing or do not fit each other.
            SpecError: The settings are not valid.
        """
        chosen = ResidualSettings.given(settings)
        missing = [name for name in ("scale", "rate_hz", "f_cut_hz") if name not in arrays]
        if missing:
            raise DataError(f"the residual network lacks {', '.join(missing)}")
        scale = np.asarray(arrays["scale"], dtype=np.float64)
        if scale.ndim != 2 or len(scale) != chosen.branches:
            raise DataError(f"the residual network's scale has the shape {scale.shape}")
        scales = InputScales.from_arrays(without_prefix(SCALES, arrays), chosen, scale.shape[1])
        weights = TcnWeights.from_arrays(without_prefix(WEIGHTS, arrays), chosen)
        weights.require(scale.shape, scales.lowest.shape)
        rate, f_cut = float(arrays["rate_hz"][0]), float(arrays["f_cut_hz"][0])
        if not (np.isfinite(rate) and rate > 0.0):
            raise DataError(f"the residual network's rate_hz is {rate:g}, but must be above 0")
        return TrainedTcn(NetworkInputs(chosen, scales), weights, scale, rate, f_cut)
