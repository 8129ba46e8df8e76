"""Inverse dynamics by a network that obeys Euler and Lagrange, with friction beside it.

Methods 4 to 6 and the proposed one of the PINN paper: M(q) and the potential of gravity come from
one network, their torque from the Lagrangian equation (eq. 8), and friction from a few intrinsic
parameters per joint (eq. 15–18), trained together or by turns (Algorithm 1). `friction` says which
method it is; `protocol: paper` takes the paper's settings at their word.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from hil.data import BY_SAMPLE, Dataset, FilterSettings, SeriesKind, rows_of, told_by_sample
from hil.dynamics import RobotModel
from hil.estimators import (
    HONEST,
    MOST_SEED,
    Needs,
    choice,
    mapping,
    number,
    prepared,
    require_clean,
    require_motion,
    require_plausible,
    require_robot,
    settings,
    share,
    torque_scale,
    whole,
)
from hil.networks.lagrangian import choices
from hil.networks.lagrangian.direction import DIRECTION
from hil.networks.lagrangian.fitted import LagrangianModel
from hil.networks.lagrangian.friction_settings import FRICTIONS
from hil.networks.lagrangian.task import Preparation
from hil.networks.training import LEARN, TO_TRAIN, TrainingSettings, require_torch

if TYPE_CHECKING:
    from hil.networks.training import Watch


class LagrangianEstimator(LagrangianModel):
    """A deep Lagrangian network with friction.

    Args:
        friction: `none`, `coulomb`, `stribeck`, `dissipative` or `unconstrained`.
        learning: `hybrid` (Algorithm 1) or `joint`.
        loops: Of hybrid learning.
        direction: What friction takes for the sign of the motion: `smooth`, tanh(qd/sign_width), or
            `dahl`, a state with memory whose length is fitted per joint.
        sign_width: Of the smooth sign [rad/s]; 0 for the hard sign.
        protocol: Whose settings: `ours`, or `paper` for all it prints, word by word.
        network: `NetworkSettings` that are to be others.
        friction_settings: `FrictionSettings` that are to be others.
        training: `TrainingSettings` that are to be others.
        validation_share: Of the trajectories, held out to stop by.
        seed: Of the start, the mini-batches and the trajectories held out.
        filters: Preprocessing of training and prediction alike; by default 50 Hz, and 125 rows per
            second to learn from.

    Attributes:
        sigma_: (n,) RMSE at the trajectories held out, against the measured effort.
        watch_: Told every epoch of a fit; not stored.
        checkpoints_: Folder in which a fit is kept while it runs; not stored.
    """

    estimator: ClassVar[str] = "lagrangian"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

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

    @property
    def protocol(self) -> str:
        """`honest`, unless rows to learn from and to judge were drawn from the same motions.

        What the parameter of that name chose is settings, not rows: `get_params` has it.
        """
        return BY_SAMPLE if self.by_sample_ else HONEST

    @protocol.setter
    def protocol(self, settings_of: str) -> None:
        self._settings_of = settings_of

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The parameters as given."""
        return super().get_params(deep) | {"protocol": self._settings_of}

    def extras(self) -> dict[str, str]:
        """PyTorch."""
        return LEARN

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: samples to train with, and drive gains."""
        return TO_TRAIN

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to every series given; declared loads are subtracted from the target.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, or hold efforts
                that cannot be; or the training diverges.
            DataError: A series cannot be filtered, or nothing is left to stop by.
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
        from hil.networks.lagrangian.fit import fit_network

        self.by_sample_ = told_by_sample(data)
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

    def _settings(self) -> tuple[choices.Design, TrainingSettings]:
        friction = choices.friction_settings(
            self._settings_of, self.sign_width, self.friction_settings
        )
        design = choices.design(self.friction, self._settings_of, self.network, friction)
        training = choices.training_settings(
            self._settings_of, self.loops, self.seed, self.training
        )
        return design, training
