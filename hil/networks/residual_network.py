"""Physics first, then a small network for what it leaves, kept only where it helps.

Any estimator can be the physics; by default `rigid-hysteresis`. What it leaves of trajectories it
was not fitted to is learned, at the full recorded rate, by a causal convolutional network (PINN
paper, section III-C): by default one per joint, which sees the motion of that joint and no torque.
Joint by joint, the network is kept if it lowers the error on trajectories that neither it nor the
physics was fitted to; the same errors give the bands that predictions carry. These trajectories
chose the epoch at which the network stopped, too, so errors, bands and `coverage_` are slightly
better than those on trajectories that had no part in it: an estimate, not a guarantee.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from hil.data import Dataset, FilterSettings, told_by_sample
from hil.dynamics import RobotModel
from hil.estimators import (
    MOST_SEED,
    Needs,
    RobotEstimator,
    mapping,
    needs_of,
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
from hil.networks.residual.fit import Course, learn, require_one_rate
from hil.networks.residual.fitted import CorrectedModel
from hil.networks.residual.judged import Judged
from hil.networks.residual.out_of_fold import Physics, physics_of
from hil.networks.residual.settings import GROUP, TRAINING, ResidualSettings
from hil.networks.residual.stored import made, require_base, told
from hil.networks.residual.words import filters_for, words
from hil.networks.training import (
    LEARN,
    TO_TRAIN,
    TrainingSettings,
    attach_inside,
    require_groups,
    require_torch,
)

if TYPE_CHECKING:
    from hil.networks.training import Watch

BASE = {"estimator": "rigid-hysteresis"}


class ResidualNetwork(CorrectedModel):
    """An estimator as physics, and a network for what it leaves.

    Args:
        base: Name (`estimator`) and parameters of the physics.
        inputs: What the network hears of torque: `motion` (nothing), `history` or `measured`.
        layout: `grouped` (one per joint) or `joint` (one for all).
        latency_s: How old the newest torque of `history` is [s].
        network: Any other of `ResidualSettings`.
        training: `TrainingSettings` that are to be others than usual for residual networks.
        folds: Parts the trajectories are dealt into; the physics and a network are fitted without
            each. With 1 a single network is trained on what the physics leaves of its own data.
        margin: Share of a joint's error that its network must save on left-out trajectories.
        coverage: Share of samples that the bands are made for; an estimate.
        validation_share: Of the trajectories, to stop by where there are no folds.
        filters: Of the network's inputs and of what it learns; the physics has its own.
        seed: Of folds, start weights and mini-batches.

    Attributes:
        watch_: Told every epoch while it fits; not stored.
        checkpoints_: Folder to keep trainings in and to take them up from; not stored.
    """

    estimator: ClassVar[str] = "residual"

    watch_: Watch | None = None
    checkpoints_: Path | None = None

    def __init__(
        self,
        *,
        base: Mapping[str, Any] | None = None,
        inputs: str = "motion",
        layout: str = "grouped",
        latency_s: float = 0.02,
        network: Mapping[str, Any] | None = None,
        training: Mapping[str, Any] | None = None,
        folds: int = 3,
        margin: float = 0.02,
        coverage: float = 0.9,
        validation_share: float = 0.22,
        filters: FilterSettings | dict[str, Any] | None = None,
        seed: int = 0,
    ) -> None:
        self.base = mapping("base", BASE if base is None else base)
        self.inputs, self.layout, self.latency_s = inputs, layout, latency_s
        self.network = mapping("network", network)
        self.training = TRAINING | mapping("training", training)
        self.folds = whole("folds", folds, at_least=1)
        self.margin = number("margin", margin, at_least=0.0)
        self.coverage = share("coverage", coverage)
        self.validation_share = share("validation_share", validation_share)
        self.filters = None if filters is None else settings("filters", filters, FilterSettings)
        self.seed = whole("seed", seed, at_least=0, at_most=MOST_SEED)
        self._settings()
        made(self.base)

    @property
    def protocol(self) -> str:
        """`honest`, or how the physics, the rows or what the network hears depart from that."""
        base = self.base_ if hasattr(self, "base_") else made(self.base)
        return self._protocol(base.protocol)

    def extras(self) -> dict[str, str]:
        """PyTorch, and what the physics needs."""
        name, needs = self.base["estimator"], made(self.base).extras()
        physics = {extra: f"by its base {name} {why}" for extra, why in needs.items()}
        return {**physics, **LEARN}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: samples to train with, and what its physics needs.

        Raises:
            FitError: The physics model does not support this robot.
        """
        return TO_TRAIN.also(needs_of(made(self.base), robot, loaded=loaded))

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the physics, once more without each fold, then networks to what they leave.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, of different
                sample rates, or the physics cannot be fitted to them; or the training diverges.
            DataError: A series cannot be filtered, or nothing is left to stop by.
            PluginError: The extra `learn` is missing.
        """
        self._require(dataset, robot)
        base = self._fitted_base(dataset, robot, "physics")
        return self._correct(base, dataset, robot, self.folds)

    def fit_on(
        self,
        base: RobotEstimator,
        dataset: Dataset,
        robot: RobotModel,
        *,
        refit: bool | None = None,
    ) -> Self:
        """Correct a model that is fitted already, which `base` then describes.

        Args:
            base: Fitted to these data or to others.
            dataset: To learn from.
            robot: The robot model.
            refit: Fit models like it without each fold, as `fit` does; by default unless it is a
                trained network, which would take long. Without, selection and bands take a model
                that has learned from these data to be better than it is, and a note says so.

        Raises:
            FitError: As `fit`, or `base` is not fitted, or to another robot or unit.
            DataError, PluginError: As `fit`.
        """
        self._require(dataset, robot)
        require_base(base, dataset, robot)
        self.base = told(base)
        again = not hasattr(base, "curves_") if refit is None else refit
        return self._correct(base, dataset, robot, self.folds if again else 1)

    def _correct(
        self, base: RobotEstimator, dataset: Dataset, robot: RobotModel, folds: int
    ) -> Self:
        self._remember(dataset, robot, base.torque_scale_)

        def without(part: Dataset, fold: int) -> RobotEstimator:
            return self._fitted_base(part, robot, f"fold-{fold + 1}")

        physics = physics_of(dataset, base, folds, self.seed, without)
        self.filters_ = self.filters or filters_for(dataset)
        self._learn(prepared(dataset, self.filters_), physics)
        return self

    def _fitted_base(self, data: Dataset, robot: RobotModel, name: str) -> RobotEstimator:
        base = made(self.base)
        attach_inside(base, self, name)
        return base.fit(data, robot)

    def _learn(self, data: Dataset, physics: Physics) -> None:
        self._network, training = self._settings()
        course = Course(
            self._network, training, self.validation_share, self.seed, self.watch_,
            self.checkpoints_,
        )  # fmt: skip
        learnt = learn(data, physics, course)
        judged = Judged.of(data, physics, learnt, self.margin, self.coverage)
        self.base_, self.by_sample_ = physics.model, told_by_sample(data)
        self.selection_, self.bands_ = judged.selection, judged.bands
        self.correction_, self.coverage_ = judged.correction, judged.coverage
        self.sigma_, self.curves_ = judged.sigma, learnt.curves[0]
        self.samples_ = int(np.count_nonzero(learnt.used))
        self.notes_ = words(data, physics, learnt, judged, self._network)

    def _settings(self) -> tuple[ResidualSettings, TrainingSettings]:
        heard = {"inputs": self.inputs, "layout": self.layout, "latency_s": self.latency_s}
        self._network = ResidualSettings.given(heard | self.network)
        training = settings("training", self.training, TrainingSettings)
        require_groups("training.group_rates has", training.group_rates, (GROUP,))
        return self._network, training

    def _require(self, dataset: Dataset, robot: RobotModel) -> None:
        require_torch()
        require_robot(dataset, robot)
        torque_scale(dataset)
        require_clean(dataset, ("t", "q", "effort"))
        require_plausible(dataset, robot)
        TO_TRAIN.require(samples=len(dataset))
        require_motion(dataset)
        require_one_rate(dataset)
