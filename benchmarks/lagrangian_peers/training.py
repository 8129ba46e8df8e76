"""How the validation error falls with CPU time, with our settings and with the paper's.

A `full` mock UR5 follows nine Fourier trajectories; two are held out to validate. Rows, filters and
the order of learning (Algorithm 1) are everybody's; what differs is told by `CONTESTANTS`.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass, field
from functools import cache

import torch

from benchmarks.identification.mock_gap import observed
from hil.dynamics import load_model
from hil.networks.lagrangian import NetworkModel, Rows, problem, tensor_rows
from hil.networks.lagrangian_data import Preparation, Task
from hil.networks.lagrangian_settings import (
    Design,
    NetworkSettings,
    design,
    stages,
    training_settings,
)
from hil.networks.training import Told, TrainingSettings
from hil.networks.training_loop import train

ARM, TRAJECTORIES, QUICK_TRAJECTORIES = "ur5", 9, 3
SIGN_WIDTH = 0.01
LITERAL_LAYER = NetworkSettings.literal().model_dump()
CONTESTANTS = {
    "ours": ("ours", {}),
    "literal_layer": ("ours", LITERAL_LAYER),
    "literal": ("paper", {}),
}
"""Protocol of network, friction and training, and what of the network is otherwise: the paper's
layer in our training, and all that the paper prints, hard sign included."""


@dataclass
class Course:
    """How a contestant fared.

    Attributes:
        cpu_s: CPU time of the training at the end of each epoch, the start first.
        nrmse: On the validation trajectories then: RMSE over standard deviation, mean of joints.
    """

    cpu_s: list[float] = field(default_factory=list)
    nrmse: list[float] = field(default_factory=list)

    def until(self, nrmse: float) -> float:
        """CPU seconds until that error; all of them when it was not reached."""
        told = zip(self.cpu_s, self.nrmse, strict=True)
        return next((t for t, value in told if value <= nrmse), self.cpu_s[-1])

    def sooner(self, other: Course, nrmse: float) -> float:
        """How many times sooner this one is there; the start counts as one epoch."""
        return other.until(nrmse) / max(self.until(nrmse), self.cpu_s[1])

    def figures(self, nrmse: float) -> dict[str, float]:
        """CPU seconds to that error, whether it was reached, the least error, and epochs."""
        return {
            "cpu_s": self.until(nrmse),
            "reached": float(min(self.nrmse) <= nrmse),
            "nrmse": min(self.nrmse),
            "epochs": len(self.nrmse) - 1,
        }


class _TimeUp(Exception):
    """The training has had its time."""


def course(name: str, seed: int, limit_s: float, *, quick: bool = False) -> Course:
    """Train one contestant for so long; judging is not counted.

    Args:
        name: Of `CONTESTANTS`.
        seed: Of the robot, its trajectories and the network.
        limit_s: CPU time at most; the epoch that passes it is the last.
        quick: Fewer trajectories.
    """
    protocol, changed = CONTESTANTS[name]
    width = 0.0 if protocol == "paper" else SIGN_WIDTH
    task = _task(seed, width, QUICK_TRAJECTORIES if quick else TRAJECTORIES)
    settings = training_settings(protocol, 3, seed, {"device": "cpu"})
    found = Course()
    with contextlib.suppress(_TimeUp):
        _train(task, design("stribeck", protocol, changed), settings, found, limit_s)
    return found


def _train(
    task: Task, built: Design, settings: TrainingSettings, found: Course, limit_s: float
) -> None:
    posed = problem(task, built, settings)
    validate = tensor_rows(
        task.data, task.torque, task.validate, dtype=torch.float32, device=torch.device("cpu")
    )
    std = torch.as_tensor(task.torque_std, dtype=torch.float32)
    judged = 0.0
    begin = time.process_time()

    def note(told: Told | None = None) -> None:
        nonlocal judged
        now = time.process_time()
        found.cpu_s.append(now - begin - judged)
        found.nrmse.append(_nrmse(posed.module, validate, std))
        judged += time.process_time() - now
        if found.cpu_s[-1] > limit_s:
            raise _TimeUp

    note()
    train(posed, stages("hybrid", built.kind, settings), settings, note)


@torch.no_grad()
def _nrmse(module: NetworkModel, rows: Rows, std: torch.Tensor) -> float:
    error = (module(*rows.motion) - rows.torque) / std
    return float(error.square().mean(0).sqrt().mean())


@cache
def _task(seed: int, width: float, count: int) -> Task:
    of = observed(seed, ARM, count)
    preparation = Preparation(of.filters, False, width, 2 / 9, seed)
    return preparation.task(of.data, of.scale, load_model(ARM))
