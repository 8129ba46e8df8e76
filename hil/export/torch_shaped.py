"""Friction that a few numbers per joint shape, in PyTorch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from hil.export.shaped import ShapedFriction
from hil.export.torch_constants import hold
from hil.export.torch_friction import Carried

LONG = 10.0
"""The second state's length, as a multiple of the first's."""

LARGEST_EXPONENT = 20.0
"""Larger powers than e to this count as that."""


class ShapedLaw(nn.Module):
    """The law of `hil.export.shaped`.

    Args:
        law: Of n joints.

    Attributes:
        parts: Name and size of what it carries; zeros are the start. Empty without memory.
    """

    def __init__(self, law: ShapedFriction) -> None:
        super().__init__()
        self.n, self.width = len(law.coulomb), law.sign_width
        self.least, self.more = law.least_speed, law.more_speed
        self.remembers, self.power_remembers = law.length is not None, law.power_remembers
        self.parts: tuple[tuple[str, int], ...] = ()
        length = np.ones(self.n) if law.length is None else law.length
        if self.remembers:
            self.parts = (("friction", 2 * self.n), ("last", self.n))
        hold(
            self,
            coulomb=law.coulomb,
            peak=law.static - law.coulomb,
            stribeck_speed=law.stribeck_speed,
            stribeck_exponent=law.stribeck_exponent,
            power=law.power,
            exponent=law.exponent,
            viscous=law.viscous,
            offset=law.offset,
            load=law.load,
            far=law.far,
            far_load=law.far_load,
            shortness=-1.0 / np.stack([length, LONG * length]),
        )

    def forward(
        self, q: Tensor, qd: Tensor, gears: Tensor, begun: Tensor | None, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """As `torch_friction.MemoryLaw.forward`."""
        load = torch.abs(gears)
        speed = torch.clamp(torch.abs(qd) + self.more, min=self.least)
        sign = torch.tanh(qd / self.width) if self.width > 0 else torch.sign(qd)
        share = torch.exp(-_power(speed / self.stribeck_speed, self.stribeck_exponent))
        size = self.coulomb + self.peak * share + self.load * load
        law = self.power * _power(speed, self.exponent)
        plain = self.viscous * qd + self.offset
        if not self.remembers:
            return sign * (size + law) + plain, {}
        z = self._advanced(carried["friction"], begun, q - carried["last"], qd)
        near, far = (one.reshape(-1, self.n) for one in z.split(1, dim=1))
        way = near if self.power_remembers else sign
        torque = near * size + way * law + plain + far * (self.far + self.far_load * load)
        return torque, {"friction": z.reshape(-1, 2 * self.n), "last": q}

    def _advanced(self, states: Tensor, begun: Tensor | None, way: Tensor, qd: Tensor) -> Tensor:
        """(B, 2, n) Dahl's states one step on: only what goes with the velocity counts as way."""
        gone = torch.where(way * qd > 0.0, way, 0.0)
        gone = torch.where(begun, gone, 0.0).reshape(-1, 1, self.n) if begun is not None else gone
        toward = torch.sign(gone)
        before = states.reshape(-1, 2, self.n)
        return toward + (before - toward) * torch.exp(torch.abs(gone) * self.shortness)


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    return torch.exp(torch.clamp(exponent * torch.log(base), max=LARGEST_EXPONENT))
