"""Physics first, then a small network for what it leaves, kept only where it helps.

Any estimator can be the physics; by default `rigid-hysteresis`. What it leaves of trajectories it
was not fitted to is learned, at the full recorded rate, by a causal convolutional network (PINN
paper, section III-C): by default one per joint, which sees the motion of that joint and no torque.
Joint by joint, the network is kept if it lowers the error on trajectories that neither it nor the
physics was fitted to; the same errors give the bands that predictions carry. These trajectories
chose the epoch at which the network stopped, too, so errors, bands and `coverage_` are slightly
better than those on trajectories that had no part in it: an estimate, not a guarantee.

The parts of a fit: `residual_selection.physics_of` deals the trajectories into folds and predicts
each by physics fitted to the others; `residual_training.learn` trains the networks (the only step
that needs torch); `residual_selection.Judged` decides which joints keep theirs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FitError, FloatArray, SpecError
from hil.data import (
    SAMPLE_SPLIT_PROTOCOL,
    Dataset,
    FilterSettings,
    Prediction,
    Stream,
    has_sample_split,
    motion_rates,
    persistence,
    rmse,
)
from hil.dynamics import RobotModel
from hil.estimators import (
    HONEST,
    MOST_SEED,
    FrictionCurve,
    HasFrictionCurve,
    Needs,
    RobotEstimator,
    SpeedBands,
    as_given,
    estimator,
    mapping,
    needs_of,
    number,
    parameter,
    prepared,
    require_clean,
    require_motion,
    require_plausible,
    require_robot,
    require_sound,
    settings,
    share,
    torque_scale,
    whole,
    with_prefix,
    without_prefix,
)
from hil.networks.residual_data import GROUP, TRAINING, ResidualSettings, require_one_rate
from hil.networks.residual_selection import (
    NO_FOLD,
    Correction,
    Judged,
    Learnt,
    Physics,
    Selection,
    physics_of,
)
from hil.networks.residual_tcn import RingTcn, require_finite_arrays
from hil.networks.training import (
    LEARN,
    TO_TRAIN,
    Curves,
    TrainingSettings,
    Watch,
    attach_inside,
    require_groups,
    require_torch,
)

BASE = {"estimator": "rigid-hysteresis"}

RESIDUAL = "residual"
"""Component of a prediction that the network adds."""


def _base(name: str, value: Any) -> dict[str, Any]:
    return mapping(name, BASE if value is None else value)


def _training(name: str, value: Any) -> dict[str, Any]:
    return TRAINING | mapping(name, value)


class ResidualNetwork(RobotEstimator):
    """An estimator as physics, and a network for what it leaves.

    Attributes:
        base_: The fitted physics.
        correction_: The networks, and the joints they were kept for.
        selection_: The errors that decided it.
        bands_: Half widths per joint and speed range.
        coverage_: What such bands hold of left-out trajectories, by which networks were stopped.
        curves_: How the training of the first network went.
        filters_: Of the network's inputs and of what it learned.
        by_sample_: Whether rows to learn from and to judge were drawn from the same motions.
        watch_: Told every epoch while it fits; not stored.
        checkpoints_: Folder to keep trainings in and to take them up from; not stored.
    """

    estimator: ClassVar[str] = "residual"

    base_: RobotEstimator
    correction_: Correction
    selection_: Selection
    bands_: SpeedBands
    coverage_: dict[str, Any]
    curves_: Curves
    filters_: FilterSettings
    by_sample_: bool = False

    _network: ResidualSettings
    watch_: Watch | None = None
    checkpoints_: Path | None = None

    base: dict[str, Any] = parameter(
        None, _base, doc="Name (`estimator`) and parameters of the physics."
    )
    inputs: str = parameter(
        "motion",
        as_given,
        doc="What the network hears of torque: `motion` (nothing), `history` or `measured`.",
    )
    layout: str = parameter(
        "grouped", as_given, doc="`grouped` (one per joint) or `joint` (one for all)."
    )
    latency_s: float = parameter(
        0.02, as_given, doc="How old the newest torque of `history` is [s]."
    )
    network: dict[str, Any] = parameter(None, mapping, doc="Any other of `ResidualSettings`.")
    training: dict[str, Any] = parameter(
        None,
        _training,
        doc="`TrainingSettings` that are to be others than usual for residual networks.",
    )
    folds: int = parameter(
        3,
        whole,
        at_least=1,
        doc="Parts the trajectories are dealt into; the physics and a network are fitted without "
        "each. With 1 a single network is trained on what the physics leaves of its own data.",
    )
    margin: float = parameter(
        0.02,
        number,
        at_least=0.0,
        doc="Share of a joint's error that its network must save on left-out trajectories.",
    )
    coverage: float = parameter(
        0.9, share, doc="Share of samples that the bands are made for; an estimate."
    )
    validation_share: float = parameter(
        0.22, share, doc="Of the trajectories, to stop by where there are no folds."
    )
    filters: FilterSettings | None = parameter(
        None,
        settings,
        FilterSettings,
        optional=True,
        doc="Of the network's inputs and of what it learns; the physics has its own.",
    )
    seed: int = parameter(
        0, whole, at_least=0, at_most=MOST_SEED, doc="Of folds, start weights and mini-batches."
    )

    def _check_together(self) -> None:
        self._settings()
        base_estimator(self.base)

    @property
    def protocol(self) -> str:
        """`honest`, or how the physics, the rows or what the network hears depart from that."""
        base = self.base_ if hasattr(self, "base_") else base_estimator(self.base)
        # The least honest of what the network hears, the physics, and the rows.
        if self._network.inputs == "measured":
            return self._network.protocol
        if base.protocol != HONEST:
            return base.protocol
        return SAMPLE_SPLIT_PROTOCOL if self.by_sample_ else self._network.protocol

    def extras(self) -> dict[str, str]:
        """PyTorch, and what the physics needs."""
        name, needs = self.base["estimator"], base_estimator(self.base).extras()
        physics = {extra: f"by its base {name} {why}" for extra, why in needs.items()}
        return {**physics, **LEARN}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: samples to train with, and what its physics needs.

        Raises:
            FitError: The physics model does not support this robot.
        """
        return TO_TRAIN.also(needs_of(base_estimator(self.base), robot, loaded=loaded))

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
        self.base = {"estimator": base.estimator, **base.get_params()}
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
        base = base_estimator(self.base)
        attach_inside(base, self, name)
        return base.fit(data, robot)

    def _learn(self, data: Dataset, physics: Physics) -> None:
        from hil.networks.residual_training import Course, learn

        self._network, training = self._settings()
        course = Course(
            self._network, training, self.validation_share, self.seed, self.watch_,
            self.checkpoints_,
        )  # fmt: skip
        learnt = learn(data, physics, course)
        judged = Judged.of(data, physics, learnt, self.margin, self.coverage)
        self.base_, self.by_sample_ = physics.model, has_sample_split(data)
        self.selection_, self.bands_ = judged.selection, judged.bands
        self.correction_, self.coverage_ = judged.correction, judged.coverage
        self.sigma_, self.curves_ = judged.sigma, learnt.curves[0]
        self.samples_ = int(np.count_nonzero(learnt.used))
        self.notes_ = notes_of(data, physics, learnt, judged, self._network)

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
        return with_prefix(BASE_ARRAYS, self.base_.fitted_arrays()) | networks | own

    def fitted_facts(self) -> dict[str, Any]:
        """The physics, the settings of the networks, and what decided."""
        return super().fitted_facts() | {
            "base": {
                "estimator": self.base_.estimator,
                "parameters": self.base_.get_params(),
                "fitted": self.base_.fitted_facts(),
            },
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


class CorrectedStream:
    """Steps the physics, then networks with ring buffers on what it says.

    Args:
        base: Stream of the physics.
        correction: Networks that hear no torque.
    """

    def __init__(self, base: Stream, correction: Correction) -> None:
        self._base, self._correction = base, correction
        wanted = correction.networks if np.any(correction.kept) else ()
        self._rings = [RingTcn(network) for network in wanted]

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,).

        Raises:
            DataError: An input is not one number per joint.
        """
        effort = self._base.step(q, qd, qdd)
        if not self._rings:
            return effort
        mean = np.mean([ring.step(q, qd, qdd, effort) for ring in self._rings], axis=0)
        return np.asarray(effort + self._correction.bounded(mean))


BASE_ARRAYS = "base."
"""Arrays of the base model begin with it."""


def base_estimator(base: dict[str, Any]) -> RobotEstimator:
    """A fresh base estimator from its name and parameters.

    Raises:
        PluginError: There is no estimator of that name.
        SpecError: It is not named, has no such parameter, or does not accept the value.
    """
    if not isinstance(base.get("estimator"), str):
        raise SpecError(
            f"base is {base!r:.60}, but must name the physics with `estimator`",
            hint="base: {estimator: rigid-hysteresis}",
        )
    params = {name: value for name, value in base.items() if name != "estimator"}
    return estimator(base["estimator"], **params)


def require_base(model: RobotEstimator, dataset: Dataset, robot: RobotModel) -> None:
    """Refuse a fitted model that cannot be the physics of these data.

    Raises:
        FitError: It is not fitted, or is of another robot, unit or gravity.
    """
    try:
        model.require_match(dataset)
    except DataError as error:
        raise FitError(f"base: {error.message}", hint=error.hint) from error
    if model.robot_.name != robot.name:
        raise FitError(
            f"base was fitted for the robot model {model.robot_.name}, not for {robot.name}",
            hint="correct a model of the same robot",
        )


def restored_base(
    arrays: dict[str, FloatArray], facts: dict[str, Any], robot: RobotModel
) -> RobotEstimator:
    """Return the physics from the arrays of a model file and the entry `base` of its facts.

    Raises:
        KeyError, TypeError, ValueError: Something is missing or garbled.
    """
    model = estimator(str(facts["estimator"]), **facts["parameters"])
    model.robot_ = robot
    own = without_prefix(BASE_ARRAYS, arrays)
    require_finite_arrays(own)
    model.restore(own, facts["fitted"])
    require_sound(model)
    return model


CUTOFF_HZ = 50.0
"""Of inputs and of what is learned, as in the PINN paper: reversals are quick."""

MOST_OF_NYQUIST = 0.4


def filters_for(dataset: Dataset) -> FilterSettings:
    """50 Hz over everything, less where samples are few."""
    slowest = min(rate for rate, _ in motion_rates(dataset))
    highest = min(CUTOFF_HZ, 0.5 * MOST_OF_NYQUIST * slowest)
    cutoff = round(highest, 2) or highest
    return FilterSettings(unit="hz", velocity=cutoff, acceleration=cutoff, effort=cutoff)


def notes_of(
    data: Dataset, physics: Physics, learnt: Learnt, judged: Judged, network: ResidualSettings
) -> tuple[str, ...]:
    """Return notes for the model: of the physics, the selection, and the trivial observer."""
    by_sample, unit = has_sample_split(data), data.effort_unit
    left_out = "left-out samples" if by_sample else "left-out trajectories"
    notes = [*physics.model.notes_, *judged.selection.notes(data.joint_names, unit, left_out)]
    if np.all(physics.fold == NO_FOLD):
        notes.append(
            f"{physics.model.estimator} may have learned from the trajectories by which its "
            "residual network was selected: bands are narrower than they should be"
        )
    if by_sample:
        notes.append(
            "rows that are judged lie between rows learned from, and the filter without phase "
            "shift brought their torque into these: errors tell how gaps in known motions are "
            "filled, nothing of new ones"
        )
    if network.inputs == "motion":
        return tuple(notes)
    # A network that hears torque must beat the torque of a moment ago, taken as it is. Both errors
    # are of the same rows, and on the torque that is heard: as recorded, or filtered.
    rate = learnt.networks[0].rate_hz
    lag = max(1, network.lag(rate))
    name, how = "effort", "as recorded"
    if network.inputs == "measured":
        name, how = "effort_f", "filtered"
    # Half a sample less: stamps that jitter must not make it hold an older one.
    held = persistence(data, (lag - 0.5) / rate, name)
    rows = learnt.judged & np.all(np.isfinite(held), axis=1)
    ours = physics.predicted + judged.correction.bounded(learnt.correction)
    trivial, model = (float(np.mean(rmse(data[name][rows], of[rows]))) for of in (held, ours))
    notes.append(
        f"holding the torque measured {1e3 * lag / rate:.4g} ms before has an error of "
        f"{trivial:.3g} {unit} on {left_out} (mean over joints, torque {how}), "
        f"this model {model:.3g}"
    )
    return tuple(notes)
