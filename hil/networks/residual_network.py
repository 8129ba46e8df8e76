"""Estimator that combines physics with a small network for the residual.

Any estimator can provide the physics; the default is `rigid-hysteresis`. A causal convolutional
network (PINN paper, section III-C) learns the residual of the physics on trajectories to which the
physics was not fitted, at the full recorded rate. By default there is one network per joint, and
its inputs are the motion of that joint and no torque. A joint uses its network only if the network
lowers the error on trajectories to which neither the network nor the physics was fitted. The errors
on the held-out trajectories determine the error bands of the predictions. The held-out trajectories
also select the epoch whose weights are used. Errors, error bands and `coverage_` are therefore
slightly optimistic: all three are estimates, not guarantees.

A fit consists of three steps. `residual_selection.physics_of` distributes the trajectories over
folds and predicts each fold by physics fitted to the others. `residual_training.learn` trains the
networks and is the only step that needs torch. `residual_selection.Judged` decides which joints use
their network.
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
"""Name of the component that the network adds to a prediction."""


def _base(name: str, value: Any) -> dict[str, Any]:
    return mapping(name, BASE if value is None else value)


def _training(name: str, value: Any) -> dict[str, Any]:
    return TRAINING | mapping(name, value)


class ResidualNetwork(RobotEstimator):
    """Estimator that provides the physics, and a network for its residual.

    Attributes:
        base_: Fitted physics.
        correction_: Networks, and the joints for which they are used.
        selection_: Joints for which the networks are used, with the errors on which this decision
            is based.
        bands_: Half widths of the error bands per joint and speed range.
        coverage_: Share of held-out samples within the error bands; the same trajectories were used
            for early stopping of the networks.
        curves_: Learning curves of the first network.
        filters_: Filter settings for the inputs and the target of the network.
        by_sample_: Whether a study drew training rows and test rows from the same motions.
        watch_: Function that is called with every epoch of a fit; not stored.
        checkpoints_: Folder in which checkpoints are stored and from which trainings are resumed;
            not stored.
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
        None, _base, doc="Name (`estimator`) and parameters of the physical model."
    )
    inputs: str = parameter(
        "motion",
        as_given,
        doc="Torque inputs of the network: none (`motion`), `history` or `measured`.",
    )
    layout: str = parameter(
        "grouped",
        as_given,
        doc="`grouped` (one network per joint) or `joint` (one network for all joints).",
    )
    latency_s: float = parameter(
        0.02, as_given, doc="Minimum age of the newest torque input with `history` [s]."
    )
    network: dict[str, Any] = parameter(None, mapping, doc="Other fields of `ResidualSettings`.")
    training: dict[str, Any] = parameter(
        None,
        _training,
        doc="`TrainingSettings` that differ from the defaults of residual networks.",
    )
    folds: int = parameter(
        3,
        whole,
        at_least=1,
        doc="Number of parts of the trajectories; the physics and a network are fitted without "
        "each part. With 1, a single network is trained on the residual of the physics on "
        "its own data.",
    )
    margin: float = parameter(
        0.02,
        number,
        at_least=0.0,
        doc="Minimum relative reduction of a joint's error by its network on left-out "
        "trajectories.",
    )
    coverage: float = parameter(
        0.9,
        share,
        doc="Share of samples that the error bands are designed to contain; an estimate.",
    )
    validation_share: float = parameter(
        0.22,
        share,
        doc="Share of the trajectories that is used for early stopping if there are no folds.",
    )
    filters: FilterSettings | None = parameter(
        None,
        settings,
        FilterSettings,
        optional=True,
        doc="Filters of the network's inputs and targets; the physics has separate filters.",
    )
    seed: int = parameter(
        0,
        whole,
        at_least=0,
        at_most=MOST_SEED,
        doc="Random seed of folds, initial weights and mini-batches.",
    )

    def _check_together(self) -> None:
        self._settings()
        base_estimator(self.base)

    @property
    def protocol(self) -> str:
        """Evaluation protocol: `honest`, or the worst deviation by physics, rows or inputs."""
        base = self.base_ if hasattr(self, "base_") else base_estimator(self.base)
        # Report the worst deviation of the torque inputs, the physics and the rows.
        if self._network.inputs == "measured":
            return self._network.protocol
        if base.protocol != HONEST:
            return base.protocol
        return SAMPLE_SPLIT_PROTOCOL if self.by_sample_ else self._network.protocol

    def extras(self) -> dict[str, str]:
        """Return the optional extra for PyTorch and the extras that the physics needs."""
        name, needs = self.base["estimator"], base_estimator(self.base).extras()
        physics = {extra: f"by its base {name} {why}" for extra, why in needs.items()}
        return {**physics, **LEARN}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the requirements of a fit: enough samples, and the requirements of the physics.

        Raises:
            FitError: The physics does not support this robot.
        """
        return TO_TRAIN.also(needs_of(base_estimator(self.base), robot, loaded=loaded))

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the physics to all data, then without each fold, and then networks to the residuals.

        Raises:
            FitError: The data are too few, not finite, of a different robot or unit, or have
                different sample rates; the physics cannot be fitted to the data; or the training
                diverges.
            DataError: A series cannot be filtered, or no validation rows are left.
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
        """Fit networks to the residual of a fitted model, and set the parameter `base` to it.

        Args:
            base: Fitted model; the data of that fit may be these data or other data.
            dataset: Training data.
            robot: Robot model.
            refit: Whether models of the same kind as `base` are fitted without each fold, as in
                `fit`. By default `refit` is true, unless `base` is a trained network, because its
                training would take long. Without refits, selection and bands overestimate the
                accuracy of a `base` that was fitted to these data; the fitted model then has a note
                about the overestimate.

        Raises:
            FitError: The data are unusable for `fit`; or `base` is not fitted, or belongs to a
                different robot or unit.
            DataError, PluginError: The same conditions as in `fit` apply.
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
        """Return the prediction with the components of the physics and the component `residual`.

        The error bands determine the standard deviation of the prediction.

        Raises:
            DataError: The data have a different robot, unit or sample rate, or cannot be filtered.
        """
        self.require_match(dataset)
        base = self.base_.predict(dataset)
        data = prepared(dataset, self.filters_)
        added = self.correction_.predict(data, base.effort)
        parts = {**base.components, RESIDUAL: added}
        std = self.bands_.deviation(data["qd_f"])
        effort = base.effort + added
        # A missing value also invalidates the later rows whose window contains it.
        return Prediction(effort, std, base.valid & np.isfinite(effort), parts)

    def friction_curve(self, qd: FloatArray) -> FrictionCurve | None:
        """Return the friction curve of the physics.

        Returns:
            Friction curve; None if the physics has no friction curve or any joint uses its network.
        """
        if np.any(self.correction_.kept) or not isinstance(self.base_, HasFrictionCurve):
            return None
        return self.base_.friction_curve(qd)

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, which does not filter its inputs.

        Raises:
            FitError: The network has torque inputs, which a stream does not receive.
        """
        if self._network.inputs != "motion":
            raise FitError(
                f"a residual network with inputs: {self._network.inputs} cannot be streamed: a "
                "stream has only the motion as input",
                hint="fit with inputs: motion, or predict whole datasets",
            )
        return CorrectedStream(self.base_.stream(payload), self.correction_)

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return arrays of physics (prefix `base.`), networks, bands and standard deviations."""
        own = {"torque_scale": self.torque_scale_, "sigma": self.sigma_}
        networks = self.correction_.to_arrays() | self.bands_.to_arrays()
        return with_prefix(BASE_ARRAYS, self.base_.fitted_arrays()) | networks | own

    def fitted_facts(self) -> dict[str, Any]:
        """Return the facts of the physics, the network settings, and the selection."""
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
        """Restore the fit from the results of `fitted_arrays` and `fitted_facts`."""
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
        """Raise ValueError if the physics and its correction belong to different robots."""
        n = self.robot_.n
        found = (self.base_.joint_names_, self.base_.effort_kind_)
        if found != (self.joint_names_, self.effort_kind_):
            raise ValueError(f"base: {found!s:.80}")
        if not len(self.correction_.kept) == len(self.bands_.edges) == n:
            raise ValueError(f"kept: {len(self.correction_.kept)} joints, but the robot has {n}")
        if not np.array_equal(self.selection_.kept, self.correction_.kept):
            raise ValueError("selection: its joints are not those that kept their network")


class CorrectedStream:
    """Stream that evaluates the physics, and then the networks, which receive the physics' result.

    Args:
        base: Stream of the physics.
        correction: Networks without torque inputs.
    """

    def __init__(self, base: Stream, correction: Correction) -> None:
        self._base, self._correction = base, correction
        wanted = correction.networks if np.any(correction.kept) else ()
        self._rings = [RingTcn(network) for network in wanted]

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Return the predicted effort (n,) for one sample; each input has the shape (n,).

        Raises:
            DataError: An input does not have one number per joint.
        """
        effort = self._base.step(q, qd, qdd)
        if not self._rings:
            return effort
        mean = np.mean([ring.step(q, qd, qdd, effort) for ring in self._rings], axis=0)
        return np.asarray(effort + self._correction.bounded(mean))


BASE_ARRAYS = "base."
"""Prefix of the names of all arrays of the physics in a model file."""


def base_estimator(base: dict[str, Any]) -> RobotEstimator:
    """Return an unfitted estimator for the physics from its name and parameters.

    Raises:
        PluginError: There is no estimator with the passed name.
        SpecError: The name is missing, a parameter is unknown, or its value is invalid.
    """
    if not isinstance(base.get("estimator"), str):
        raise SpecError(
            f"base is {base!r:.60}, but must contain the name of the physical model (`estimator`)",
            hint="for example base: {estimator: rigid-hysteresis}",
        )
    params = {name: value for name, value in base.items() if name != "estimator"}
    return estimator(base["estimator"], **params)


def require_base(model: RobotEstimator, dataset: Dataset, robot: RobotModel) -> None:
    """Raise if a fitted model cannot be the physics for the data of this fit.

    Raises:
        FitError: The model is not fitted, or belongs to a different robot, unit or gravity.
    """
    try:
        model.require_match(dataset)
    except DataError as error:
        raise FitError(f"base: {error.message}", hint=error.hint) from error
    if model.robot_.name != robot.name:
        raise FitError(
            f"base was fitted for the robot model {model.robot_.name}, but this robot is "
            f"{robot.name}",
            hint="use a base model of the same robot",
        )


def restored_base(
    arrays: dict[str, FloatArray], facts: dict[str, Any], robot: RobotModel
) -> RobotEstimator:
    """Return the physics from the arrays of a model file and the entry `base` of its facts.

    Raises:
        KeyError, TypeError, ValueError: An entry of the model file is missing or invalid.
    """
    model = estimator(str(facts["estimator"]), **facts["parameters"])
    model.robot_ = robot
    own = without_prefix(BASE_ARRAYS, arrays)
    require_finite_arrays(own)
    model.restore(own, facts["fitted"])
    require_sound(model)
    return model


CUTOFF_HZ = 50.0
"""Cut-off frequency of inputs and target [Hz], as in the PINN paper; high enough for reversals."""

MOST_OF_NYQUIST = 0.4


def filters_for(dataset: Dataset) -> FilterSettings:
    """Return filter settings of 50 Hz for all signals, or less if the sample rate is low."""
    slowest = min(rate for rate, _ in motion_rates(dataset))
    highest = min(CUTOFF_HZ, 0.5 * MOST_OF_NYQUIST * slowest)
    cutoff = round(highest, 2) or highest
    return FilterSettings(unit="hz", velocity=cutoff, acceleration=cutoff, effort=cutoff)


def notes_of(
    data: Dataset, physics: Physics, learnt: Learnt, judged: Judged, network: ResidualSettings
) -> tuple[str, ...]:
    """Return notes on the physics, the selection, and the comparison with a trivial predictor."""
    by_sample, unit = has_sample_split(data), data.effort_unit
    left_out = "left-out samples" if by_sample else "left-out trajectories"
    notes = [*physics.model.notes_, *judged.selection.notes(data.joint_names, unit, left_out)]
    if np.all(physics.fold == NO_FOLD):
        notes.append(
            f"{physics.model.estimator} was possibly fitted to the trajectories that selected "
            "its residual network: the error bands are too narrow"
        )
    if by_sample:
        notes.append(
            "evaluated rows lie between training rows, and the zero-phase filter mixed their "
            "torque into these: errors are those of interpolation within known motions, not of "
            "new motions"
        )
    if network.inputs == "motion":
        return tuple(notes)
    # A network with torque inputs must be better than holding its newest torque input. Both errors
    # refer to the same rows and to the same torque signal: as recorded, or filtered.
    rate = learnt.networks[0].rate_hz
    lag = max(1, network.lag(rate))
    name, how = "effort", "as recorded"
    if network.inputs == "measured":
        name, how = "effort_f", "filtered"
    # Half a sample less, so that jitter of the time stamps does not select an older sample.
    held = persistence(data, (lag - 0.5) / rate, name)
    rows = learnt.judged & np.all(np.isfinite(held), axis=1)
    ours = physics.predicted + judged.correction.bounded(learnt.correction)
    trivial, model = (float(np.mean(rmse(data[name][rows], of[rows]))) for of in (held, ours))
    notes.append(
        f"holding the torque that was measured {1e3 * lag / rate:.4g} ms earlier has an error of "
        f"{trivial:.3g} {unit} on {left_out} (mean over joints, torque {how}), this model "
        f"{model:.3g}"
    )
    return tuple(notes)
