"""Estimator of the inverse dynamics: a Lagrangian network with a separate friction model.

This module implements methods 4 to 6 and the proposed method of the PINN paper. One network yields
M(q) and the gravity potential; the Lagrangian equation (eq. 8) turns them into torque. The Stribeck
friction model has a few intrinsic parameters per joint (eq. 15–18). The Lagrangian network and the
friction model are trained together, or alternately as in Algorithm 1 of the PINN paper. The
parameter `friction` selects one of the methods of the PINN paper. With `protocol: paper` all
settings are those of the PINN paper.

`lagrangian_settings` turns estimator parameters into settings, `lagrangian_data` turns a dataset
into training data, and `lagrangian` contains the network. The module `lagrangian` imports torch, so
only methods that compute with the network import `lagrangian`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray
from hil.data import (
    MOTION,
    SAMPLE_SPLIT_PROTOCOL,
    Dataset,
    FilterSettings,
    Prediction,
    SeriesKind,
    Stream,
    has_sample_split,
    rows_of,
)
from hil.dynamics import RobotModel
from hil.estimators import (
    COULOMB,
    HONEST,
    MOST_SEED,
    OFFSET,
    STATIC,
    VISCOUS,
    FrictionCurve,
    Needs,
    RobotEstimator,
    choice,
    mapping,
    number,
    payload_torque,
    prepared,
    require_clean,
    require_motion,
    require_plausible,
    require_robot,
    require_sizes,
    settings,
    share,
    torque_scale,
    whole,
    with_prefix,
    without_prefix,
)
from hil.networks import lagrangian_settings as choices
from hil.networks.lagrangian_data import DIRECTION, Preparation, directions, smooth_sign
from hil.networks.lagrangian_settings import FRICTIONS, Design
from hil.networks.training import LEARN, TO_TRAIN, Curves, TrainingSettings, Watch, require_torch

if TYPE_CHECKING:
    from hil.networks.lagrangian import NetworkModel


WEIGHTS = "network."
"""Prefix of the name of every weight in a model file."""


class LagrangianEstimator(RobotEstimator):
    """Estimator of a deep Lagrangian network with friction.

    Args:
        friction: Friction model: `none`, `coulomb`, `stribeck`, `dissipative` or `unconstrained`.
        learning: Training schedule: `hybrid` (Algorithm 1) or `joint`.
        loops: Number of loops of hybrid learning.
        direction: Quantity that replaces the sign of the motion in the friction law: `smooth`,
            tanh(qd/sign_width), or `dahl`, a state with memory whose length is fitted per joint.
        sign_width: Width of the smooth sign [rad/s]; 0 for the hard sign.
        protocol: Source of the default settings: `ours`, or `paper` for exactly the settings of the
            PINN paper.
        network: Mapping of the `NetworkSettings` that differ from the defaults.
        friction_settings: Mapping of the `FrictionSettings` that differ from the defaults.
        training: Mapping of the `TrainingSettings` that differ from the defaults.
        validation_share: Share of the trajectories held out for early stopping.
        seed: Seed of the start weights, the mini-batches and the choice of held-out trajectories.
        filters: Filter settings for training and prediction; by default the cut-off is 50 Hz and
            125 training rows per second are retained, if the recording is fast enough.

    Attributes:
        design_: Design of the network.
        weights_: Weights and scales of the network by name.
        torque_std_: (n,) standard deviation of the torque in the training rows [N·m].
        length_: (n,) characteristic length of Dahl's state [rad]; None if the direction is the
            smooth sign.
        filters_: Filter settings that were used in the fit.
        by_sample_: Whether a study drew test rows from the same motions as the training rows.
        curves_: Learning curves.
        sigma_: (n,) RMSE on the held-out trajectories, relative to the measured effort.
        watch_: Function that is called with every epoch of a fit; not stored.
        checkpoints_: Folder for the checkpoints of a running fit; not stored.
    """

    estimator: ClassVar[str] = "lagrangian"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

    design_: Design
    weights_: dict[str, np.ndarray[Any, Any]]
    torque_std_: FloatArray
    length_: FloatArray | None
    filters_: FilterSettings
    by_sample_: bool = False
    curves_: Curves
    watch_: Watch | None = None
    checkpoints_: Path | None = None

    def __init__(
        self,
        *,
        friction: str = "stribeck",
        learning: str = "hybrid",
        loops: int = 3,
        direction: str = "smooth",
        sign_width: float = 0.01,
        protocol: str = "ours",
        network: Mapping[str, Any] | None = None,
        friction_settings: Mapping[str, Any] | None = None,
        training: Mapping[str, Any] | None = None,
        validation_share: float = 0.22,
        seed: int = 0,
        filters: FilterSettings | dict[str, Any] | None = None,
    ) -> None:
        self.friction = choice("friction", friction, FRICTIONS)
        self.learning = choice("learning", learning, choices.LEARNING)
        self.loops = whole("loops", loops, at_least=1, at_most=1000)
        self.direction = choice("direction", direction, choices.DIRECTIONS)
        self.sign_width = number("sign_width", sign_width, at_least=0.0)
        self.protocol = choice("protocol", protocol, choices.PROTOCOLS)
        self.network = mapping("network", network)
        self.friction_settings = mapping("friction_settings", friction_settings)
        self.training = mapping("training", training)
        self.validation_share = share("validation_share", validation_share)
        self.seed = whole("seed", seed, at_least=0, at_most=MOST_SEED)
        self.filters = None if filters is None else settings("filters", filters, FilterSettings)
        design, _ = self._settings()
        choices.require_agreement(self._settings_of, self.direction, design.friction)

    def _settings(self) -> tuple[Design, TrainingSettings]:
        protocol, friction = self._settings_of, {"rest_speed": self.sign_width}
        design = choices.design(
            self.friction, protocol, self.network, friction | self.friction_settings
        )
        training = choices.training_settings(protocol, self.loops, self.seed, self.training)
        return design, training

    @property
    def protocol(self) -> str:
        """Evaluation protocol: `honest`, or sample split if test and training rows share motions.

        The constructor parameter `protocol` only selects settings; `get_params` returns the
        constructor parameter.
        """
        return SAMPLE_SPLIT_PROTOCOL if self.by_sample_ else HONEST

    @protocol.setter
    def protocol(self, settings_of: str) -> None:
        self._settings_of = settings_of

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the parameters that were passed to the constructor."""
        return super().get_params(deep) | {"protocol": self._settings_of}

    def extras(self) -> dict[str, str]:
        """Return the optional extra that provides PyTorch."""
        return LEARN

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum requirements of a fit: enough samples, and drive gains."""
        return TO_TRAIN

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to every series of the dataset, after subtracting the torque of declared loads.

        Raises:
            FitError: The data are too few, not finite, of a different robot or unit, or contain
                implausible efforts; or the training diverges.
            DataError: A series cannot be filtered, or no validation rows are left.
            PluginError: The extra `learn` is missing.
        """
        require_torch()
        require_robot(dataset, robot)
        scale = torque_scale(dataset)
        require_clean(dataset, ("t", "q", "effort"))
        require_plausible(dataset, robot)
        self.needs(robot).require(samples=len(dataset))
        require_motion(dataset)
        self._remember(dataset, robot, scale)
        self.filters_ = self.filters or choices.filters_for(dataset)
        self._learn(prepared(dataset, self.filters_))
        return self

    def _learn(self, data: Dataset) -> None:
        from hil.networks.lagrangian import fit_network

        self.by_sample_ = has_sample_split(data)
        design, training = self._settings()
        preparation = Preparation(
            self.filters_, self.direction == "dahl", self.sign_width,
            self.validation_share, self.seed,
        )  # fmt: skip
        task = preparation.task(data, self.torque_scale_, self.robot_)
        stages = choices.stages(self.learning, self.friction, training)
        trials = choices.trials(self.friction, self._settings_of, training)
        best = fit_network(task, design, stages, trials, self.watch_, self.checkpoints_)
        self.weights_, self.curves_, self.notes_ = best.weights, best.curves, best.notes
        self.design_, self.torque_std_, self.length_ = design, task.torque_std, task.length
        self.samples_ = int(np.sum(task.learn))
        held_out = rows_of(task.data, task.validate)
        found = self._predict(held_out, held_out[DIRECTION])
        self.sigma_ = np.sqrt(np.mean((held_out["effort"] - found.effort) ** 2, axis=0))

    def predict(self, dataset: Dataset) -> Prediction:
        """Return the predicted effort of every row and the parts of that effort.

        The parts of the effort are `inertia`, `coriolis`, `gravity`, `friction` and `payload`.

        Raises:
            DataError: The data belong to a different robot or unit, or cannot be filtered.
        """
        self.require_match(dataset)
        data = prepared(dataset, self.filters_)
        return self._predict(data, directions(data, self.sign_width, self.length_))

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, which does not filter its inputs."""
        from hil.networks.lagrangian import NetworkStream

        load = None
        if payload is not None and not payload.is_empty:
            load = partial(self.robot_.payload_effort, payload)
        return NetworkStream(
            self._network(), self.sign_width, self.length_, load, self.torque_scale_
        )

    def mass_matrix(self, q: FloatArray) -> FloatArray:
        """Return the learned M(q) (N, n, n) [kg·m²], symmetric and positive definite, at q (N, n).

        Raises:
            DataError: The positions do not have one number per joint.
        """
        from hil.networks.lagrangian import mass_matrix

        n = self.robot_.n
        if np.ndim(q) != 2 or np.shape(q)[1] != n:
            raise DataError(
                f"positions have the shape {np.shape(q)}, but must be (N, {n})",
                hint="pass one row per pose and one number per joint",
            )
        return mass_matrix(self._network(), q)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Return friction at velocities (N, n) [rad/s].

        Returns:
            Friction curve; None for Dahl's state and for friction other than `coulomb` or
            `stribeck`.
        """
        from hil.networks.lagrangian import steady_friction

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
        from hil.networks.lagrangian import torques

        motion = tuple(data[name] for name in MOTION)
        parts = torques(self._network(), *motion, direction)
        parts["payload"] = payload_torque(self.robot_, data, *motion)
        parts = {name: part / self.torque_scale_ for name, part in parts.items()}
        effort: FloatArray = np.sum(list(parts.values()), axis=0)
        sigma = getattr(self, "sigma_", np.full(data.n_joints, np.nan))
        std = np.broadcast_to(sigma, effort.shape)
        return Prediction(effort, std, np.isfinite(effort), parts)

    def _network(self) -> NetworkModel:
        from hil.networks.lagrangian import network_of

        return network_of(self.design_, self.torque_std_, self.weights_)

    @property
    def intrinsic_(self) -> dict[str, FloatArray]:
        """Friction parameters with a physical meaning, by name, each (n,)."""
        found: dict[str, FloatArray] = self._network().friction.intrinsic()
        return found

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return weights, torque scales, standard deviations and lengths of Dahl's states."""
        arrays = {
            "torque_std": self.torque_std_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }
        arrays = with_prefix(WEIGHTS, self.weights_) | arrays
        return arrays if self.length_ is None else arrays | {"length": self.length_}

    def fitted_facts(self) -> dict[str, Any]:
        """Return the design, the filters, the friction parameters and the learning curves."""
        intrinsic = {name: values.tolist() for name, values in self.intrinsic_.items()}
        return super().fitted_facts() | {
            "design": self.design_.facts(),
            "by_sample": self.by_sample_,
            "filters": self.filters_.model_dump(),
            "friction": intrinsic,
            "curves": self.curves_.to_dict(),
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fit from the results of `fitted_arrays` and `fitted_facts`.

        Raises:
            KeyError, TypeError, ValueError, SpecError: An entry of the arrays or facts is missing
                or invalid.
            PluginError: The extra `learn` is missing.
        """
        require_torch()
        self._restore_common(arrays, facts)
        self.design_ = Design.restored(facts["design"])
        self.filters_ = FilterSettings.model_validate(facts["filters"])
        self.by_sample_ = bool(facts["by_sample"])
        self.curves_ = Curves.from_dict(facts["curves"])
        self.torque_std_, self.length_ = arrays["torque_std"], arrays.get("length")
        self.weights_ = without_prefix(WEIGHTS, arrays)
        require_sizes(self, torque_std=self.robot_.n)
        length = self.length_
        if length is not None and (
            length.shape != (self.robot_.n,) or not np.all(np.isfinite(length) & (length > 0.0))
        ):
            raise ValueError(f"length: {length.tolist()!s:.60}")
        self._network()
