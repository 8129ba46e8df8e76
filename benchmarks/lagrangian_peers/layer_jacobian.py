"""Jacobians from layer to layer, as paper eq. 11–14 and the public DeLaN go about it.

Beside its value every layer hands on its whole Jacobian by q, (B, units, n), from which dM/dt and
dM/dq, (B, n, n, n), are made. `published` multiplies diag(g′)·W out for every row first, as DeLaN
does; `lean` leaves W alone and scales the product, which is the same with less memory.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from hil.networks.lagrangian import LagrangianNetwork


class LayerJacobian:
    """The torque of a network with sin/cos features, softplus and a potential, its weights used.

    Args:
        net: With the default settings.
        lean: Do not multiply diag(g′)·W out.
    """

    def __init__(self, net: LagrangianNetwork, *, lean: bool) -> None:
        self._net, self._lean = net, lean
        n = round((len(net.factor.placement[0])) ** 0.5)
        self._n, self._entries = n, net.factor.entries
        below = torch.tril_indices(n, n, offset=-1)
        along = torch.arange(n)
        self._rows = torch.cat([along, below[0]])
        self._columns = torch.cat([along, below[1]])
        self._unit = net.factor.placement.view(-1, n, n)[along, along, along]

    def __call__(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """(B, n)."""
        value, by_q = self._features(q)
        for layer in self._net.trunk.layers:
            total = functional.linear(value, layer.weight, layer.bias)
            by_q = self._through(torch.sigmoid(total), layer.weight, by_q)
            value = functional.softplus(total)
        last = self._net.trunk.last
        return self._torque(
            functional.linear(value, last.weight, last.bias), last.weight @ by_q, qd, qdd
        )

    def _features(self, q: Tensor) -> tuple[Tensor, Tensor]:
        cos, sin = torch.cos(q), torch.sin(q)
        by_q = torch.cat([torch.diag_embed(-sin), torch.diag_embed(cos)], dim=1)
        return torch.cat([cos, sin], dim=-1), by_q

    def _through(self, slope: Tensor, weight: Tensor, by_q: Tensor) -> Tensor:
        if self._lean:
            return slope[:, :, None] * (weight @ by_q)
        return (slope[:, :, None] * weight) @ by_q

    def _torque(self, raw: Tensor, by_q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        n, entries = self._n, self._entries
        diagonal = functional.softplus(raw[:, :n]) + 1e-3
        diagonal_by_q = torch.sigmoid(raw[:, :n, None]) * by_q[:, :n]
        factor = self._triangle(torch.cat([diagonal, raw[:, n:entries]], 1))
        of_entries = torch.cat([diagonal_by_q, by_q[:, n:entries]], 1)
        rate = self._triangle((of_entries @ qd[:, :, None])[:, :, 0])
        by_each = self._triangle(of_entries.mT.reshape(-1, entries)).view(-1, n, n, n)
        mass = factor @ factor.mT
        mass_rate = factor @ rate.mT + rate @ factor.mT
        mass_by_q = by_each @ factor.mT[:, None] + factor[:, None] @ by_each.mT
        column = qd[:, :, None]
        quadratic = (qd[:, None, None, :] @ (mass_by_q @ column[:, None]))[:, :, 0, 0]
        gravity = self._net.gravity_unit * by_q[:, entries]
        turned: Any = mass @ qdd[:, :, None] + mass_rate @ column
        return turned[:, :, 0] - 0.5 * quadratic + gravity

    def _triangle(self, entries: Tensor) -> Tensor:
        n = self._n
        found = torch.zeros(len(entries), n, n, dtype=entries.dtype)
        found[:, self._rows, self._columns] = entries
        return self._unit[:, None] * found
