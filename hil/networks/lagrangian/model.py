"""The whole network: Lagrangian dynamics and joint friction, which add up (paper eq. 19)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor, nn

from hil.core import FloatArray
from hil.networks.lagrangian.choices import Design
from hil.networks.lagrangian.friction import friction_network
from hil.networks.lagrangian.network import LagrangianNetwork


class Torques(NamedTuple):
    """What the torque is made of, each (B, n) [N·m]; the four add up to it."""

    inertia: Tensor
    coriolis: Tensor
    gravity: Tensor
    friction: Tensor


class NetworkModel(nn.Module):
    """Torque of a motion: M(q)·q̈ + C(q, q̇)·q̇ + g(q) + friction.

    Args:
        design: Of both parts.
        torque_std: (n,) standard deviation of each joint's torque [N·m].
        seed: Of the first weights.
    """

    def __init__(self, design: Design, torque_std: FloatArray, seed: int = 0) -> None:
        super().__init__()
        n = len(torque_std)
        self.dynamics = LagrangianNetwork(n, design.network, torque_std, seed)
        self.friction = friction_network(design.kind, n, torque_std, design.friction, seed)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor, direction: Tensor) -> Tensor:
        """(B, n) torque [N·m]."""
        torque: Tensor = self.dynamics(q, qd, qdd) + self.friction(q, qd, direction)
        return torque

    def torques(self, q: Tensor, qd: Tensor, qdd: Tensor, direction: Tensor) -> Torques:
        """The same, apart."""
        parts = self.dynamics.parts(q, qd, qdd)
        friction = self.friction(q, qd, direction)
        return Torques(parts.inertia, parts.coriolis, parts.gravity, friction)

    def groups(self) -> dict[str, Sequence[nn.Parameter]]:
        """Parameters by the part that a stage trains or freezes."""
        parts = {"dynamics": self.dynamics, "friction": self.friction}
        found = {name: tuple(part.parameters()) for name, part in parts.items()}
        return {name: parameters for name, parameters in found.items() if parameters}
