"""Networks of the paper protocol: what the linear model leaves of the training samples, by LM."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from hil.core import FloatArray, IntArray
from hil.networks import ConstantInputWarning, Mlp, train
from hil.studies.separation_tasks import Task

S_PER_PRODUCT = 3e-11
"""Seconds per number multiplied in a training, about: the longest trainings begin first."""


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """How the networks of the paper protocol are trained: no early stop, as in the paper.

    Attributes:
        epochs: Of Levenberg–Marquardt.
        seed: Of the start weights.
        linear_first: Whether the first hidden layer is linear, as the paper's text has it.
    """

    epochs: int
    seed: int
    linear_first: bool

    def mlp(self, layers: Sequence[int]) -> Mlp:
        """A network of some layout."""
        hidden = ["tanh"] * (len(layers) - 2)
        if self.linear_first and hidden:
            hidden[0] = "linear"
        return Mlp(layers, [*hidden, "linear"])


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What six networks are to learn.

    Attributes:
        inputs: (S, 4) q2…q5 of every dwell, means of its samples.
        values: (N, n) what the linear model leaves of the training samples.
        dwell: (N,) dwell of each.
    """

    inputs: FloatArray
    values: FloatArray
    dwell: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResult:
    """One network, trained: (S,) outputs at every dwell, seconds of one core, epochs, weights."""

    outputs: FloatArray
    seconds: float
    epochs: int
    weights: int


@dataclass(frozen=True, slots=True, eq=False)
class Networks:
    """The networks of all joints, trained.

    Attributes:
        outputs: (S, n) at every dwell.
        seconds: (n,) each took of one core.
        epochs: (n,) done until no step lowered the cost any more, or all there were.
        weights: Number of weights of each.
    """

    outputs: FloatArray
    seconds: FloatArray
    epochs: IntArray
    weights: int


def network_tasks(
    target: Target, layers: Sequence[int], settings: NetworkSettings, joints: Sequence[int]
) -> list[Task]:
    """One training per joint."""
    mlp = settings.mlp(layers)
    rows = len(target.inputs)
    cost = S_PER_PRODUCT * settings.epochs * rows * mlp.n_weights * min(rows, mlp.n_weights)
    return [Task(partial(_trained, mlp, target, joint, settings), cost) for joint in joints]


def gathered(found: Sequence[NetworkResult]) -> Networks:
    """The results of `network_tasks`, put together."""
    outputs = np.stack([one.outputs for one in found], axis=1)
    seconds = np.array([one.seconds for one in found])
    epochs = np.array([one.epochs for one in found])
    return Networks(outputs, seconds, epochs, found[0].weights)


def _trained(mlp: Mlp, target: Target, joint: int, settings: NetworkSettings) -> NetworkResult:
    begin = time.process_time()
    with warnings.catch_warnings():
        # A joint that never moved is among the study's own warnings.
        warnings.simplefilter("ignore", ConstantInputWarning)
        trained = train(
            mlp, target.inputs[target.dwell], target.values[:, joint], groups=target.dwell,
            initial=mlp.initial(settings.seed, joint)[None], epochs=settings.epochs,
        )  # fmt: skip
    outputs = trained.predict(target.inputs)[:, 0]
    seconds = time.process_time() - begin
    return NetworkResult(outputs, seconds, trained.histories[0].epochs, mlp.n_weights)
