"""A program as a PyTorch module: one sample of many independent streams at once."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from hil.export.lagrangian_terms import NetworkFriction
from hil.export.program import PlainFriction, Program
from hil.export.shaped import ShapedFriction
from hil.export.torch_constants import hold
from hil.export.torch_friction import Carried, MemoryLaw, PlainLaw
from hil.export.torch_lagrangian import LagrangianTorque, NetworkLaw
from hil.export.torch_network import StreamingTcn
from hil.export.torch_rigid import RigidTorque
from hil.export.torch_shaped import ShapedLaw


class ProgramModule(nn.Module):
    """effort[, state_next] = module(q, qd, qdd, load[, state]), all in double precision.

    Differentiable in q, qd, qdd and the state, but for the signs within friction; nothing is
    written in place.

    Args:
        program: What to compute. A network that no joint keeps counts as none.

    Attributes:
        parts: Name and size of what the state holds, in this order; empty without memory.
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.physics = physics_module(program)
        self.friction = friction_module(program)
        self.network = network_module(program)
        hold(self, scale=program.scale)
        carried = self.friction.parts + (self.network.parts if self.network is not None else ())
        self.parts: tuple[tuple[str, int], ...] = (("begun", 1), *carried) if carried else ()

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor, load: Tensor, state: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """(effort,) without memory, (effort, state_next) with it.

        Args:
            q: (B, n) [rad].
            qd: (B, n) [rad/s].
            qdd: (B, n) [rad/s²].
            load: (B, 10) mass [kg], centre of mass [m] in the flange's frame, inertia about it
                (xx, yy, zz, xy, xz, yz) [kg·m²].
            state: (B, S) of the sample before; zeros are the start. None without memory.
        """
        torque, gears = self.physics(q, qd, qdd, load)
        carried, begun = self._carried(state)
        friction, held = self.friction(q, qd, gears, begun, carried)
        effort = (torque + friction) / self.scale
        after = dict(carried) | held
        if self.network is not None:
            added, rings = self.network(q, qd, qdd, effort, begun, carried)
            effort, after = effort + added, after | rings
        if not self.parts:
            return (effort,)
        after["begun"] = torch.clamp(carried["begun"], min=1.0)
        return effort, torch.cat([after[name] for name, _ in self.parts], dim=1)

    def _carried(self, state: Tensor | None) -> tuple[Carried, Tensor | None]:
        """Parts of the state by name, and whether there was a sample before, (B, 1)."""
        if state is None:
            return {}, None
        names, sizes = zip(*self.parts, strict=True)
        carried = dict(zip(names, state.split(sizes, dim=1), strict=True))
        return carried, carried["begun"] > 0.5


def physics_module(program: Program) -> nn.Module:
    """(q, qd, qdd, load) → torque with load, and that of the gears, each (B, n) [N·m]."""
    if program.lagrangian is not None:
        return LagrangianTorque(program, program.lagrangian)
    return RigidTorque(program)


def friction_module(program: Program) -> nn.Module:
    """(q, qd, gears, begun, carried) → torque (B, n) [N·m], and what is carried on.

    Its `parts` say what that is; see `torch_friction.MemoryLaw`.
    """
    friction = program.friction
    if isinstance(friction, PlainFriction):
        return PlainLaw(friction)
    if isinstance(friction, ShapedFriction):
        return ShapedLaw(friction)
    if isinstance(friction, NetworkFriction):
        return NetworkLaw(friction)
    return MemoryLaw(friction)


def network_module(program: Program) -> StreamingTcn | None:
    """The residual networks, where a joint keeps its own."""
    correction = program.correction
    if correction is None or not np.any(correction.kept):
        return None
    return StreamingTcn(correction)
