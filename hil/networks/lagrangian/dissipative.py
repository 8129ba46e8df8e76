"""Friction learned by a network of its own (Gupta et al., 2020), and no friction at all."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray
from hil.networks.lagrangian.friction_settings import FrictionSettings

LEAST_REST_SPEED = 1e-4
"""Where a hard sign is asked for [rad/s]: at rest 1/|q̇| is no number."""


class NoFriction(nn.Module):
    """None: what a Lagrangian network alone is (Lutter et al., 2019)."""

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) zeros."""
        return torch.zeros_like(qd)

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) zeros."""
        return np.zeros_like(speeds, dtype=np.float64)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Nothing."""
        return {}


class Unconstrained(nn.Module):
    """Any torque that depends on position and velocity, as published: it may drive the arm.

    Args:
        n: Joints.
        torque_scale: (n,) unit of its outputs [N·m].
        settings: Widths of its hidden layers, and whether it has that unit.
        seed: Of the start weights.
    """

    scale: Tensor

    def __init__(
        self, n: int, torque_scale: FloatArray, settings: FrictionSettings, seed: int
    ) -> None:
        super().__init__()
        self.network = _perceptron((3 * n, *settings.hidden, n), seed)
        scale = _scale(n, torque_scale, settings)
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.get_default_dtype()))

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        torque: Tensor = self.network(_inputs(q, qd)) * self.scale
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] of each joint moving alone at q = 0, at speeds (K, n) [rad/s]."""
        return _alone(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Nothing: no weight means anything by itself."""
        return {}


class Dissipative(nn.Module):
    """D(q, q̇)·q̇ with D = A·Aᵀ ⪰ 0: friction that cannot give power, whatever its weights are.

    Friction hardly depends on the size of a velocity, so damping must go as 1/|q̇|, which a smooth
    network of q̇ cannot learn: its error on left-out trajectories is four times as large. Each row
    of A therefore has the factor (|q̇ᵢ| + `rest_speed`)^−½ and what a network of q and log|q̇| says:
    D stays ⪰ 0, and starts as Coulomb friction of unit·torque_scale in every joint.

    Args:
        n: Joints.
        torque_scale: (n,) standard deviation of each joint's torque [N·m].
        settings: Widths of its hidden layers, the unit, and below what speed damping stays.
        seed: Of the start weights.
    """

    scale: Tensor
    places: Tensor

    def __init__(
        self, n: int, torque_scale: FloatArray, settings: FrictionSettings, seed: int
    ) -> None:
        super().__init__()
        rows, columns = np.tril_indices(n)
        self.network = _perceptron((3 * n, *settings.hidden, len(rows)), seed)
        with torch.no_grad():
            start = np.where(rows == columns, np.sqrt(settings.unit), 0.0)
            last = self.network[-1]
            assert isinstance(last, nn.Linear)
            last.bias.copy_(torch.as_tensor(start))
        roots = np.sqrt(_scale(n, torque_scale, settings))[rows]
        self.register_buffer("scale", torch.as_tensor(roots, dtype=torch.get_default_dtype()))
        self.register_buffer("places", torch.as_tensor(rows * n + columns))
        self._n, self._rest = n, max(settings.rest_speed, LEAST_REST_SPEED)

    def factor(self, q: Tensor, qd: Tensor) -> Tensor:
        """(B, n, n) lower triangle A."""
        speed = qd.abs() + self._rest
        entries: Tensor = self.network(_inputs(q, torch.log(speed))) * self.scale
        flat = entries.new_zeros(len(q), self._n * self._n)
        lower = flat.index_copy(1, self.places, entries).view(-1, self._n, self._n)
        return lower * torch.rsqrt(speed)[..., None]

    def damping(self, q: Tensor, qd: Tensor) -> Tensor:
        """(B, n, n) D [N·m·s/rad]."""
        A = self.factor(q, qd)
        damping: Tensor = A @ A.mT
        return damping

    def forward(self, q: Tensor, qd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        A = self.factor(q, qd)
        torque: Tensor = (A @ (A.mT @ qd[..., None]))[..., 0]
        return torque

    def curve(self, speeds: FloatArray) -> FloatArray:
        """(K, n) torque [N·m] of each joint moving alone at q = 0, at speeds (K, n) [rad/s]."""
        return _alone(self, speeds)

    def intrinsic(self) -> dict[str, FloatArray]:
        """Nothing: no weight means anything by itself."""
        return {}


def _inputs(q: Tensor, velocity: Tensor) -> Tensor:
    return torch.cat([torch.cos(q), torch.sin(q), velocity], dim=-1)


def _scale(n: int, torque_scale: FloatArray, settings: FrictionSettings) -> FloatArray:
    return np.asarray(torque_scale, dtype=np.float64) if settings.scaled else np.ones(n)


def _perceptron(widths: tuple[int, ...], seed: int) -> nn.Sequential:
    """Layers of tanh and a linear one, from a seed of their own."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def _alone(network: nn.Module, speeds: FloatArray) -> FloatArray:
    curves = np.zeros_like(speeds, dtype=np.float64)
    with torch.no_grad():
        parameter = next(network.parameters())
        for joint, speed in enumerate(np.asarray(speeds).T):
            qd = torch.zeros(speeds.shape, dtype=parameter.dtype, device=parameter.device)
            qd[:, joint] = torch.as_tensor(speed)
            torque = network(torch.zeros_like(qd), qd, torch.sign(qd))
            curves[:, joint] = torque[:, joint].double().cpu().numpy()
    return curves
