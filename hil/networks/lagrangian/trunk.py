"""Fully connected layers that carry a tangent along, and take a cotangent back.

No derivative here is left to autograd: a pass forwards gives the value and its rate along the
motion, a pass backwards the gradient by q. All are matrix products and elementwise functions, which
autograd can then differentiate by the weights, and exporters can write down.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from hil.networks.lagrangian.settings import NetworkSettings

LINEAR_ABOVE = 40.0
"""Where softplus is taken for the identity; in float64 it is there. torch's own 20 is not enough:
value and slope would disagree by 2e-9."""


class Tape(NamedTuple):
    """What the way back needs of the way there.

    Attributes:
        slopes: Of the activations of each hidden layer, each (B, units).
        turns: cos q and sin q (B, n) each; empty with raw q.
    """

    slopes: tuple[Tensor, ...]
    turns: tuple[Tensor, ...]


class Trunk(nn.Module):
    """q (B, n) to raw outputs (B, m).

    Args:
        n: Joints.
        outputs: m.
        settings: Layers, activation, features and first weights.
        seed: Of the first weights.
    """

    def __init__(self, n: int, outputs: int, settings: NetworkSettings, seed: int) -> None:
        super().__init__()
        self._sincos = settings.features == "sincos"
        self._activation = ACTIVATIONS[settings.activation]
        widths = (2 * n if self._sincos else n, *settings.hidden, outputs)
        random = torch.Generator().manual_seed(seed)
        self.layers: Any = nn.ModuleList(
            _layer(inputs, units, settings.hidden_gain, settings.bias, random)
            for inputs, units in pairwise(widths[:-1])
        )
        self.last = _layer(widths[-2], outputs, settings.output_gain, settings.bias, random)

    def forward(self, q: Tensor) -> Tensor:
        """Raw outputs (B, m)."""
        value = self._features(q)[0]
        for layer in self.layers:
            value, _ = self._activation(layer(value))
        return self._out(value)

    def along(self, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """Raw outputs (B, m), their rates of change when q moves with qd (B, m), and the tape."""
        value, turns = self._features(q)
        rate = torch.cat([-turns[1] * qd, turns[0] * qd], dim=-1) if turns else qd
        slopes = []
        for layer in self.layers:
            value, slope = self._activation(layer(value))
            rate = slope * functional.linear(rate, layer.weight)
            slopes.append(slope)
        tape = Tape(tuple(slopes), turns)
        return self._out(value), functional.linear(rate, self.last.weight), tape

    def pull_back(self, cotangent: Tensor, tape: Tape) -> Tensor:
        """Gradient by q (B, n) of what has this gradient (B, k) by the first k raw outputs."""
        found = cotangent @ self.last.weight[: cotangent.shape[-1]]
        for layer, slope in zip(reversed(self.layers), reversed(tape.slopes), strict=True):
            found = (found * slope) @ layer.weight
        if not tape.turns:
            return found
        by_cos, by_sin = found.chunk(2, dim=-1)
        return tape.turns[0] * by_sin - tape.turns[1] * by_cos

    def _features(self, q: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        if not self._sincos:
            return q, ()
        turns = (torch.cos(q), torch.sin(q))
        return torch.cat(turns, dim=-1), turns

    def _out(self, value: Tensor) -> Tensor:
        return functional.linear(value, self.last.weight, self.last.bias)


def _layer(inputs: int, units: int, gain: float, bias: float, random: torch.Generator) -> nn.Linear:
    """With first weights after Glorot (2010) from `random`; the global generator is left alone."""
    layer = nn.Linear(inputs, units, device="meta").to_empty(device="cpu")
    spread = gain * (2.0 / (inputs + units)) ** 0.5
    drawn = torch.randn((units, inputs), generator=random, dtype=torch.float64)
    with torch.no_grad():
        layer.weight.copy_(spread * drawn)
        layer.bias.fill_(bias)
    return layer


def softplus(total: Tensor) -> tuple[Tensor, Tensor]:
    """log(1 + eˣ) and its slope."""
    return functional.softplus(total, 1.0, LINEAR_ABOVE), torch.sigmoid(total)


def relu(total: Tensor) -> tuple[Tensor, Tensor]:
    """max(x, 0) and its slope, 0 at 0."""
    value = functional.relu(total)
    return value, torch.sign(value)


def _tanh(total: Tensor) -> tuple[Tensor, Tensor]:
    value = torch.tanh(total)
    return value, 1.0 - value * value


def _silu(total: Tensor) -> tuple[Tensor, Tensor]:
    gate = torch.sigmoid(total)
    value = total * gate
    return value, gate + value * (1.0 - gate)


ACTIVATIONS: dict[str, Callable[[Tensor], tuple[Tensor, Tensor]]] = {
    "softplus": softplus,
    "relu": relu,
    "tanh": _tanh,
    "silu": _silu,
}
"""Each gives value and slope."""
