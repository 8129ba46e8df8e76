"""Training of a Lagrangian network with friction on rows of a dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hil.identify.lagrangian.choices import Design
from hil.identify.lagrangian.model import NetworkModel
from hil.identify.lagrangian.stored import weights_of
from hil.identify.lagrangian.task import Task
from hil.identify.lagrangian.tensors import Rows, tensor_rows
from hil.identify.training_loop.curves import Curves
from hil.identify.training_loop.device import torch_device, torch_dtype
from hil.identify.training_loop.loop import train
from hil.identify.training_loop.loss import Loss
from hil.identify.training_loop.problem import Watch, unwatched
from hil.identify.training_loop.settings import TrainingSettings
from hil.identify.training_loop.stages import Stage

VALIDATED_AT_ONCE = 4096
"""Rows of a validation pass; bounds memory."""


class LagrangianProblem:
    """A network and its rows, for `hil.identify.training_loop.loop.train`.

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


def fit_network(
    task: Task,
    design: Design,
    stages: Sequence[Stage],
    trials: Sequence[TrainingSettings],
    watch: Watch | None = None,
    checkpoints: Path | None = None,
) -> tuple[dict[str, np.ndarray[Any, Any]], Curves]:
    """Weights by name and the learning curves of the trial that validates best.

    Args:
        task: Rows to learn from and to stop by.
        design: What the network looks like.
        stages: Of every trial.
        trials: Settings to try, each from the same start; one is usual.
        watch: Told every epoch.
        checkpoints: Folder to keep the training in; each of several trials has one inside it.

    Raises:
        FitError: A training diverges.
        SpecError: There is no such device.
    """
    found = []
    for number, training in enumerate(trials, start=1):
        posed = problem(task, design, training)
        kept = checkpoints
        if kept is not None and len(trials) > 1:
            kept = kept / f"trial-{number}"
        curves = train(posed, stages, training, watch or unwatched, kept)
        found.append((weights_of(posed.module), curves))
    return min(found, key=lambda one: one[1].best)
