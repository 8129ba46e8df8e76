"""Mini-batch training with early stopping: the one loop that every network goes through."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch

from hil.errors import FitError
from hil.identify.training_loop.curves import Curves
from hil.identify.training_loop.device import device_of, reproducible
from hil.identify.training_loop.problem import Problem, Told, Watch, unwatched
from hil.identify.training_loop.settings import TrainingSettings
from hil.identify.training_loop.stages import Stage
from hil.identify.training_loop.steps import Steps, everything

State = dict[str, torch.Tensor]


def train(
    problem: Problem,
    stages: Sequence[Stage],
    settings: TrainingSettings,
    watch: Watch = unwatched,
    checkpoints: Path | None = None,
) -> Curves:
    """Train a network in place, and leave it with the weights that validated best.

    The untrained network counts: what does not get better by training stays as it was. A stage
    goes on from the best weights of the one before it. Equal seeds give equal weights on the CPU;
    the caller's random numbers are left alone.

    Args:
        problem: The network with its data, on the device it is to be trained on.
        stages: In their order.
        settings: The loss is the problem's matter, all else is used here.
        watch: Told every epoch.
        checkpoints: Folder to keep the training in and to take it up from.

    Raises:
        FitError: Loss or validation error is not finite.
        SpecError: A stage names a group of parameters that there is not.
    """
    device = device_of(problem.module)
    with reproducible(device, settings.threads):
        torch.manual_seed(settings.seed)
        return _Training(problem, stages, settings, watch).run()


class _Training:
    def __init__(
        self, problem: Problem, stages: Sequence[Stage], settings: TrainingSettings, watch: Watch
    ) -> None:
        self.problem, self.stages, self.settings, self.watch = problem, stages, settings, watch
        self.device = device_of(problem.module)
        self.order = torch.Generator().manual_seed(settings.seed)
        self.curves = Curves(self._validation("before the first step"))
        self.best = self.stage_best = _copy(problem.module)
        self.stage = 0
        self.epoch = 0
        """Of the stage: how many there were."""

    def run(self) -> Curves:
        """All stages from where the training stands."""
        movable = {one: one.requires_grad for one in everything(self.problem.groups())}
        try:
            while self.stage < len(self.stages):
                self._run_stage(self.stages[self.stage])
                self.stage, self.epoch = self.stage + 1, 0
        finally:
            for parameter, moves in movable.items():
                parameter.requires_grad_(moves)
        self.problem.module.load_state_dict(self.best)
        return self.curves

    def _run_stage(self, stage: Stage) -> None:
        per_epoch = math.ceil(self.problem.samples / self.settings.batch_size)
        steps = Steps(self.problem.groups(), stage, self.settings, per_epoch)
        while self.epoch < stage.epochs and self._waited() < stage.patience:
            loss = self._run_epoch(steps, first=self.epoch * per_epoch)
            self.epoch += 1
            rate = steps.rate(self.epoch * per_epoch - 1)
            self._judge(stage, loss, rate)
        self.problem.module.load_state_dict(self.stage_best)

    def _run_epoch(self, steps: Steps, first: int) -> float:
        """Mean loss over all samples, each taken once in random order."""
        self.problem.module.train()
        order = torch.randperm(self.problem.samples, generator=self.order).to(self.device)
        total = torch.zeros((), dtype=torch.float64, device=self.device)
        for number, chosen in enumerate(torch.split(order, self.settings.batch_size)):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.amp):
                loss = self.problem.loss(chosen)
            steps.take(loss, first + number)
            total += loss.detach() * len(chosen)
        return float(total) / self.problem.samples

    def _judge(self, stage: Stage, loss: float, rate: float) -> None:
        """Validate, remember the weights if they are better, and tell whoever watches."""
        where = f"in epoch {len(self.curves) + 1} ({stage.name})"
        if not math.isfinite(loss):
            raise _diverged("loss", loss, where)
        validation = self._validation(where)
        if validation < self.curves.best:
            self.best = _copy(self.problem.module)
        if self.epoch == 1 or validation < min(self._of_stage()):
            self.stage_best = _copy(self.problem.module)
        best = min(self.curves.best, validation)
        done = len(self.curves) + 1
        told = Told(stage.name, done, done + self._left(), loss, validation, best, rate)
        self.curves.add(told)
        self.watch(told)

    def _validation(self, where: str) -> float:
        self.problem.module.eval()
        with torch.no_grad():
            found = float(self.problem.validate())
        if not math.isfinite(found):
            raise _diverged("validation error", found, where)
        return found

    def _of_stage(self) -> list[float]:
        """Validation errors of the stage so far."""
        return self.curves.validation[len(self.curves.validation) - self.epoch + 1 :]

    def _waited(self) -> int:
        """Epochs of the stage since its best."""
        found = self.curves.validation[len(self.curves) - self.epoch :]
        return len(found) - 1 - found.index(min(found)) if found else 0

    def _left(self) -> int:
        """Epochs there may still be."""
        later = sum(stage.epochs for stage in self.stages[self.stage + 1 :])
        return self.stages[self.stage].epochs - self.epoch + later


def _copy(module: torch.nn.Module) -> State:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def _diverged(what: str, value: float, where: str) -> FitError:
    return FitError(
        f"training diverged: the {what} is {value} {where}",
        hint="lower learning_rate (say to a third) or clip_norm, raise warm_up_steps, or take "
        "precision: float64; and look for values in the data that cannot be",
    )
