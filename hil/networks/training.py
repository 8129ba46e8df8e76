"""Training networks by gradient, up to where PyTorch is needed: settings, stages, learning curves.

An estimator that trains a network poses a `Problem` (the network with its data in memory), says in
which order its parts are trained (`Stage`), and hands both with `TrainingSettings` to
`hil.networks.training_loop.train`, which imports torch. It reports every epoch (`Told`) to a
`Watch` and returns `Curves`. Nothing here imports torch, so that settings can be checked, models
read and curves drawn without it.
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
    """How to train: mini-batches, steps, when to stop, and where.

    The defaults are those that converged soonest per CPU second on a simulated arm of six joints.

    Attributes:
        epochs: Of all stages together, at most.
        batch_size: Samples per step.
        learning_rate: Of Adam (Kingma and Ba 2015), at its highest.
        schedule: `cosine` falls to `final_rate` over every stage; `constant` stays.
        final_rate: Share of the learning rate that a cosine ends with.
        warm_up_steps: Steps of every stage over which the rate rises linearly.
        group_rates: Times the learning rate, by group of parameters.
        clip_norm: Longest gradient; longer ones are shortened to it. None shortens none.
        weight_decay: Decoupled from the gradient (Loshchilov and Hutter 2019), on matrices only:
            coefficients with a unit are not pulled to 0.
        patience: Epochs without a better validation error until a stage ends.
        loops: Of hybrid learning: how often joint learning and dynamics alone take turns.
        inner_share: Epochs of dynamics alone per epoch of joint learning in a loop.
        outer_share: The same for dynamics alone after the last loop.
        loop_rate: Times the learning rate from one loop to the next.
        loss: The measure of an error that is minimised, see `hil.networks.training_loop.Loss`.
        seed: Of the order of mini-batches, and of whatever the network draws.
        device: `auto` is the GPU when there is one; `cpu`, `cuda`, `cuda:1`.
        precision: Of weights and data.
        amp: Matrix products in bfloat16 (automatic mixed precision).
        threads: Of torch on the CPU while it trains. Small networks gain nothing from more, and
            sums do not depend on the number of cores.
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
            raise ValueError("amp mixes float32 with bfloat16, so precision must be float32")
        return self

    @classmethod
    def literal(cls, **changed: object) -> Self:
        """What the paper prints: batch 50, 5e-4, SMAPE of eq. (20); nothing it does not mention."""
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
"""Groups of parameters of a Lagrangian network with friction."""


@dataclass(frozen=True, slots=True)
class Stage:
    """A part of the training.

    Attributes:
        name: For people, and for the learning curves.
        trains: Groups of parameters that move; the others are frozen. None named: all move.
        epochs: At most.
        patience: Epochs without a better validation error until it ends.
        learning_rate_factor: Times the settings' learning rate.
    """

    name: str
    trains: tuple[str, ...]
    epochs: int
    patience: int
    learning_rate_factor: float = 1.0


def joint_stages(settings: TrainingSettings, name: str = "joint") -> tuple[Stage, ...]:
    """One stage in which everything is trained."""
    return (Stage(name, (), settings.epochs, settings.patience),)


def hybrid_stages(settings: TrainingSettings) -> tuple[Stage, ...]:
    """Algorithm 1 of the PINN paper: joint learning and dynamics alone in turns, then dynamics.

    Lines 4 to 10 are the joint stage of a loop, 11 to 17 its inner stage with frozen friction, 19
    to 25 the outer one. "Until the loss function converges" is the stages' patience.

    Args:
        settings: `epochs` is spread over all stages.
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
    """Refuse groups of parameters that a network does not have.

    Args:
        who: Begins the message: what names them.
        named: The groups it names.
        groups: Those that there are.

    Raises:
        SpecError: One of them is not there.
    """
    for name in named:
        if name not in groups:
            raise SpecError(
                f"{who} {name!r}, but the network has the groups {', '.join(groups)}",
                hint=did_you_mean(name, tuple(groups)),
            )


class Problem(Protocol):
    """A network with its data in memory.

    Attributes:
        module: The network; its state dict is what a checkpoint keeps and early stopping restores.
        samples: How many there are to draw mini-batches from (rows, or segments of a motion).
    """

    module: torch.nn.Module
    samples: int

    def groups(self) -> Mapping[str, Sequence[torch.nn.Parameter]]:
        """Parameters by the name under which a stage trains or freezes them."""

    def loss(self, chosen: torch.Tensor) -> torch.Tensor:
        """Mean loss over the samples with these numbers (B,), to be differentiated."""

    def validate(self) -> float:
        """Error on data that are not trained on; lower is better."""


@dataclass(frozen=True, slots=True)
class Told:
    """One epoch, as a `Watch` and the learning curves get it.

    Attributes:
        stage: Name of the stage.
        epoch: Number within the whole training, from 1.
        epochs: At most how many there will be.
        loss: Mean training loss over the epoch.
        validation: `Problem.validate` after it.
        best: Least validation so far.
        learning_rate: Of the network's parameters.
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
    """A `Watch` that lets a training go on when its checkpoints can no longer be written."""

    def not_kept(self, error: HilError) -> None:
        """Take note of the reason; from now on the training is not kept."""


@runtime_checkable
class HearsBeginning(Protocol):
    """A `Watch` that is also called before the first epoch, which may take minutes."""

    def began(self, what: str) -> None:
        """Take note of what is trained, and on how much."""


def unwatched(told: Told) -> None:
    """Ignore an epoch: the `Watch` of a training that is not watched."""


BARS = "▁▂▃▄▅▆▇█"


@dataclass(slots=True)
class Curves:
    """Loss and validation error per epoch.

    Attributes:
        untrained: Validation error before the first step.
        stage: Name of every epoch's stage.
        loss: Mean training loss of every epoch.
        validation: Validation error after it.
        learning_rate: At its end.
        best: Least validation error, the untrained network's included: that of the weights kept.
        best_epoch: Its number, from 1; 0 is the untrained network.
    """

    untrained: float
    stage: list[str] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    validation: list[float] = field(default_factory=list)
    learning_rate: list[float] = field(default_factory=list)

    @property
    def best(self) -> float:
        """Least validation error, the untrained network's included."""
        return min([self.untrained, *self.validation])

    @property
    def best_epoch(self) -> int:
        """Number of the epoch it came after."""
        everything = [self.untrained, *self.validation]
        return everything.index(min(everything))

    def __len__(self) -> int:
        return len(self.loss)

    def last(self, epochs: int) -> list[float]:
        """Validation errors of so many epochs at the end."""
        return self.validation[len(self.validation) - epochs :]

    def add(self, told: Told) -> None:
        """One more epoch."""
        self.stage.append(told.stage)
        self.loss.append(told.loss)
        self.validation.append(told.validation)
        self.learning_rate.append(told.learning_rate)

    def to_dict(self) -> dict[str, Any]:
        """As JSON, for model files and checkpoints."""
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
        """Inverse of `to_dict`.

        Raises:
            KeyError, TypeError, ValueError: Something is missing or no number.
        """
        spans = [(str(name), int(count)) for name, count in facts["stages"]]
        loss, validation, rate = (
            [_finite(value) for value in facts[key]]
            for key in ("loss", "validation", "learning_rate")
        )
        # Counted before it is unrolled: a damaged count may be any number.
        counted = {sum(count for _, count in spans), len(loss), len(validation), len(rate)}
        if len(counted) > 1 or any(count < 1 for _, count in spans):
            raise ValueError(f"curves: stages and losses of {sorted(counted)} epochs")
        stage = [name for name, count in spans for _ in range(count)]
        return cls(_finite(facts["untrained"]), stage, loss, validation, rate)

    def spans(self) -> list[tuple[str, int]]:
        """Stages in their order, with the number of epochs each took."""
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
        raise ValueError(f"curves: {value!r} is no error or rate")
    return number


def sparkline(values: Sequence[float], width: int = 24) -> str:
    """A curve in one line of text, on a logarithmic scale; the newest value is the last."""
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
    """Whether a fit of the estimator can be taken up again."""
    return hasattr(model, "checkpoints_")


def attach_inside(part: Any, whole: Any, name: str) -> None:
    """Give a part of an estimator its watch, and a folder in its folder, where the part has them.

    Args:
        part: An estimator that is fitted inside another.
        whole: The other, with `watch_` and `checkpoints_`.
        name: Of the folder.
    """
    kept: Path | None = whole.checkpoints_
    inside = kept / name if kept is not None and keeps_checkpoints(part) else None
    attach(part, whole.watch_, inside)


def attach(model: Any, watch: Watch | None = None, checkpoints: Path | None = None) -> None:
    """Set the `watch_` and `checkpoints_` of an estimator that has them.

    Raises:
        SpecError: Checkpoints are asked for, and it trains nothing that could be taken up again.
    """
    if watch is not None and hasattr(model, "watch_"):
        model.watch_ = watch
    if checkpoints is None:
        return
    if not keeps_checkpoints(model):
        raise SpecError(
            f"{model.estimator} keeps no checkpoints: its fit is one computation",
            hint="leave --checkpoints out; networks trained by gradient take it, such as "
            "lagrangian and residual",
        )
    model.checkpoints_ = checkpoints


LEARN = {"learn": "to train its network"}
"""`RobotEstimator.extras` of whatever calls `require_torch` in a fit."""

TO_TRAIN = Needs({"samples": 100}, gains=True)
"""What no network can be trained without."""


def require_torch() -> None:
    """Refuse to train, or to restore a network that only PyTorch computes, without it.

    Raises:
        PluginError: The extra `learn` is missing.
    """
    if find_spec("torch") is None:
        raise plugins.not_installed("this network", ["torch"], "learn")
