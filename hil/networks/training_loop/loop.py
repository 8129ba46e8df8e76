"""Mini-batch training with early stopping: the one loop that every network goes through."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

import torch

from hil.core import DataError, FitError
from hil.networks.training_loop.checkpoint import Checkpoints
from hil.networks.training_loop.curves import Curves
from hil.networks.training_loop.device import device_of, reproducible
from hil.networks.training_loop.problem import KeptIfPossible, Problem, Told, Watch, unwatched
from hil.networks.training_loop.progress import Progress, copied, first_loss, identity
from hil.networks.training_loop.settings import TrainingSettings
from hil.networks.training_loop.stages import Stage
from hil.networks.training_loop.steps import Steps, everything


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
        watch: Told every epoch; see `KeptIfPossible` for a disk that is full.
        checkpoints: Folder to keep the training in and to take it up from: one per training.

    Raises:
        CheckpointRefused: The folder holds a checkpoint that is damaged or of another training.
        DataError: No checkpoint can be written there.
        FitError: Loss or validation error is not finite.
        SpecError: A stage names a group of parameters that there is not.
    """
    device = device_of(problem.module)
    with reproducible(device, settings.threads):
        training = _Training(problem, stages, settings, watch)
        if checkpoints is not None:
            training.keep_in(checkpoints)
        return training.run()


class _Training:
    def __init__(
        self, problem: Problem, stages: Sequence[Stage], settings: TrainingSettings, watch: Watch
    ) -> None:
        self.problem, self.stages, self.settings, self.watch = problem, stages, settings, watch
        self.device = device_of(problem.module)
        torch.manual_seed(settings.seed)
        weights = copied(problem.module)
        self.at = Progress(
            problem.module,
            Curves(self._validation("before the first step")),
            torch.Generator().manual_seed(settings.seed),
            best=weights,
            stage_best=weights,
        )
        self.checkpoints: Checkpoints | None = None

    def keep_in(self, folder: Path) -> None:
        """Write checkpoints into a folder, and go on from the one that is there."""
        told = identity(self.problem, self.stages, self.settings)
        loss = first_loss(self.problem, self.settings.batch_size)
        start = {"validation error": self.at.curves.untrained, "loss": loss}
        # With checkpoints or without, the network draws the same.
        torch.manual_seed(self.settings.seed)
        self.checkpoints = Checkpoints(folder, told, start)
        if found := self.checkpoints.read():
            with self.checkpoints.fitting():
                self.at.restore(found, len(self.stages))

    def run(self) -> Curves:
        """All stages from where the training stands."""
        movable = {one: one.requires_grad for one in everything(self.problem.groups())}
        try:
            for number in range(self.at.stage, len(self.stages)):
                self._run_stage(self.stages[number])
                self.at.stage, self.at.epoch = number + 1, 0
            self._keep(now=True)
        except (KeyboardInterrupt, SystemExit):
            if self.checkpoints:
                with self._kept_if_possible():
                    self.checkpoints.write()
            raise
        finally:
            for parameter, moves in movable.items():
                parameter.requires_grad_(moves)
        self.problem.module.load_state_dict(self.at.best)
        return self.at.curves

    def _run_stage(self, stage: Stage) -> None:
        per_epoch = math.ceil(self.problem.samples / self.settings.batch_size)
        steps = Steps(self.problem.groups(), stage, self.settings, per_epoch)
        with self.checkpoints.fitting() if self.checkpoints else nullcontext():
            steps.restore(self.at.moments)
        while self.at.epoch < stage.epochs and self._waited() < stage.patience:
            loss = self._run_epoch(steps, first=self.at.epoch * per_epoch)
            self.at.epoch += 1
            self.at.moments = steps.state()
            self._judge(stage, loss, steps.rate(self.at.epoch * per_epoch - 1))
            self._keep()
        self.problem.module.load_state_dict(self.at.stage_best)
        self.at.moments = {}

    def _run_epoch(self, steps: Steps, first: int) -> float:
        """Mean loss over all samples, each taken once in random order."""
        self.problem.module.train()
        order = torch.randperm(self.problem.samples, generator=self.at.order).to(self.device)
        total = torch.zeros((), dtype=torch.float64, device=self.device)
        for number, chosen in enumerate(torch.split(order, self.settings.batch_size)):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.amp):
                loss = self.problem.loss(chosen)
            steps.take(loss, first + number)
            total += loss.detach() * len(chosen)
        return float(total) / self.problem.samples

    def _judge(self, stage: Stage, loss: float, rate: float) -> None:
        """Validate, remember the weights if they are better, and tell whoever watches."""
        at, done = self.at, len(self.at.curves) + 1
        where = f"in epoch {done} ({stage.name})"
        if not math.isfinite(loss):
            raise _diverged("loss", loss, where)
        validation = self._validation(where)
        if validation < at.curves.best:
            at.best = copied(at.module)
        if validation < min(at.curves.last(at.epoch - 1), default=math.inf):
            at.stage_best = copied(at.module)
        best = min(at.curves.best, validation)
        told = Told(stage.name, done, done + self._left(), loss, validation, best, rate)
        at.curves.add(told)
        self.watch(told)

    def _keep(self, *, now: bool = False) -> None:
        if self.checkpoints:
            with self._kept_if_possible():
                self.checkpoints.keep(self.at.snapshot(), now=now)

    @contextmanager
    def _kept_if_possible(self) -> Iterator[None]:
        try:
            yield
        except DataError as error:
            if not isinstance(self.watch, KeptIfPossible):
                raise
            self.watch.not_kept(error)
            self.checkpoints = None

    def _validation(self, where: str) -> float:
        self.problem.module.eval()
        with torch.no_grad():
            found = float(self.problem.validate())
        if not math.isfinite(found):
            raise _diverged("validation error", found, where)
        return found

    def _waited(self) -> int:
        """Epochs of the stage since its best."""
        found = self.at.curves.last(self.at.epoch)
        return len(found) - 1 - found.index(min(found)) if found else 0

    def _left(self) -> int:
        """Epochs there may still be."""
        later = sum(stage.epochs for stage in self.stages[self.at.stage + 1 :])
        return self.stages[self.at.stage].epochs - self.at.epoch + later


def _diverged(what: str, value: float, where: str) -> FitError:
    return FitError(
        f"training diverged: the {what} is {value} {where}",
        hint="lower learning_rate (say to a third) or clip_norm, raise warm_up_steps, or take "
        "precision: float64; and look for values in the data that cannot be",
    )
