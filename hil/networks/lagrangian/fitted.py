"""A Lagrangian network that is fitted: what it predicts, and how it is stored."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray
from hil.data import Dataset, FilterSettings, Prediction, Stream
from hil.estimators import (
    COULOMB,
    OFFSET,
    STATIC,
    VISCOUS,
    FrictionCurve,
    RobotEstimator,
    payload_torque,
    prepared,
    require_sizes,
)
from hil.networks.lagrangian.choices import Design
from hil.networks.lagrangian.direction import smooth_sign
from hil.networks.lagrangian.task import MOTION, directions
from hil.networks.training import Curves, require_torch

if TYPE_CHECKING:
    from hil.networks.lagrangian.model import NetworkModel


class LagrangianModel(RobotEstimator):
    """Base of `lagrangian`: all but how it is fitted.

    Attributes:
        design_: What the network looks like.
        weights_: Weights and scales of the network by name.
        torque_std_: (n,) standard deviation of the torque that was learned from [N·m].
        length_: (n,) in which Dahl's state comes round [rad]; None for the smooth sign.
        filters_: Those that were used.
        by_sample_: Whether a study drew rows to judge from the motions that were learned from.
        curves_: How the training went.
    """

    sign_width: float
    design_: Design
    weights_: dict[str, np.ndarray[Any, Any]]
    torque_std_: FloatArray
    length_: FloatArray | None
    filters_: FilterSettings
    by_sample_: bool = False
    curves_: Curves

    def predict(self, dataset: Dataset) -> Prediction:
        """Effort per row: `inertia`, `coriolis`, `gravity`, `friction`, `payload`.

        Raises:
            DataError: The data are of another robot or unit, or cannot be filtered.
        """
        self.require_match(dataset)
        data = prepared(dataset, self.filters_)
        return self._predict(data, directions(data, self.sign_width, self.length_))

    def stream(self, payload: Payload | None = None) -> Stream:
        """A predictor for one sample at a time; it filters nothing."""
        from hil.networks.lagrangian.predict import NetworkStream

        load = None
        if payload is not None and not payload.is_empty:
            load = partial(self.robot_.payload_effort, payload)
        return NetworkStream(
            self._network(), self.sign_width, self.length_, load, self.torque_scale_
        )

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """M(q) (N, n, n) as learned, symmetric and positive definite, at q (N, n) [kg·m²].

        Raises:
            DataError: The positions are not one number per joint.
        """
        from hil.networks.lagrangian.predict import mass_matrix

        n = self.robot_.n
        if np.ndim(q) != 2 or np.shape(q)[1] != n:
            raise DataError(
                f"positions have the shape {np.shape(q)}, but must be (N, {n})",
                hint="give a row per pose and a number per joint",
            )
        return mass_matrix(self._network(), q)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Friction at velocities (N, n) [rad/s]; None of Dahl's state, and of learned friction."""
        from hil.networks.lagrangian.predict import steady_friction

        kind = self.design_.kind
        if self.length_ is not None or kind not in ("coulomb", "stribeck"):
            return None
        width = 0.0 if self.design_.friction.sign == "hard" else self.sign_width
        direction, found = smooth_sign(qd, width), self.intrinsic_
        torque = steady_friction(self._network(), qd, direction)
        if kind == "coulomb":
            terms: tuple[str, ...] = (COULOMB, VISCOUS)
            viscous = found["f_v"] * qd
        else:
            terms = (COULOMB, STATIC, VISCOUS)
            viscous = direction * found["f_v"] * np.abs(qd) ** found["alpha"]
        if OFFSET in found:
            terms = (*terms, OFFSET)
        return FrictionCurve(torque, torque - viscous, np.full_like(torque, np.nan), terms)

    def _predict(self, data: Dataset, direction: FloatArray) -> Prediction:
        from hil.networks.lagrangian.predict import torques

        motion = tuple(data[name] for name in MOTION)
        parts = torques(self._network(), *motion, direction)
        parts["payload"] = payload_torque(self.robot_, data, *motion)
        parts = {name: part / self.torque_scale_ for name, part in parts.items()}
        effort: FloatArray = np.sum(list(parts.values()), axis=0)
        sigma = getattr(self, "sigma_", np.full(data.n_joints, np.nan))
        std = np.broadcast_to(sigma, effort.shape)
        return Prediction(effort, std, np.isfinite(effort), parts)

    def _network(self) -> NetworkModel:
        from hil.networks.lagrangian.stored import network_of

        return network_of(self.design_, self.torque_std_, self.weights_)

    @property
    def intrinsic_(self) -> dict[str, FloatArray]:
        """Friction parameters that mean something, each (n,), by name."""
        found: dict[str, FloatArray] = self._network().friction.intrinsic()
        return found

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Weights, torque scales, deviations and the lengths of Dahl's states."""
        from hil.networks.lagrangian import stored

        arrays = {
            "torque_std": self.torque_std_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }
        arrays = stored.named(self.weights_) | arrays
        return arrays if self.length_ is None else arrays | {"length": self.length_}

    def fitted_facts(self) -> dict[str, Any]:
        """The design, the filters, the friction's parameters and the learning curves."""
        intrinsic = {name: values.tolist() for name, values in self.intrinsic_.items()}
        return super().fitted_facts() | {
            "design": self.design_.facts(),
            "by_sample": self.by_sample_,
            "filters": self.filters_.model_dump(),
            "friction": intrinsic,
            "curves": self.curves_.to_dict(),
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote.

        Raises:
            KeyError, TypeError, ValueError, SpecError: Something is missing or cannot be.
            PluginError: The extra `learn` is missing.
        """
        require_torch()
        from hil.networks.lagrangian import stored

        self._restore_common(arrays, facts)
        self.design_ = Design.restored(facts["design"])
        self.filters_ = FilterSettings.model_validate(facts["filters"])
        self.by_sample_ = bool(facts["by_sample"])
        self.curves_ = Curves.from_dict(facts["curves"])
        self.torque_std_, self.length_ = arrays["torque_std"], arrays.get("length")
        self.weights_ = stored.unnamed(arrays)
        require_sizes(self, torque_std=self.robot_.n)
        if self.length_ is not None:
            _require_lengths(self.length_, self.robot_.n)
        self._network()


def _require_lengths(length: FloatArray, n: int) -> None:
    if length.shape != (n,) or not np.all(np.isfinite(length) & (length > 0.0)):
        raise ValueError(f"length: {length.tolist()!s:.60}")
