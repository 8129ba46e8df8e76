"""Intrinsic parameters of a physical law: what an optimiser moves, and what that means.

An optimiser like Adam takes steps of about the learning rate in every parameter, whatever its
unit. Each parameter here is therefore of the order of 1, and multiplied by a unit.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hil.core import FloatArray

SHARPNESS = 4.0
"""Of the softplus: a coefficient about its unit moves 0.98 times as fast as its parameter."""


class Free(nn.Module):
    """Any value: unit·θ.

    Args:
        unit: (n,) of the value.
        start: Of the value, in units.
    """

    unit: Tensor

    def __init__(self, unit: FloatArray, start: float) -> None:
        super().__init__()
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.get_default_dtype()))
        self.theta = nn.Parameter(torch.full((len(unit),), start))

    def forward(self) -> Tensor:
        """(n,) values."""
        return self.unit * self.theta


class NotNegative(nn.Module):
    """A value that cannot fall below 0: unit·softplus(θ).

    Args:
        unit: (n,) of the value.
        start: Of the value, in units, above 0.
    """

    unit: Tensor

    def __init__(self, unit: FloatArray, start: float) -> None:
        super().__init__()
        self.register_buffer("unit", torch.as_tensor(unit, dtype=torch.get_default_dtype()))
        theta = math.log(math.expm1(SHARPNESS * start)) / SHARPNESS
        self.theta = nn.Parameter(torch.full((len(unit),), theta))

    def forward(self) -> Tensor:
        """(n,) values."""
        return self.unit * nn.functional.softplus(self.theta, beta=SHARPNESS)


class Between(nn.Module):
    """A positive value within bounds, which its logarithm moves between.

    Args:
        n: How many.
        bounds: Lowest and highest, above 0.
        start: Within them.
    """

    def __init__(self, n: int, bounds: tuple[float, float], start: float) -> None:
        super().__init__()
        self.low, self.span = math.log(bounds[0]), math.log(bounds[1] / bounds[0])
        share = math.log(start / bounds[0]) / self.span
        self.theta = nn.Parameter(torch.full((n,), math.log(share / (1.0 - share))))

    def forward(self) -> Tensor:
        """(n,) values."""
        return torch.exp(self.low + self.span * torch.sigmoid(self.theta))
