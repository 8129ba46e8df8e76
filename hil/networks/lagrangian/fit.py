"""Training of a Lagrangian network with friction on rows of a dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hil.core import FitError
from hil.networks.lagrangian.choices import Design
from hil.networks.lagrangian.model import NetworkModel
from hil.networks.lagrangian.stored import weights_of
from hil.networks.lagrangian.task import Task
from hil.networks.lagrangian.tensors import Rows, tensor_rows
from hil.networks.training import FRICTION, Curves, Stage, TrainingSettings, Watch, unwatched
from hil.networks.training_loop import Loss, torch_device, torch_dtype, train

VALIDATED_AT_ONCE = 4096
"""Rows of a validation pass; bounds memory."""


class LagrangianProblem:
    """A network and its rows, for `hil.networks.training_loop.train`.

    Args:
        module: The network, on its device.
        learn, validate: Rows on the same device.
        loss: What is minimised on the one and what the training stops by on the other: errors over
            each joint's standard deviation, or the paper's measure.
    """

    def __init__(self, module: NetworkModel, learn: Rows, validate: Rows, loss: Loss) -> None:
        self.module: NetworkModel = module
        self.samples = len(learn)
        self._learn, self._validate, self._loss = learn, validate, loss

    def groups(self) -> Mapping[str, Sequence[torch.nn.Parameter]]:
        """`dynamics`, and `friction` where it has parameters."""
        return self.module.groups()

    def loss(self, chosen: torch.Tensor) -> torch.Tensor:
        """Mean loss of the chosen rows (B,)."""
        rows = self._learn.take(chosen)
        return self._loss(self.module(*rows.motion), rows.torque)

    def validate(self) -> float:
        """The same loss over the rows to stop by."""
        total = 0.0
        for first in range(0, len(self._validate), VALIDATED_AT_ONCE):
            rows = self._validate.take(slice(first, first + VALIDATED_AT_ONCE))
            total += float(self._loss(self.module(*rows.motion), rows.torque)) * len(rows)
        return total / len(self._validate)


def problem(task: Task, design: Design, training: TrainingSettings) -> LagrangianProblem:
    """An untrained network with its rows in memory.

    Raises:
        SpecError: There is no such device.
    """
    device, dtype = torch_device(training.device), torch_dtype(training.precision)
    module = NetworkModel(design, task.torque_std, training.seed).to(device, dtype)
    learn, validate = (
        tensor_rows(task.data, task.torque, wanted, dtype=dtype, device=device)
        for wanted in (task.learn, task.validate)
    )
    return LagrangianProblem(module, learn, validate, Loss(training.loss, task.torque_std))


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """The trial that validates best.

    Attributes:
        weights: By name.
        curves: Its learning curves.
        notes: What became of all of them, where there were several.
    """

    weights: dict[str, np.ndarray[Any, Any]]
    curves: Curves
    notes: tuple[str, ...] = ()


def fit_network(
    task: Task,
    design: Design,
    stages: Sequence[Stage],
    trials: Sequence[TrainingSettings],
    watch: Watch | None = None,
    checkpoints: Path | None = None,
) -> Trained:
    """Train once per trial, each from the same start; one that diverges loses.

    Args:
        task: Rows to learn from and to stop by.
        design: What the network looks like.
        stages: Of every trial.
        trials: Settings; one is usual.
        watch: Told every epoch.
        checkpoints: Folder to keep the training in; each of several trials has one inside it.

    Raises:
        FitError: Every training diverges.
        SpecError: There is no such device.
    """
    if len(trials) == 1:
        return _trained(task, design, stages, trials[0], watch or unwatched, checkpoints)
    found, notes, errors = [], [], []
    for number, training in enumerate(trials, start=1):
        which = f"trial {number} of {len(trials)}"
        kept = None if checkpoints is None else checkpoints / f"trial-{number}"
        try:
            one = _trained(task, design, stages, training, _named(watch, which), kept)
        except FitError as error:
            errors.append(error)
            notes.append(f"{which}, {_rate(training)}: {error.message}")
            continue
        found.append(one)
        notes.append(f"{which}, {_rate(training)}: validation error {one.curves.best:.4g}")
    if not found:
        raise errors[0]
    return replace(min(found, key=lambda one: one.curves.best), notes=tuple(notes))


def _trained(
    task: Task,
    design: Design,
    stages: Sequence[Stage],
    training: TrainingSettings,
    watch: Watch,
    checkpoints: Path | None,
) -> Trained:
    posed = problem(task, design, training)
    curves = train(posed, stages, training, watch, checkpoints)
    return Trained(weights_of(posed.module), curves)


def _named(watch: Watch | None, which: str) -> Watch:
    if watch is None:
        return unwatched
    return lambda told: watch(replace(told, stage=f"{which}: {told.stage}"))


def _rate(training: TrainingSettings) -> str:
    return f"friction at {training.group_rates.get(FRICTION, 1.0):g} of the learning rate"
