"""From raw outputs to the Cholesky factor L of M = LLᵀ (paper eq. 4, 5), and back."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hil.networks.lagrangian.settings import NetworkSettings
from hil.networks.lagrangian.trunk import relu, softplus


class Factor(nn.Module):
    """The first n(n+1)/2 raw outputs, diagonal first, as a lower triangular matrix.

    Entries are put in their places by a product with a constant matrix, which every exporter
    knows, and which gives each row its unit on the way.

    Args:
        n: Joints.
        settings: Of the diagonal, and epsilon.
        unit: (n,) of the rows of L, in √(N·m s²).

    Attributes:
        entries: How many raw outputs it takes.
    """

    placement: Tensor

    def __init__(self, n: int, settings: NetworkSettings, unit: Tensor) -> None:
        super().__init__()
        self._n = n
        self.entries = n * (n + 1) // 2
        self._diagonal = softplus if settings.diagonal == "softplus" else relu
        of_factor = settings.epsilon_of == "factor"
        self._least = settings.epsilon if of_factor else 0.0
        self._added = 0.0 if of_factor else settings.epsilon
        self.register_buffer("placement", _placement(n, unit), persistent=False)

    def forward(self, raw: Tensor) -> Tensor:
        """L (B, n, n)."""
        return self._placed(self._entries(raw)[0])

    def along(self, raw: Tensor, rate: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """L, its rate of change (B, n, n), and the slopes of the diagonal (B, n)."""
        entries, slope = self._entries(raw)
        rates = torch.cat([slope * rate[..., : self._n], rate[..., self._n : self.entries]], -1)
        return self._placed(entries), self._placed(rates), slope

    def pull_back(self, cotangent: Tensor, slope: Tensor) -> Tensor:
        """Gradient (B, n(n+1)/2) by raw outputs of what has this gradient (B, n, n) by L."""
        found = cotangent.flatten(-2) @ self.placement.mT
        return torch.cat([slope * found[..., : self._n], found[..., self._n :]], -1)

    def mass(self, factor: Tensor) -> Tensor:
        """M (B, n, n) of L."""
        return factor @ factor.mT + self._added * torch.eye(self._n).to(factor)

    def momentum(self, factor: Tensor, turned: Tensor, velocity: Tensor) -> Tensor:
        """M·v (B, n), from u = Lᵀv (B, n) and v, without making M."""
        found = times(factor, turned)
        return found + self._added * velocity if self._added else found

    def _entries(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        diagonal, slope = self._diagonal(raw[..., : self._n])
        return torch.cat([diagonal + self._least, raw[..., self._n : self.entries]], -1), slope

    def _placed(self, entries: Tensor) -> Tensor:
        flat = entries @ self.placement
        return flat.reshape(*flat.shape[:-1], self._n, self._n)


def times(matrix: Tensor, vector: Tensor) -> Tensor:
    """A v (B, n) of matrices (B, n, n) and vectors (B, n)."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _placement(n: int, unit: Tensor) -> Tensor:
    """(n(n+1)/2, n²): entry to place, times the unit of its row."""
    rows, columns = torch.tril_indices(n, n, offset=-1)
    rows, columns = torch.cat([torch.arange(n), rows]), torch.cat([torch.arange(n), columns])
    found = torch.zeros(len(rows), n * n)
    found[torch.arange(len(rows)), rows * n + columns] = unit[rows].to(found)
    return found
