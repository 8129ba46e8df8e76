"""Inverse dynamics of a network that learns M(q) and V(q), by Euler and Lagrange (paper eq. 8).

With T = ½ q̇ᵀM q̇, M = LLᵀ, u = Lᵀq̇ and a dot for the rate along the motion

    τ = d/dt(M q̇) − ∂(T − V)/∂q,   d/dt(M q̇) = L̇u + L(L̇ᵀq̇ + Lᵀq̈),   ∂T/∂L = q̇uᵀ.

L̇ comes from one tangent that goes through the layers with the value, the gradient by q from one
cotangent that goes back: three chains of matrix products. DeLaN (Lutter 2019; paper eq. 11–14)
multiplies Jacobians layer by layer instead, n tangents at once, and makes ∂M/∂q of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray, SpecError
from hil.networks.lagrangian.mass import Factor, times
from hil.networks.lagrangian.settings import NetworkSettings
from hil.networks.lagrangian.trunk import Tape, Trunk


class Parts(NamedTuple):
    """The terms of the inverse dynamics; the last three add up to the torque.

    Attributes:
        mass: M(q) (B, n, n) [kg·m²].
        inertia: M(q)·q̈ (B, n) [N·m].
        coriolis: C(q, q̇)·q̇ (B, n) [N·m].
        gravity: g(q) (B, n) [N·m].
    """

    mass: Tensor
    inertia: Tensor
    coriolis: Tensor
    gravity: Tensor


class _Motion(NamedTuple):
    """What the torque is made of: raw outputs, tape, L, L̇, slopes of L's diagonal, u = Lᵀq̇."""

    raw: Tensor
    tape: Tape
    factor: Tensor
    rate: Tensor
    slope: Tensor
    turned: Tensor


class LagrangianNetwork(nn.Module):
    """M(q), C(q, q̇)q̇ and g(q) of one network with two heads.

    The state dict holds the weights only; scales are given anew whenever one is built.

    Args:
        n: Joints.
        settings: Structure and start.
        torque_scale: (n,) typical torque of each joint [N·m], such as its standard deviation; 1
            without.
        seed: Of the first weights; the global generator is left alone.

    Raises:
        SpecError: The torque scales are not n numbers above zero.
    """

    gravity_unit: Tensor

    def __init__(
        self,
        n: int,
        settings: NetworkSettings | None = None,
        torque_scale: Sequence[float] | FloatArray | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        chosen = NetworkSettings() if settings is None else settings
        unit = _unit(n, torque_scale, scaled=chosen.scaled)
        self._potential = chosen.gravity == "potential"
        self.factor = Factor(n, chosen, torch.sqrt(unit))
        heads = self.factor.entries + (1 if self._potential else n)
        self.trunk = Trunk(n, heads, chosen, seed)
        nn.init.constant_(self.trunk.last.bias[:n], chosen.diagonal_bias)
        gravity_unit = unit.max().reshape(1) if self._potential else unit
        self.register_buffer("gravity_unit", gravity_unit, persistent=False)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Torque (B, n) [N·m] at q [rad], q̇ [rad/s] and q̈ [rad/s²], each (B, n)."""
        at = self._along(q, qd)
        turned = times(at.factor.mT, qdd) + times(at.rate.mT, qd)
        pushed = times(at.rate, at.turned) + self.factor.momentum(at.factor, turned, qdd)
        kinetic = self._by_kinetic(at, qd)
        if not self._potential:
            return pushed - self.trunk.pull_back(kinetic, at.tape) + self._head(at)
        both = torch.cat([kinetic, self._by_potential(at)], dim=-1)
        return pushed - self.trunk.pull_back(both, at.tape)

    def parts(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Parts:
        """The terms of the torque, apart; the same arguments."""
        at = self._along(q, qd)
        inertia = self.factor.momentum(at.factor, times(at.factor.mT, qdd), qdd)
        stirred = times(at.rate, at.turned) + times(at.factor, times(at.rate.mT, qd))
        kinetic = self._by_kinetic(at, qd)
        coriolis = stirred - self.trunk.pull_back(kinetic, at.tape)
        gravity = self._head(at) if not self._potential else self._uphill(at, kinetic)
        return Parts(self.factor.mass(at.factor), inertia, coriolis, gravity)

    def mass(self, q: Tensor) -> Tensor:
        """M(q) (B, n, n), symmetric and positive definite [kg·m²]."""
        return self.factor.mass(self.factor(self.trunk(q)))

    def _along(self, q: Tensor, qd: Tensor) -> _Motion:
        raw, raw_rate, tape = self.trunk.along(q, qd)
        factor, rate, slope = self.factor.along(raw, raw_rate)
        return _Motion(raw, tape, factor, rate, slope, times(factor.mT, qd))

    def _by_kinetic(self, at: _Motion, qd: Tensor) -> Tensor:
        """Gradient of T by the raw entries of L; what epsilon adds to M does not depend on q."""
        return self.factor.pull_back(qd.unsqueeze(-1) * at.turned.unsqueeze(-2), at.slope)

    def _by_potential(self, at: _Motion) -> Tensor:
        """Gradient of −V by its raw output."""
        # Ones of the same shape would ask for it at run time, which small targets cannot answer.
        return 0.0 * at.raw[..., -1:] - self.gravity_unit

    def _uphill(self, at: _Motion, kinetic: Tensor) -> Tensor:
        alone = torch.cat([torch.zeros_like(kinetic), -self._by_potential(at)], dim=-1)
        return self.trunk.pull_back(alone, at.tape)

    def _head(self, at: _Motion) -> Tensor:
        return self.gravity_unit * at.raw[..., self.factor.entries :]


def _unit(n: int, torque_scale: Sequence[float] | FloatArray | None, *, scaled: bool) -> Tensor:
    """(n,) typical torques, as torch's default type."""
    given = np.ones(n) if torque_scale is None else np.asarray(torque_scale, dtype=np.float64)
    if given.shape != (n,) or not np.all(np.isfinite(given) & (given > 0.0)):
        raise SpecError(
            f"torque_scale is {given.tolist()!r}, but must be {n} numbers above zero",
            hint="a joint whose torque never changes has no scale: leave it out, or give one",
        )
    return torch.as_tensor(given if scaled else np.ones(n), dtype=torch.get_default_dtype())
