"""Mini-batch training with early stopping, used by all networks that are trained by gradient.

`train` runs the stages of a training. `Progress` contains the complete state that an epoch changes,
and a checkpoint (`hil.networks.checkpoint`) stores that state. A resumed training therefore ends
with the same bits as an uninterrupted one. `Steps` runs the optimiser steps of one stage, and
`Loss` is the error measure that is minimised. This module imports torch, so other modules must
import this module only inside functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch.nn.functional import smooth_l1_loss

from hil.core import DataError, FitError, FloatArray, SpecError
from hil.estimators import choice
from hil.networks.checkpoint import Checkpoints, Snapshot, State
from hil.networks.training import (
    Curves,
    KeptIfPossible,
    LossKind,
    Precision,
    Problem,
    Stage,
    Told,
    TrainingSettings,
    Watch,
    require_groups,
    unwatched,
)


def train(
    problem: Problem,
    stages: Sequence[Stage],
    settings: TrainingSettings,
    watch: Watch = unwatched,
    checkpoints: Path | None = None,
) -> Curves:
    """Train a network in place and set it to the weights with the lowest validation error.

    The search for the lowest validation error includes the untrained network: a network that
    training does not improve keeps its start weights. A stage continues from the best weights of
    the previous stage. Equal seeds give equal weights on the CPU. A training does not change the
    random generators of the caller.

    Args:
        problem: Network with its data, on the device on which it is trained.
        stages: Stages in their order.
        settings: Training settings, except the loss, which the problem computes.
        watch: Function that is called with every epoch. With a `KeptIfPossible` watch, the training
            continues if the disk is full.
        checkpoints: Folder in which checkpoints are stored and from which the training is resumed;
            each training needs a separate folder.

    Raises:
        CheckpointRefused: The folder contains a checkpoint that is damaged or of a different
            training.
        DataError: No checkpoint can be written to the folder.
        FitError: The loss or the validation error is not finite.
        SpecError: A stage names a parameter group that does not exist.
    """
    device = device_of(problem.module)
    with reproducible(device, settings.threads):
        training = _Training(problem, stages, settings, watch)
        if checkpoints is not None:
            training.keep_in(checkpoints)
        return training.run()


WHERE_IT_RUNS = ("device", "threads")
"""Names of settings that may differ when a checkpoint is resumed on a different machine."""


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
        """Write checkpoints into a folder; first resume from its checkpoint if there is one."""
        weights = self.problem.module.state_dict()
        identity = {
            "settings": self.settings.model_dump(exclude=set(WHERE_IT_RUNS)),
            "stages": [asdict(stage) for stage in self.stages],
            "samples": self.problem.samples,
            "weights": {name: list(value.shape) for name, value in weights.items()},
        }
        # A checkpoint contains no data; errors before the first step reveal different data.
        start = {"validation error": self.at.curves.untrained, "loss": self._first_loss()}
        # Seed again, so that the random numbers are the same with and without checkpoints.
        torch.manual_seed(self.settings.seed)
        self.checkpoints = Checkpoints(folder, identity, start)
        if found := self.checkpoints.read():
            with self.checkpoints.fitting():
                self.at.restore(found, len(self.stages))

    def _first_loss(self) -> float:
        """Return the loss over the first mini-batch, in the order of the data, before any step."""
        self.problem.module.eval()
        first = min(self.problem.samples, self.settings.batch_size)
        with torch.no_grad():
            return float(self.problem.loss(torch.arange(first, device=self.device)))

    def run(self) -> Curves:
        """Run all remaining stages of the training."""
        groups = self.problem.groups().values()
        movable = {one: one.requires_grad for parameters in groups for one in parameters}
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
        """Run one epoch; return the mean loss over all samples, each of which is used one time."""
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
        """Validate, store the weights if their error is lower, and report the epoch to `watch`."""
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
        """Return the number of epochs since the best epoch of the stage."""
        found = self.at.curves.last(self.at.epoch)
        return len(found) - 1 - found.index(min(found)) if found else 0

    def _left(self) -> int:
        """Return the maximum number of remaining epochs of the stage."""
        later = sum(stage.epochs for stage in self.stages[self.at.stage + 1 :])
        return self.stages[self.at.stage].epochs - self.at.epoch + later


def _diverged(what: str, value: float, where: str) -> FitError:
    return FitError(
        f"training diverged: the {what} is {value} {where}",
        hint="lower learning_rate (say to a third) or clip_norm, raise warm_up_steps, or set "
        "precision: float64; check the data for impossible values",
    )


@dataclass(slots=True)
class Progress:
    """State of a training between two epochs.

    Attributes:
        module: Network with its current weights.
        curves: Learning curves of the completed epochs.
        order: Random generator for the order of mini-batches.
        best: Weights with the lowest validation error; the untrained weights are included in the
            search.
        stage_best: Best weights of the running stage.
        stage: Number of the running stage, from 0.
        epoch: Number of completed epochs of the running stage.
        moments: Moments of Adam in the form that `Steps.state` returns.
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
        """Return copies of the complete training state, including the random state of torch."""
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
        """Restore the training state from a snapshot.

        Args:
            found: Snapshot of the training.
            stages: Number of stages of the training.

        Raises:
            KeyError, TypeError, ValueError, OverflowError, RuntimeError: The snapshot does not
                match the network or the stages.
        """
        self.curves = Curves.from_dict(found.facts["curves"])
        self.stage, self.epoch = _where(found.facts, stages, len(self.curves))
        device = device_of(self.module)
        self.best, self.stage_best = (
            {name: value.to(device) for name, value in found.tensors[group].items()}
            for group in ("best", "stage_best")
        )
        for group in ("best", "stage_best", "weights"):  # checks that all of them match
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
    """Return the number of the running stage and the number of its completed epochs."""
    stage, epoch = facts["stage"], facts["epoch"]
    if not all(type(count) is int for count in (stage, epoch)):  # bool is a subclass of int
        raise ValueError(f"stage {stage!r:.60}, epoch {epoch!r:.60}")
    if not (0 <= stage <= stages and 0 <= epoch <= epochs):
        raise ValueError(f"stage {stage} of {stages}, epoch {epoch} of {epochs}")
    return stage, epoch


def _require_finite(group: str, tensors: State) -> None:
    for name, value in tensors.items():
        if not torch.all(torch.isfinite(value)):
            raise ValueError(f"{group}/{name} contains values that are not finite")


def copied(module: torch.nn.Module) -> State:
    """Return a copy of the weights of a network, which further training does not change."""
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


Groups = Mapping[str, Sequence[torch.nn.Parameter]]


class Steps:
    """Optimiser steps of one stage.

    Args:
        groups: All parameters by group; groups that the stage does not train are frozen.
        stage: Stage, which determines the trained groups and the learning-rate factor.
        settings: Training settings, of which rates, schedule and clipping are used.
        per_epoch: Number of optimiser steps per epoch.

    Raises:
        SpecError: The stage or a learning rate names a parameter group that does not exist.
    """

    def __init__(
        self, groups: Groups, stage: Stage, settings: TrainingSettings, per_epoch: int
    ) -> None:
        require_groups(f"stage {stage.name!r} trains", stage.trains, groups)
        require_groups("group_rates has", settings.group_rates, groups)
        trained = {name: groups[name] for name in stage.trains or groups}
        for name, parameters in groups.items():
            for parameter in parameters:
                parameter.requires_grad_(name in trained)
        self._settings = settings
        self._total = max(1, stage.epochs * per_epoch)
        self._rate = settings.learning_rate * stage.learning_rate_factor
        self._parameters = [one for parameters in trained.values() for one in parameters]
        # Fused: one call for all parameters, because small networks spend most time in Python.
        self.adam = torch.optim.AdamW(_parts(trained, settings), lr=self._rate, fused=True)

    def take(self, loss: torch.Tensor, number: int) -> None:
        """Take step `number` of the stage, from 0, along the negative gradient of a loss."""
        self.adam.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        if self._settings.clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(self._parameters, self._settings.clip_norm)
        rate = self.rate(number)
        for part in self.adam.param_groups:
            part["lr"] = rate * part["rate"]
        self.adam.step()

    def rate(self, number: int) -> float:
        """Return the learning rate at a step of the stage."""
        done = min(1.0, number / self._total)
        warm = self._settings.warm_up_steps
        rate = self._rate * (min(1.0, (number + 1) / warm) if warm else 1.0)
        if self._settings.schedule == "constant":
            return rate
        least = self._settings.final_rate
        return rate * (least + (1.0 - least) * 0.5 * (1.0 + math.cos(math.pi * done)))

    def state(self) -> dict[str, torch.Tensor]:
        """Return the moments of Adam, named `<number of the parameter>/<name>`."""
        state: dict[int, dict[str, torch.Tensor]] = self.adam.state_dict()["state"]
        return {f"{k}/{name}": value for k, one in state.items() for name, value in one.items()}

    def restore(self, state: Mapping[str, torch.Tensor]) -> None:
        """Restore the moments of Adam from the result of `state`.

        Raises:
            ValueError: The moments do not match the parameters.
        """
        found: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in state.items():
            number, _, name = key.partition("/")
            found.setdefault(int(number), {})[name] = value
        if found:
            _require_moments(found, [p for g in self.adam.param_groups for p in g["params"]])
        parts = self.adam.state_dict()["param_groups"]
        self.adam.load_state_dict({"state": found, "param_groups": parts})


def _parts(groups: Groups, settings: TrainingSettings) -> list[dict[str, Any]]:
    """Return the parameter groups of Adam, with weight decay for matrices only."""
    parts = []
    for name, parameters in groups.items():
        rate = settings.group_rates.get(name, 1.0)
        matrices = [one for one in parameters if one.ndim > 1]
        others = [one for one in parameters if one.ndim <= 1]
        for chosen, decay in ((matrices, settings.weight_decay), (others, 0.0)):
            if chosen:
                parts.append({"params": chosen, "rate": rate, "weight_decay": decay})
    return parts


def _require_moments(
    found: Mapping[int, Mapping[str, torch.Tensor]], parameters: Sequence[torch.nn.Parameter]
) -> None:
    if not found.keys() <= set(range(len(parameters))):
        raise ValueError(
            f"moments of {len(found)} parameters, but the network has {len(parameters)}"
        )
    for number, moments in found.items():
        own = tuple(parameters[number].shape)
        shapes = {name: tuple(value.shape) for name, value in moments.items()}
        wanted = {"step": (), "exp_avg": own, "exp_avg_sq": own}
        if shapes != wanted:
            raise ValueError(f"moments of parameter {number}: {shapes}, not {wanted}")


KINDS: tuple[str, ...] = get_args(LossKind)

FLOOR = 0.1
"""Share of a joint's torque deviation that `smape-floored` adds to the denominator."""

BETA = 0.05
"""Relative error, in standard deviations, at which `huber` changes from square to linear."""


class Loss:
    """Loss: mean of an error measure over joints and samples.

    The error measure `smape` is eq. (20) of the PINN paper, 2|e|/(|τ| + |τ̂|), with 0/0 = 0. If τ
    and τ̂ have opposite signs, `smape` equals 2 with a gradient of 0; near τ = 0 `smape` is steep.
    The error measure `smape-floored` adds a tenth of the joint's standard deviation to the
    denominator of `smape`. The error measures `huber`, `mae` and `mse` use the error e divided by
    the standard deviation.

    Args:
        kind: Error measure, one of `KINDS`.
        scale: (n,) standard deviation of every output over the training rows.

    Raises:
        SpecError: The error measure is unknown.
    """

    def __init__(self, kind: LossKind, scale: FloatArray | torch.Tensor) -> None:
        self.kind: str = choice("loss", kind, KINDS)
        self._scale = torch.as_tensor(np.asarray(scale), dtype=torch.float64)

    def __call__(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Return the scalar mean loss of predicted against measured values (…, n)."""
        return self.elements(predicted, measured).mean()

    def elements(self, predicted: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Return the loss (…, n) of each element, for callers that mask or weight the elements."""
        if self._scale.device != predicted.device or self._scale.dtype != predicted.dtype:
            self._scale = self._scale.to(predicted)
        if self.kind in ("smape", "smape-floored"):
            floor = self._scale * FLOOR if self.kind == "smape-floored" else None
            return _smape(predicted, measured, floor)
        error = (predicted - measured) / self._scale
        if self.kind == "huber":
            return smooth_l1_loss(error, torch.zeros_like(error), reduction="none", beta=BETA)
        return error.abs() if self.kind == "mae" else error.square()


def _smape(
    predicted: torch.Tensor, measured: torch.Tensor, floor: torch.Tensor | None
) -> torch.Tensor:
    twice = 2.0 * (predicted - measured).abs()
    total = predicted.abs() + measured.abs()
    if floor is not None:
        return twice / (total + floor)
    # If both are 0, the numerator is 0; a divisor of 1 keeps the gradient finite.
    return twice / torch.where(total > 0, total, torch.ones_like(total))


def torch_device(name: str) -> torch.device:
    """Return the torch device for `auto`, `cpu`, `cuda` or `cuda:1`.

    Raises:
        SpecError: torch does not have the requested device on this machine.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0]
        raise SpecError(
            f"torch cannot use the device {name!r}: {reason}",
            hint="use device: auto, which uses a GPU only if one is available, or device: cpu",
        ) from error
    return device


def torch_dtype(precision: Precision) -> torch.dtype:
    """Return the torch type for `float32` or `float64`."""
    return torch.float64 if precision == "float64" else torch.float32


def device_of(module: torch.nn.Module) -> torch.device:
    """Return the device of a network's parameters."""
    return next(iter(module.parameters())).device


@contextmanager
def reproducible(device: torch.device, threads: int) -> Iterator[None]:
    """Set the number of torch threads, and restore it and the random state on exit."""
    before = torch.get_num_threads()
    devices = [device] if device.type == "cuda" else []
    torch.set_num_threads(threads)
    try:
        with torch.random.fork_rng(devices=devices):
            yield
    finally:
        torch.set_num_threads(before)
