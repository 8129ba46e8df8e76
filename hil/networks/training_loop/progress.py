"""How far a training is: all that has to be kept for going on as if nothing had happened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import torch

from hil.networks.training_loop.checkpoint import Snapshot
from hil.networks.training_loop.curves import Curves
from hil.networks.training_loop.device import device_of
from hil.networks.training_loop.problem import Problem
from hil.networks.training_loop.settings import TrainingSettings
from hil.networks.training_loop.stages import Stage

State = dict[str, torch.Tensor]

WHERE_IT_RUNS = ("device", "threads")
"""Settings that a checkpoint may be taken up with on another machine."""


@dataclass(slots=True)
class Progress:
    """A training between two epochs.

    Attributes:
        module: With its weights.
        curves: Of the epochs so far.
        order: Draws the order of mini-batches.
        best: Weights that validated best, the untrained ones included.
        stage_best: The best of the running stage.
        stage: Number of the running stage, from 0.
        epoch: Epochs it has had.
        moments: Adam's, see `Steps.state`.
    """

    module: torch.nn.Module
    curves: Curves
    order: torch.Generator
    best: State
    stage_best: State
    stage: int = 0
    epoch: int = 0
    moments: State = field(default_factory=dict)

    def snapshot(self) -> Snapshot:
        """Copies of everything, torch's random numbers included."""
        random = {"order": self.order.get_state(), "cpu": torch.get_rng_state()}
        device = device_of(self.module)
        if device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(device)
        tensors = {
            "weights": copied(self.module),
            "best": dict(self.best),
            "stage_best": dict(self.stage_best),
            "adam": {name: value.clone() for name, value in self.moments.items()},
            "random": random,
        }
        facts = {"stage": self.stage, "epoch": self.epoch, "curves": self.curves.to_dict()}
        return Snapshot(tensors, facts)

    def restore(self, found: Snapshot, stages: int) -> None:
        """Go on from a snapshot of a training of so many stages.

        Raises:
            KeyError, TypeError, ValueError, OverflowError, RuntimeError: It does not fit.
        """
        self.curves = Curves.from_dict(found.facts["curves"])
        self.stage, self.epoch = _where(found.facts, stages, len(self.curves))
        device = device_of(self.module)
        self.best, self.stage_best = (
            {name: value.to(device) for name, value in found.tensors[group].items()}
            for group in ("best", "stage_best")
        )
        for group in ("best", "stage_best", "weights"):  # all of them have to fit
            self.module.load_state_dict(found.tensors[group])
        self.moments = found.tensors.get("adam", {})
        for group in ("best", "stage_best", "weights", "adam"):
            _require_finite(group, found.tensors.get(group, {}))
        self._restore_random(found.tensors["random"], device)

    def _restore_random(self, random: State, device: torch.device) -> None:
        self.order.set_state(random["order"])
        torch.set_rng_state(random["cpu"])
        if device.type == "cuda" and "cuda" in random:
            torch.cuda.set_rng_state(random["cuda"], device)


def _where(facts: Mapping[str, Any], stages: int, epochs: int) -> tuple[int, int]:
    """Number of the running stage, and the epochs it has had."""
    stage, epoch = facts["stage"], facts["epoch"]
    if not all(type(count) is int for count in (stage, epoch)):  # bool is a kind of int
        raise ValueError(f"stage {stage!r:.60}, epoch {epoch!r:.60}")
    if not (0 <= stage <= stages and 0 <= epoch <= epochs):
        raise ValueError(f"stage {stage} of {stages}, epoch {epoch} of {epochs}")
    return stage, epoch


def _require_finite(group: str, tensors: State) -> None:
    for name, value in tensors.items():
        if not torch.all(torch.isfinite(value)):
            raise ValueError(f"{group}/{name} holds values that are not finite")


def copied(module: torch.nn.Module) -> State:
    """A network's weights, which stay as they are while it goes on."""
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def identity(
    problem: Problem, stages: Sequence[Stage], settings: TrainingSettings
) -> dict[str, Any]:
    """What tells one training from another, as JSON; not the data, and not the machine."""
    return {
        "settings": settings.model_dump(exclude=set(WHERE_IT_RUNS)),
        "stages": [asdict(stage) for stage in stages],
        "samples": problem.samples,
        "weights": {name: list(value.shape) for name, value in problem.module.state_dict().items()},
    }


def first_loss(problem: Problem, batch: int) -> float:
    """Loss over the first mini-batch in the order of the data, before any step."""
    problem.module.eval()
    chosen = torch.arange(min(problem.samples, batch), device=device_of(problem.module))
    with torch.no_grad():
        return float(problem.loss(chosen))
