"""Settings, stages and learning curves of gradient training; independent of torch.

An estimator that trains a network creates a `Problem` (the network with its data in memory) and the
order in which its parts are trained (`Stage`). The estimator passes the problem, the stages and
`TrainingSettings` to `hil.networks.training_loop.train`, which imports torch. The function `train`
reports every epoch (`Told`) to a `Watch` and returns `Curves`. This module does not import torch;
settings can therefore be checked, models read and curves drawn without torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, Self, runtime_checkable

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from hil.core import SpecError, did_you_mean, plugins
from hil.estimators import MOST_SEED, Needs, Whole

if TYPE_CHECKING:
    import torch

    from hil.core import HilError


LossKind = Literal["smape", "smape-floored", "huber", "mae", "mse"]
Schedule = Literal["cosine", "constant"]
Precision = Literal["float32", "float64"]
DeviceName = Annotated[str, StringConstraints(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]


class TrainingSettings(BaseModel):
    """Training settings: mini-batches, optimiser, stopping criteria and device.

    The default settings are those that converged fastest in CPU time on a simulated six-joint arm.

    Attributes:
        epochs: Maximum number of epochs, for all stages together.
        batch_size: Number of samples per optimiser step.
        learning_rate: Maximum learning rate of Adam (Kingma and Ba 2015).
        schedule: Learning-rate schedule: with `cosine`, the rate decreases to `final_rate` in every
            stage; with `constant`, the rate stays unchanged.
        final_rate: Learning rate at the end of the cosine, as a share of `learning_rate`.
        warm_up_steps: Number of steps at the start of every stage in which the rate rises linearly.
        group_rates: Factors on the learning rate, by parameter group.
        clip_norm: Maximum norm of the gradient; longer gradients are scaled to this norm. With
            `clip_norm` None the gradient is not clipped.
        weight_decay: Weight decay, decoupled from the gradient (Loshchilov and Hutter 2019). Only
            matrices decay; coefficients with a unit are not reduced towards 0.
        patience: Number of epochs without a lower validation error after which a stage ends.
        loops: Number of loops of hybrid learning; each loop is joint learning, then learning of the
            dynamics alone.
        inner_share: Number of epochs of learning the dynamics alone, per epoch of joint learning in
            a loop.
        outer_share: Number of epochs of learning the dynamics alone after the last loop, per epoch
            of joint learning in a loop.
        loop_rate: Factor by which the learning rate changes from one loop to the next.
        loss: Error measure that is minimised, see `hil.networks.training_loop.Loss`.
        seed: Seed of the order of mini-batches and of all random numbers of the network.
        device: Device of the training: `auto` (the GPU if there is one, else the CPU), `cpu`,
            `cuda` or `cuda:1`.
        precision: Number type of weights and data.
        amp: Whether matrix products use bfloat16 (automatic mixed precision).
        threads: Number of CPU threads of torch during training. Training of small networks is not
            faster with more threads; with a fixed number of threads, the sums do not depend on the
            number of cores.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    epochs: Whole = Field(100, ge=1, le=10**6)
    batch_size: Whole = Field(64, ge=1, le=10**9)
    learning_rate: float = Field(2e-3, gt=0, allow_inf_nan=False)
    schedule: Schedule = "cosine"
    final_rate: float = Field(0.02, ge=0, le=1)
    warm_up_steps: Whole = Field(50, ge=0, le=10**9)
    group_rates: dict[str, Annotated[float, Field(gt=0, allow_inf_nan=False)]] = {}
    clip_norm: float | None = Field(10.0, gt=0, allow_inf_nan=False)
    weight_decay: float = Field(0.0, ge=0, allow_inf_nan=False)
    patience: Whole = Field(25, ge=1, le=10**9)
    loops: Whole = Field(3, ge=1, le=1000)
    inner_share: float = Field(0.4, gt=0, allow_inf_nan=False)
    outer_share: float = Field(0.6, gt=0, allow_inf_nan=False)
    loop_rate: float = Field(0.6, gt=0, le=1)
    loss: LossKind = "smape-floored"
    seed: Whole = Field(0, ge=0, le=MOST_SEED)
    device: DeviceName = "auto"
    precision: Precision = "float32"
    amp: bool = False
    threads: Whole = Field(1, ge=1, le=1024)

    @model_validator(mode="after")
    def _amp_is_of_float32(self) -> Self:
        if self.amp and self.precision != "float32":
            raise ValueError("amp combines float32 with bfloat16, so precision must be float32")
        return self

    @classmethod
    def literal(cls, **changed: object) -> Self:
        """Return the PINN paper's settings: batch size 50, learning rate 5e-4, SMAPE of eq. (20).

        Techniques that the PINN paper does not mention are disabled.
        """
        printed: dict[str, object] = {
            "batch_size": 50,
            "learning_rate": 5e-4,
            "schedule": "constant",
            "warm_up_steps": 0,
            "clip_norm": None,
            "loop_rate": 1.0,
            "loss": "smape",
        }
        return cls.model_validate(printed | changed)


DYNAMICS, FRICTION = "dynamics", "friction"
"""Names of the parameter groups of a Lagrangian network with friction."""


@dataclass(frozen=True, slots=True)
class Stage:
    """Stage of a training.

    Attributes:
        name: Name of the stage, which is displayed and stored in the learning curves.
        trains: Names of the parameter groups that are trained, while all others are frozen; if
            empty, all groups are trained.
        epochs: Maximum number of epochs.
        patience: Number of epochs without a lower validation error after which the stage ends.
        learning_rate_factor: Factor on the learning rate of the training settings.
    """

    name: str
    trains: tuple[str, ...]
    epochs: int
    patience: int
    learning_rate_factor: float = 1.0


def joint_stages(settings: TrainingSettings, name: str = "joint") -> tuple[Stage, ...]:
    """Return a single stage in which all parameters are trained."""
    return (Stage(name, (), settings.epochs, settings.patience),)


def hybrid_stages(settings: TrainingSettings) -> tuple[Stage, ...]:
    """Return the stages of Algorithm 1 of the PINN paper.

    Each loop trains all parameters jointly and then the dynamics alone; after the last loop the
    dynamics are trained again. Lines 4 to 10 of Algorithm 1 are the joint stage of a loop, lines 11
    to 17 the inner stage with frozen friction, and lines 19 to 25 the outer stage. The patience of
    the stages implements the condition "until the loss function converges" of Algorithm 1.

    Args:
        settings: Training settings, whose `epochs` are distributed over all stages.
    """
    count, alone = settings.loops, (DYNAMICS,)
    unit = settings.epochs / (count * (1.0 + settings.inner_share) + settings.outer_share)

    def stage(name: str, trains: tuple[str, ...], epochs: float, loop: int) -> Stage:
        rate = settings.loop_rate**loop
        return Stage(name, trains, max(1, round(epochs)), settings.patience, rate)

    stages = []
    for loop in range(count):
        stages += [
            stage(f"loop {loop + 1}: joint", (), unit, loop),
            stage(f"loop {loop + 1}: dynamics", alone, settings.inner_share * unit, loop),
        ]
    return (*stages, stage("outer: dynamics", alone, settings.outer_share * unit, count))


def require_groups(who: str, named: Iterable[str], groups: Collection[str]) -> None:
    """Raise if a parameter group does not exist in the network.

    Args:
        who: Start of the error message, which names the setting that contains the group names.
        named: Group names in that setting.
        groups: Names of the existing groups.

    Raises:
        SpecError: One of the named groups does not exist.
    """
    for name in named:
        if name not in groups:
            raise SpecError(
                f"{who} {name!r}, but the network has the groups {', '.join(groups)}",
                hint=did_you_mean(name, tuple(groups)),
            )


class Problem(Protocol):
    """Training problem: a network with its data in memory.

    Attributes:
        module: Network to be trained; a checkpoint stores its state dict and early stopping
            restores it.
        samples: Number of samples (rows, or segments of a motion) from which mini-batches are
            drawn.
    """

    module: torch.nn.Module
    samples: int

    def groups(self) -> Mapping[str, Sequence[torch.nn.Parameter]]:
        """Return the parameters by the group name with which a stage trains or freezes them."""

    def loss(self, chosen: torch.Tensor) -> torch.Tensor:
        """Return the differentiable mean loss over the samples with the numbers (B,)."""

    def validate(self) -> float:
        """Return the prediction error on data that are not used for training; lower is better."""


@dataclass(frozen=True, slots=True)
class Told:
    """Report of one epoch, which a `Watch` receives and the learning curves store.

    Attributes:
        stage: Name of the stage.
        epoch: Number of the epoch within the whole training, from 1.
        epochs: Maximum number of epochs of the training.
        loss: Mean training loss over the epoch.
        validation: Result of `Problem.validate` after the epoch.
        best: Lowest validation error so far.
        learning_rate: Learning rate of the network's parameters.
    """

    stage: str
    epoch: int
    epochs: int
    loss: float
    validation: float
    best: float
    learning_rate: float


Watch = Callable[[Told], None]


@runtime_checkable
class KeptIfPossible(Protocol):
    """`Watch` that lets a training continue if checkpoints can no longer be written."""

    def not_kept(self, error: HilError) -> None:
        """Handle the reason why no further checkpoints of the training are written."""


@runtime_checkable
class HearsBeginning(Protocol):
    """`Watch` that is also called before the first epoch, which can take minutes."""

    def began(self, what: str) -> None:
        """Handle the description of the training, which names the model and the amount of data."""


def unwatched(told: Told) -> None:
    """Ignore an epoch; this function is the default `Watch`."""


BARS = "▁▂▃▄▅▆▇█"


@dataclass(slots=True)
class Curves:
    """Learning curves: loss and validation error per epoch.

    Attributes:
        untrained: Validation error before the first step.
        stage: Name of the stage to which every epoch belongs.
        loss: Mean training loss of every epoch.
        validation: Validation error after every epoch.
        learning_rate: Learning rate at the end of every epoch.
    """

    untrained: float
    stage: list[str] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)
    learning_rate: list[float] = field(default_factory=list)

    @property
    def best(self) -> float:
        """Lowest validation error, including that of the untrained network."""
        return min([self.untrained, *self.validation])

    @property
    def best_epoch(self) -> int:
        """Number of the epoch with the lowest validation error; 0 is the untrained network."""
        everything = [self.untrained, *self.validation]
        return everything.index(min(everything))

    def __len__(self) -> int:
        return len(self.loss)

    def last(self, epochs: int) -> list[float]:
        """Return the validation errors of the last `epochs` epochs."""
        return self.validation[len(self.validation) - epochs :]

    def add(self, told: Told) -> None:
        """Append one epoch."""
        self.stage.append(told.stage)
        self.loss.append(told.loss)
        self.validation.append(told.validation)
        self.learning_rate.append(told.learning_rate)

    def to_dict(self) -> dict[str, Any]:
        """Return the curves as JSON for model files and checkpoints."""
        return {
            "untrained": self.untrained,
            "stages": [[name, count] for name, count in self.spans()],
            "loss": list(self.loss),
            "validation": list(self.validation),
            "learning_rate": list(self.learning_rate),
            "best": self.best,
            "best_epoch": self.best_epoch,
        }

    @classmethod
    def from_dict(cls, facts: Mapping[str, Any]) -> Curves:
        """Return the curves from the result of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: An entry of the curves is missing or not a number.
        """
        spans = [(str(name), int(count)) for name, count in facts["stages"]]
        loss, validation, rate = (
            [_finite(value) for value in facts[key]]
            for key in ("loss", "validation", "learning_rate")
        )
        # Check the counts before expanding them: a damaged file can contain a huge count.
        counted = {sum(count for _, count in spans), len(loss), len(validation), len(rate)}
        if len(counted) > 1 or any(count < 1 for _, count in spans):
            raise ValueError(f"curves: different numbers of epochs: {sorted(counted)}")
        stage = [name for name, count in spans for _ in range(count)]
        return cls(_finite(facts["untrained"]), stage, loss, validation, rate)

    def spans(self) -> list[tuple[str, int]]:
        """Return the stages in their order, each with its number of epochs."""
        found: list[tuple[str, int]] = []
        for name in self.stage:
            if found and found[-1][0] == name:
                found[-1] = (name, found[-1][1] + 1)
            else:
                found.append((name, 1))
        return found


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"curves: {value!r} is not a finite number")
    return number


def sparkline(values: Sequence[float], width: int = 24) -> str:
    """Return a curve as one line of text on a logarithmic scale, with the newest value last."""
    finite = [math.log(value) for value in values if math.isfinite(value) and value > 0]
    if not finite:
        return ""
    shown = _thinned(finite, width)
    low, high = min(shown), max(shown)
    span = (high - low) or 1.0
    return "".join(BARS[round((value - low) / span * (len(BARS) - 1))] for value in shown)


def _thinned(values: Sequence[float], width: int) -> list[float]:
    if len(values) <= width:
        return list(values)
    last = len(values) - 1
    return [values[round(k * last / (width - 1))] for k in range(width)]


def keeps_checkpoints(model: Any) -> bool:
    """Return whether an interrupted fit of the estimator can be resumed."""
    return hasattr(model, "checkpoints_")


def attach_inside(part: Any, whole: Any, name: str) -> None:
    """Pass the watch and a checkpoint subfolder to an estimator that is fitted inside another one.

    Args:
        part: Inner estimator, which receives a subfolder only if it supports checkpoints.
        whole: Outer estimator, with the attributes `watch_` and `checkpoints_`.
        name: Name of the checkpoint subfolder.
    """
    kept: Path | None = whole.checkpoints_
    inside = kept / name if kept is not None and keeps_checkpoints(part) else None
    attach(part, whole.watch_, inside)


def attach(model: Any, watch: Watch | None = None, checkpoints: Path | None = None) -> None:
    """Set `watch_` and `checkpoints_` of an estimator that has these attributes.

    Raises:
        SpecError: Checkpoints are requested, but the estimator does not support them.
    """
    if watch is not None and hasattr(model, "watch_"):
        model.watch_ = watch
    if checkpoints is None:
        return
    if not keeps_checkpoints(model):
        raise SpecError(
            f"{model.estimator} does not write checkpoints: its fit is not iterative",
            hint="remove --checkpoints; only networks trained by gradient descent support it, "
            "such as lagrangian and residual",
        )
    model.checkpoints_ = checkpoints


LEARN = {"learn": "to train its network"}
"""Return value of `RobotEstimator.extras` for each estimator whose fit calls `require_torch`."""

TO_TRAIN = Needs({"samples": 100}, gains=True)
"""Minimum requirements on the data for training any network."""


def require_torch() -> None:
    """Raise if PyTorch, which training and restoring the network need, is not installed.

    Raises:
        PluginError: The extra `learn` is missing.
    """
    if find_spec("torch") is None:
        raise plugins.not_installed("this network", ["torch"], "learn")
