"""The dilated causal convolutional network that is trained (PINN paper, eq. 26–27).

Every layer is y = x + σ(w *_d x + b), chopped at its old end (Bai, Kolter & Koltun 2018), after
inputs were brought to its channels; nothing looks ahead. Groups are networks side by side that
share nothing. The last weights begin at zero: an untrained network adds nothing to the physics.

The only module of `hil.networks.residual` beside `problem` that imports torch.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from hil.networks.residual.settings import ResidualSettings
from hil.networks.residual.weights import Single, TcnWeights


class CausalTcn(nn.Module):
    """G causal networks, each with its own inputs and outputs.

    Args:
        inputs: F, of each group.
        outputs: O, of each group.
        settings: Channels, kernel, dilations, activation.
        groups: G.
        seed: Of the start weights.
    """

    def __init__(
        self, inputs: int, outputs: int, settings: ResidualSettings, groups: int = 1, seed: int = 0
    ) -> None:
        super().__init__()
        self.settings = settings
        self.groups = groups
        width, kernel = settings.width, settings.kernel
        draw = torch.Generator().manual_seed(seed)

        def drawn(*shape: int, fan_in: int) -> nn.Parameter:
            bound = 1.0 / math.sqrt(fan_in)
            return nn.Parameter((2 * torch.rand(shape, generator=draw) - 1) * bound)

        self.enter = drawn(groups, width, inputs, fan_in=inputs)
        self.enter_bias = nn.Parameter(torch.zeros(groups, width))
        self.taps = nn.ParameterList(
            drawn(groups, width, width, kernel, fan_in=width * kernel) for _ in settings.dilations
        )
        self.biases = nn.ParameterList(
            drawn(groups, width, fan_in=width * kernel) for _ in settings.dilations
        )
        self.leave = nn.Parameter(torch.zeros(groups, outputs, width))
        self.leave_bias = nn.Parameter(torch.zeros(groups, outputs))

    def forward(self, x: Tensor, every: int = 1) -> Tensor:
        """(B, G, O, L) from inputs (B, G, F, (L - 1)·every + window).

        Args:
            x: Inputs at every sample.
            every: Samples between outputs; it divides all dilations but the first. Layers behind
                the first then need no other instants: they cost so many times less.
        """
        batch, length = x.shape[0], x.shape[-1]
        h = self._mixed(x.reshape(batch, -1, length), self.enter, self.enter_bias)
        for number, dilation in enumerate(self.settings.dilations):
            apart = (every, dilation) if number == 0 else (1, dilation // every)
            h = self._layer(h, number, *apart)
        out = self._mixed(h, self.leave, self.leave_bias)
        return out.reshape(batch, self.groups, -1, out.shape[-1])

    def _layer(self, h: Tensor, number: int, stride: int, dilation: int) -> Tensor:
        taps, bias = self.taps[number], self.biases[number]
        y = functional.conv1d(
            h, taps.flatten(0, 1), bias.flatten(), stride, 0, dilation, self.groups
        )
        y = torch.tanh(y) if self.settings.activation == "tanh" else torch.relu(y)
        newest = (self.settings.kernel - 1) * dilation
        return y + h[..., newest::stride][..., : y.shape[-1]]

    def _mixed(self, h: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Channels of each group mixed, sample by sample."""
        return functional.conv1d(
            h, weight.flatten(0, 1)[..., None], bias.flatten(), groups=self.groups
        )

    def weights(self) -> TcnWeights:
        """As they are now, for prediction without torch."""
        return TcnWeights(
            enter=_array(self.enter),
            enter_bias=_array(self.enter_bias),
            taps=tuple(_array(taps) for taps in self.taps),
            biases=tuple(_array(bias) for bias in self.biases),
            leave=_array(self.leave),
            leave_bias=_array(self.leave_bias),
            dilations=self.settings.dilations,
            activation=self.settings.activation,
        )


def _array(values: Tensor) -> Single:
    return np.array(values.detach().float().cpu().numpy())
