"""Lagrangian networks in PyTorch, with loads and with friction by a network of its own.

The network is that of `hil.networks.lagrangian.network`, in single precision whatever it was
trained in: runtimes lack some of its functions in double. What goes in and comes out is double.
Nothing scatters, gathers or branches.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hil.export.lagrangian_terms import LagrangianTerms, NetworkFriction
from hil.export.program import Program
from hil.export.torch_constants import hold
from hil.export.torch_friction import Carried
from hil.export.torch_rigid import RigidTorque
from hil.networks import LagrangianNetwork, NetworkSettings

SINGLE = torch.float32


class LagrangianTorque(nn.Module):
    """Torque of the network, and of the load by Newton and Euler.

    Args:
        program: Bodies that are nothing, and a Lagrangian network.
        terms: That network.
    """

    def __init__(self, program: Program, terms: LagrangianTerms) -> None:
        super().__init__()
        self.load = RigidTorque(program)
        self.network = lagrangian_network(terms)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """As `torch_rigid.RigidTorque.forward`."""
        carried, _ = self.load(q, qd, qdd, load)
        found = self.network(q.to(SINGLE), qd.to(SINGLE), qdd.to(SINGLE))
        torque = found.to(torch.float64) + carried
        return torque, torque


def lagrangian_network(terms: LagrangianTerms) -> LagrangianNetwork:
    """The network that the terms were read from; its weights do not learn."""
    layers, n = terms.trunk, len(terms.unit)
    settings = NetworkSettings(
        hidden=tuple(len(bias) for bias in layers.biases[:-1]),
        activation=terms.activation,
        features="sincos" if terms.sincos else "raw",
        gravity="potential" if terms.potential else "head",
        diagonal="relu" if terms.rectified else "softplus",
        epsilon=terms.least or terms.added,
        epsilon_of="factor" if terms.least else "mass",
        scaled=False,
    )
    network = LagrangianNetwork(n, settings)
    network.to(SINGLE)
    linear = [*network.trunk.layers, network.trunk.last]
    with torch.no_grad():
        for layer, weight, bias in zip(linear, layers.weights, layers.biases, strict=True):
            layer.weight.copy_(torch.as_tensor(weight))
            layer.bias.copy_(torch.as_tensor(bias))
        network.factor.placement.mul_(torch.as_tensor(np.repeat(terms.unit, n)))
        network.gravity_unit.copy_(torch.as_tensor(terms.gravity_unit))
    network.requires_grad_(False)
    return network


class NetworkLaw(nn.Module):
    """Friction by a network, dissipative or unconstrained.

    Args:
        friction: Of n joints.

    Attributes:
        parts: None; it has no memory.
    """

    parts: tuple[tuple[str, int], ...] = ()

    def __init__(self, friction: NetworkFriction) -> None:
        super().__init__()
        self.dissipative, self.rest = friction.dissipative, friction.rest_speed
        self.count = len(friction.layers.weights)
        self.n = friction.layers.weights[0].shape[1] // 3
        hold(self, SINGLE, scale=friction.scale)
        both = zip(friction.layers.weights, friction.layers.biases, strict=True)
        for k, (weight, bias) in enumerate(both):
            hold(self, SINGLE, **{f"weight{k}": weight, f"bias{k}": bias})
        if self.dissipative:
            hold(self, SINGLE, places=_places(self.n))

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """As `torch_friction.MemoryLaw.forward`."""
        q, qd = q.to(SINGLE), qd.to(SINGLE)
        speed = torch.abs(qd) + self.rest
        velocity = torch.log(speed) if self.dissipative else qd
        value = torch.cat([torch.cos(q), torch.sin(q), velocity], dim=1)
        for k in range(self.count):
            weight, bias = self.get_buffer(f"weight{k}"), self.get_buffer(f"bias{k}")
            value = functional.linear(value, weight, bias)
            value = torch.tanh(value) if k + 1 < self.count else value
        value = value * self.scale
        if not self.dissipative:
            return value.to(torch.float64), {}
        lower = (value @ self.places).reshape(-1, self.n, self.n)
        factor = lower * torch.rsqrt(speed).reshape(-1, self.n, 1)
        torque = factor @ (factor.transpose(1, 2) @ qd.reshape(-1, self.n, 1))
        return torque.reshape(-1, self.n).to(torch.float64), {}


def _places(n: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(n(n+1)/2, n²) entry of a lower triangle, row by row → place in the matrix."""
    rows, columns = np.tril_indices(n)
    found = np.zeros((len(rows), n * n))
    found[np.arange(len(rows)), rows * n + columns] = 1.0
    return found
