"""How a network is trained, checked before anything is computed. Imports no torch."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from hil.estimators import MOST_SEED, Whole

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
        loss: What is minimised, see `hil.networks.training_loop.loss`.
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
