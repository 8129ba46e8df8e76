"""A residual network in PyTorch, one sample at a time: what its taps reach back to is handed on.

The memory of every layer is kept as what differs from the stream's first sample, which is taken to
have lasted for ever before. So zeros are the start, and nothing has to be filled.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from hil.core import FloatArray
from hil.export.c_network_weights import CellWeights, cell_weights
from hil.export.torch_constants import hold
from hil.export.torch_friction import Carried
from hil.networks import Correction


class StreamingTcn(nn.Module):
    """The mean of a correction's networks, E cells of W channels side by side.

    Arithmetic of the network is in single precision, as it was trained.

    Args:
        correction: Networks that hear no torque; at least one joint keeps its own.

    Attributes:
        parts: Name and size of what it carries; zeros are the start.
    """

    def __init__(self, correction: Correction) -> None:
        super().__init__()
        self.settings = correction.settings
        weights = cell_weights(correction)
        self.n, self.networks = len(correction.kept), len(correction.networks)
        self.own = self.settings.layout == "grouped"
        self.cells, self.width = len(weights.enter), self.settings.width
        self.sets = len(weights.means)
        signs = len(self.settings.sign_widths)
        own = 2 + signs + self.settings.base_input
        self.features = own if self.own else 3 * self.n
        self.rows = tuple((self.settings.kernel - 1) * d for d in self.settings.dilations)
        layer = self.cells * self.width
        self.parts = (
            *((f"first {k}", layer) for k in range(len(self.rows))),
            *((f"ring {k}", rows * layer) for k, rows in enumerate(self.rows)),
        )
        hold(self, **self._inputs(weights, correction))
        hold(self, torch.float32, **self._weights(weights))

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor, base: Tensor, begun: Tensor, carried: Carried
    ) -> tuple[Tensor, Carried]:
        """What is added to the effort (B, n) of the physics, and what is carried on.

        Args:
            q: (B, n) [rad].
            qd: (B, n) [rad/s].
            qdd: (B, n) [rad/s²].
            base: (B, n) effort of the physics.
            begun: (B, 1) whether there was a sample before.
            carried: What `parts` names.
        """
        h = self._entered(self._seen(q, qd, qdd, base))
        after: Carried = {}
        for k in range(len(self.rows)):
            now, ring = self._flat(h).double(), carried[f"ring {k}"]
            first = torch.where(begun, carried[f"first {k}"], now)
            h = self._layer(k, h, first, ring)
            after[f"first {k}"] = first
            # The oldest row leaves, this sample's comes behind.
            after[f"ring {k}"] = torch.cat([ring[:, now.shape[1] :], now - first], dim=1)
        out = self._flat(torch.bmm(h, self.leave) + self.leave_bias).double()
        added = torch.minimum(torch.maximum(out @ self.share, -self.limit), self.limit)
        return added, after

    def _seen(self, q: Tensor, qd: Tensor, qdd: Tensor, base: Tensor) -> Tensor:
        """(S, B, F) inputs, scaled and held in the range of the training."""
        if self.own:
            one = [values.reshape(-1, 1, self.n) for values in (qd, qdd, base)]
            signs = torch.tanh(one[0] * self.signs)
            raw = torch.cat([one[0], signs, one[1], *one[2:][: self.settings.base_input]], dim=1)
            raw = (raw @ self.kept).transpose(1, 2)
        else:
            raw = torch.stack([q, qd, qdd], dim=2)
        raw = raw.reshape(-1, 1, self.sets // self.networks, self.features)
        scaled = (raw - self.mean) * self.rate
        held = torch.minimum(torch.maximum(scaled, self.lowest), self.highest)
        return held.reshape(-1, self.sets, self.features).float().transpose(0, 1)

    def _entered(self, seen: Tensor) -> Tensor:
        """(E, B, W): the branches of a network see the same."""
        branches = self.cells // self.sets
        h = torch.bmm(seen, self.enter).reshape(self.sets, -1, branches, self.width)
        return h.transpose(1, 2).reshape(self.cells, -1, self.width) + self.enter_bias

    def _layer(self, number: int, h: Tensor, first: Tensor, ring: Tensor) -> Tensor:
        """(E, B, W) out of (E, B, W)."""
        rows, before = self.rows[number], self.settings.kernel - 1
        old = ring.reshape(-1, rows, self.cells * self.width)
        old = old[:, :: self.settings.dilations[number]]
        old = (old + first.reshape(-1, 1, self.cells * self.width)).float()
        old = old.reshape(-1, before, self.cells, self.width).permute(2, 0, 1, 3)
        seen = torch.cat([old.reshape(self.cells, -1, before * self.width), h], dim=2)
        taps, bias = getattr(self, f"taps_{number}"), getattr(self, f"bias_{number}")
        total = torch.bmm(seen, taps) + bias
        return h + (torch.tanh(total) if self.settings.activation == "tanh" else torch.relu(total))

    def _flat(self, h: Tensor) -> Tensor:
        """(B, E·C) of (E, B, C)."""
        return h.transpose(0, 1).reshape(-1, self.cells * h.shape[2])

    def _inputs(self, weights: CellWeights, correction: Correction) -> dict[str, FloatArray]:
        shape = (1, self.networks, self.sets // self.networks, self.features)
        names = {"mean": "means", "rate": "rates", "lowest": "lowest", "highest": "highest"}
        found = {
            name: getattr(weights, of)[:, : self.features].reshape(shape)
            for name, of in names.items()
        }
        share = np.zeros((len(weights.share), self.n))
        share[np.arange(len(share)), weights.joints] = weights.share
        limit = np.where(correction.kept, correction.limit, 0.0)
        return found | {
            "share": share,
            "limit": limit,
            "signs": 1.0 / np.reshape(self.settings.sign_widths, (-1, 1)),
            "kept": np.eye(self.n)[:, correction.kept],
        }

    def _weights(self, weights: CellWeights) -> dict[str, FloatArray]:
        """Without the zeros that C fills up with, as factors of products over a cell."""
        E, S, W, F, K = self.cells, self.sets, self.width, self.features, self.settings.kernel
        filled = weights.biases.shape[1]
        enter = weights.enter.reshape(E, -1, filled)[:, :F, :W]
        leave = weights.leave.reshape(E, -1, filled)[..., :W]
        taps = weights.taps.reshape(-1, E, K, filled, filled)[..., :W, :W]
        biases = weights.biases.reshape(-1, E, 1, filled)[..., :W]
        found = {
            "enter": enter.reshape(S, E // S, F, W).transpose(0, 2, 1, 3).reshape(S, F, -1),
            "enter_bias": weights.enter_bias.reshape(E, 1, filled)[..., :W],
            "leave": leave.transpose(0, 2, 1),
            "leave_bias": weights.leave_bias.reshape(E, 1, -1),
        }
        for number in range(len(self.rows)):
            found[f"taps_{number}"] = taps[number].reshape(E, K * W, W)
            found[f"bias_{number}"] = biases[number]
        return found
