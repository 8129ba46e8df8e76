"""The same operations on a GPU. The only module of `hil.networks.lm` that imports torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from hil.core import BoolArray, FloatArray, SpecError
from hil.networks.lm.arrays import Array, Precision, rows_last


class TorchArrays:
    """On a device of torch, all networks in one call.

    Raises:
        SpecError: torch has no such device here.
    """

    def __init__(self, device: str, precision: Precision) -> None:
        try:
            self._device = torch.device(device)
            torch.zeros(1, device=self._device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).partition("\n")[0]
            raise SpecError(
                f"torch cannot use the device {device!r}: {reason}", hint="use device: cpu"
            ) from error
        self._dtype: Any = getattr(torch, precision)

    def asarray(self, values: FloatArray) -> Array:
        """To the device and the precision."""
        return torch.as_tensor(values, dtype=self._dtype, device=self._device).contiguous()

    def inputs(self, X: FloatArray) -> Array:
        """(N, d) or (B, N, d) as (1 or B, d + 1, N) with a row of ones."""
        return self.asarray(rows_last(X))

    def to_numpy(self, values: Array) -> FloatArray:
        """Back to float64 on the CPU."""
        return np.asarray(values.double().cpu().numpy())

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Memory with anything in it."""
        return torch.empty(shape, dtype=self._dtype, device=self._device)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Zeros."""
        return torch.zeros(shape, dtype=self._dtype, device=self._device)

    def ones_like(self, values: Array) -> Array:
        """Ones of the same shape."""
        return torch.ones_like(values)

    def concatenate(self, parts: list[Array]) -> Array:
        """Along the second axis."""
        return torch.cat(parts, dim=1)

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """a·b into `out`."""
        torch.mul(a, b, out=out)

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """(B, u, N) through its activation, and a row of ones below."""
        value = torch.tanh(total) if tanh else total
        return torch.cat([value, torch.ones_like(value[:, :1])], dim=1)

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ, the whole of it."""
        total.baddbmm_(J, J.mT)

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """(matrix + shift·1)⁻¹ target by Cholesky, all networks at once."""
        shifted = matrix.double().clone()
        added = torch.as_tensor(shift, dtype=torch.float64, device=self._device)
        shifted.diagonal(dim1=-2, dim2=-1).add_(added[:, None])
        factor, info = torch.linalg.cholesky_ex(shifted)
        solution = torch.cholesky_solve(target.double()[..., None], factor)[..., 0]
        definite: BoolArray = (info == 0).cpu().numpy()
        return solution.to(self._dtype), definite

    def mean_diagonal(self, matrix: Array) -> FloatArray:
        """(B,) trace over size."""
        return self.to_numpy(matrix.diagonal(dim1=-2, dim2=-1).double().mean(-1))
