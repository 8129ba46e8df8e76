"""What a trained network says of motions: torques by their parts, M(q), one sample at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from hil.core import FloatArray
from hil.estimators import advanced, carried_step, one_sample
from hil.networks.lagrangian.direction import smooth_sign
from hil.networks.lagrangian.model import NetworkModel, Torques
from hil.networks.training_loop import reproducible

AT_ONCE = 2048
"""Rows in one pass; bounds memory, and more are not faster."""

LoadTorque = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""Motion (1, n) → torque of the load (1, n) [N·m]."""


def torques(module: NetworkModel, *motion: FloatArray) -> dict[str, FloatArray]:
    """Parts of the torque by name, each (N, n) [N·m].

    Args:
        module: On the CPU.
        *motion: Position, velocity, acceleration and direction, each (N, n).
    """
    found = {name: np.empty(motion[0].shape) for name in Torques._fields}
    with torch.inference_mode(), reproducible(torch.device("cpu"), 1):
        for first in range(0, len(motion[0]), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            parts = module.torques(*(_tensor(module, values[rows]) for values in motion))
            for name, values in parts._asdict().items():
                found[name][rows] = values.numpy()
    return found


def steady_friction(module: NetworkModel, qd: FloatArray, direction: FloatArray) -> FloatArray:
    """(N, n) friction [N·m] that asks for no position, at velocities and directions (N, n)."""
    with torch.inference_mode():
        parts = [_tensor(module, values) for values in (np.zeros_like(qd), qd, direction)]
        return np.asarray(module.friction(*parts).double().numpy())


def mass_matrix(module: NetworkModel, q: FloatArray) -> FloatArray:
    """M(q) (N, n, n) [kg·m²] at positions (N, n)."""
    with torch.inference_mode(), reproducible(torch.device("cpu"), 1):
        return np.asarray(module.dynamics.mass(_tensor(module, q)).double().numpy())


class NetworkStream:
    """A network fed one sample at a time; Dahl's state, if it has one, goes along.

    Args:
        module: On the CPU.
        width: Of the smooth sign [rad/s].
        length: (n,) in which Dahl's state comes round [rad]; None for the smooth sign.
        load: Torque of what is mounted; None without.
        scale: (n,) torque per unit of effort.
    """

    def __init__(
        self,
        module: NetworkModel,
        width: float,
        length: FloatArray | None,
        load: LoadTorque | None,
        scale: FloatArray,
    ) -> None:
        self._module, self._width, self._length = module, width, length
        self._load, self._scale = load, scale
        self._state = np.zeros((1, len(scale)))
        self._last: FloatArray | None = None

    def step(self, q: FloatArray, qd: FloatArray, qdd: FloatArray) -> FloatArray:
        """Predicted effort (n,) for one sample, each input (n,); qd of exactly 0 holds.

        Raises:
            DataError: An input is not one number per joint.
        """
        motion = one_sample(len(self._scale), q, qd, qdd)
        direction = self._direction(motion[0], motion[1])
        with torch.inference_mode():
            inputs = (_tensor(self._module, values) for values in (*motion, direction))
            torque = self._module(*inputs).double().numpy()
        if self._load is not None:
            torque = torque + self._load(*motion)
        sample: FloatArray = (torque / self._scale)[0]
        return sample

    def _direction(self, q: FloatArray, qd: FloatArray) -> FloatArray:
        if self._length is None:
            return smooth_sign(qd, self._width)
        step = carried_step(q, self._last, qd)
        self._last = q
        self._state = advanced(self._state, step, self._length)
        return self._state


def _tensor(module: NetworkModel, values: FloatArray) -> torch.Tensor:
    return torch.as_tensor(values, dtype=next(module.parameters()).dtype)
