"""A fitted physics with its correction: predicting, streaming, and the model file."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FitError, FloatArray
from hil.data import Dataset, FilterSettings, Prediction, Stream
from hil.estimators import (
    FrictionCurve,
    HasFrictionCurve,
    RobotEstimator,
    SpeedBands,
    prepared,
    whole,
)
from hil.networks.residual.correction import Correction
from hil.networks.residual.selection import Selection
from hil.networks.residual.settings import ResidualSettings
from hil.networks.residual.stored import arrays_of_base, facts_of_base, restored_base
from hil.networks.residual.streaming import CorrectedStream
from hil.networks.residual.words import protocol_of
from hil.networks.training import Curves

RESIDUAL = "residual"
"""Component of a prediction that the network adds."""


class CorrectedModel(RobotEstimator):
    """What `ResidualNetwork.fit` leaves behind.

    Attributes:
        base_: The fitted physics.
        correction_: The networks, and the joints they were kept for.
        selection_: The errors that decided it.
        bands_: Half widths per joint and speed range.
        coverage_: What such bands hold of left-out trajectories, by which networks were stopped.
        curves_: How the training of the first network went.
        filters_: Of the network's inputs and of what it learned.
        by_sample_: Whether rows to learn from and to judge were drawn from the same motions.
    """

    base_: RobotEstimator
    correction_: Correction
    selection_: Selection
    bands_: SpeedBands
    coverage_: dict[str, Any]
    curves_: Curves
    filters_: FilterSettings
    by_sample_: bool = False

    _network: ResidualSettings

    def predict(self, dataset: Dataset) -> Prediction:
        """The components of the physics, and `residual`; `std` from the bands.

        Raises:
            DataError: The data are of another robot, unit or sample rate, or cannot be filtered.
        """
        self.require_match(dataset)
        base = self.base_.predict(dataset)
        data = prepared(dataset, self.filters_)
        added = self.correction_.predict(data, base.effort)
        parts = {**base.components, RESIDUAL: added}
        std = self.bands_.deviation(data["qd_f"])
        effort = base.effort + added
        # What is missing in one row is missing in the memory of those after it.
        return Prediction(effort, std, base.valid & np.isfinite(effort), parts)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """That of the physics, if it has one and no joint kept its network."""
        if np.any(self.correction_.kept) or not isinstance(self.base_, HasFrictionCurve):
            return None
        return self.base_.friction_curve(qd)

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time; nothing is filtered.

        Raises:
            FitError: The network hears torque, which a stream is not told.
        """
        if self._network.inputs != "motion":
            raise FitError(
                f"a residual network with inputs: {self._network.inputs} cannot be streamed: a "
                "stream knows the motion only",
                hint="fit with inputs: motion, or predict whole datasets",
            )
        return CorrectedStream(self.base_.stream(payload), self.correction_)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Those of the physics under `base.`, the networks', bands and deviations."""
        own = {"torque_scale": self.torque_scale_, "sigma": self.sigma_}
        networks = self.correction_.to_arrays() | self.bands_.to_arrays()
        return arrays_of_base(self.base_) | networks | own

    def fitted_facts(self) -> dict[str, Any]:
        """The physics, the settings of the networks, and what decided."""
        return super().fitted_facts() | {
            "base": facts_of_base(self.base_),
            "residual": self._network.to_json(),
            "networks": len(self.correction_.networks),
            "selection": self.selection_.facts(self.joint_names_),
            "margin": self.selection_.margin,
            "coverage": self.coverage_,
            "filters": self.filters_.model_dump(),
            "by_sample": self.by_sample_,
            "curves": self.curves_.to_dict(),
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
        self._restore_common(arrays, facts)
        self.base_ = restored_base(arrays, facts["base"], self.robot_)
        count = whole("networks", facts["networks"], at_least=1)
        self.correction_ = Correction.from_arrays(arrays, facts["residual"], count)
        self._network = self.correction_.settings
        self.bands_ = SpeedBands.from_arrays(arrays)
        self.selection_ = Selection.from_facts(facts["selection"], float(facts["margin"]))
        self.coverage_ = dict(facts["coverage"])
        self.filters_ = FilterSettings.model_validate(facts["filters"])
        self.by_sample_ = bool(facts["by_sample"])
        self.curves_ = Curves.from_dict(facts["curves"])
        self._require_together()

    def _require_together(self) -> None:
        """Raise ValueError if the physics and its correction are of different robots."""
        n = self.robot_.n
        found = (self.base_.joint_names_, self.base_.effort_kind_)
        if found != (self.joint_names_, self.effort_kind_):
            raise ValueError(f"base: {found!s:.80}")
        if not len(self.correction_.kept) == len(self.bands_.edges) == n:
            raise ValueError(f"kept: {len(self.correction_.kept)} joints where the robot has {n}")
        if not np.array_equal(self.selection_.kept, self.correction_.kept):
            raise ValueError("selection: not the joints that kept their network")

    def _protocol(self, base: str) -> str:
        return protocol_of(base, self._network, by_sample=self.by_sample_)
