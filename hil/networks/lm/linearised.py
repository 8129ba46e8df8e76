"""The Jacobian of a network, kept as its factors: most of what one needs never writes it out.

The derivative of the output by the weight from input k to unit i of a layer is a_k·δ_i: what the
layer saw times what its unit passes on to the output. Hence Jᵀv and J·u are a product of small
matrices per layer, and J·Jᵀ = Σ (aᵀa)∘(δᵀδ) over the layers (∘: element by element), which costs
a seventh of multiplying the rows of J for the static paper's network.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from hil.networks.lm.arrays import Array, Arrays

CHUNK = 512
"""Samples whose part of the Jacobian is written out at once; it stays in the cache."""

BLOCK = 192
"""Rows of J·Jᵀ made at once; only blocks on and below the diagonal are."""


class Linearised:
    """Networks linearised at their weights.

    Args:
        seen: Per layer what it saw, constant 1 last, (B or 1, inputs + 1, N).
        deltas: Per layer the derivative of the output by its units' sums, (B, units, N).
        arrays: Where and how to compute.
    """

    def __init__(self, seen: list[Array], deltas: list[Array], arrays: Arrays) -> None:
        self._seen, self._deltas, self._arrays = seen, deltas, arrays
        self.networks, _, self.rows = deltas[0].shape
        self.weights = sum(a.shape[1] * d.shape[1] for a, d in self._layers())

    def jacobian(self, rows: slice = slice(None), out: Array | None = None) -> Array:
        """(B, P, rows): the transposed Jacobian, written out."""
        count = len(range(*rows.indices(self.rows)))
        J = self._arrays.empty((self.networks, self.weights, count)) if out is None else out
        start = 0
        for seen, delta in self._layers():
            stop = start + seen.shape[1] * delta.shape[1]
            part = J[:, start:stop].reshape(self.networks, seen.shape[1], delta.shape[1], count)
            self._arrays.multiply(seen[:, :, None, rows], delta[:, None, :, rows], out=part)
            start = stop
        return J

    def transposed_times(self, v: Array) -> Array:
        """Jᵀv (B, P) for v (B, N)."""
        parts = [
            (seen @ (delta * v[:, None]).swapaxes(-1, -2)).reshape(self.networks, -1)
            for seen, delta in self._layers()
        ]
        return self._arrays.concatenate(parts)

    def times(self, matrices: list[Array]) -> Array:
        """J·u (B, N) for u given as one matrix (B, inputs + 1, units) per layer."""
        return sum(
            ((matrix.swapaxes(-1, -2) @ seen) * delta).sum(1)
            for matrix, (seen, delta) in zip(matrices, self._layers(), strict=True)
        )

    def normal_matrix(self) -> Array:
        """JᵀJ (B, P, P); on the CPU only its lower triangle is filled."""
        total = self._arrays.zeros((self.networks, self.weights, self.weights))
        parts = -(-self.rows // CHUNK)
        edges = [self.rows * k // parts for k in range(parts + 1)]
        widest = max(b - a for a, b in pairwise(edges))
        buffer = self._arrays.empty((self.networks * self.weights * widest,))
        for start, stop in pairwise(edges):
            size = self.networks * self.weights * (stop - start)
            J = buffer[:size].reshape(self.networks, self.weights, stop - start)
            self.jacobian(slice(start, stop), out=J)
            self._arrays.add_gram(J, total)
        return total

    def kernel(self) -> Array:
        """J·Jᵀ (B, N, N), its blocks on and below the diagonal; the rest is 0."""
        total = self._arrays.zeros((self.networks, self.rows, self.rows))
        for start in range(0, self.rows, BLOCK):
            stop = min(start + BLOCK, self.rows)
            block = total[:, start:stop, :stop]
            for seen, delta in self._layers():
                product = delta[:, :, start:stop].swapaxes(-1, -2) @ delta[:, :, :stop]
                product *= seen[:, :, start:stop].swapaxes(-1, -2) @ seen[:, :, :stop]
                block += product
        return total

    def _layers(self) -> Iterator[tuple[Array, Array]]:
        return zip(self._seen, self._deltas, strict=True)
