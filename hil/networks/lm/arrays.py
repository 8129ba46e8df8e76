"""The few operations that differ between numpy on the CPU and torch on a GPU."""

from __future__ import annotations

from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from scipy.linalg import blas, lapack

from hil.core import BoolArray, FloatArray

Array: TypeAlias = Any
"""A numpy array or a torch tensor."""

Precision = Literal["float64", "float32"]


class Arrays(Protocol):
    """Where networks are computed and with how many digits."""

    def asarray(self, values: FloatArray) -> Array:
        """To the device and the precision."""

    def inputs(self, X: FloatArray) -> Array:
        """(N, d) or (B, N, d) as (1 or B, d + 1, N) with a row of ones."""

    def to_numpy(self, values: Array) -> FloatArray:
        """Back to float64 on the CPU."""

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Memory with anything in it."""

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Zeros."""

    def ones_like(self, values: Array) -> Array:
        """Ones of the same shape."""

    def concatenate(self, parts: list[Array]) -> Array:
        """Along the second axis."""

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """a·b into `out`, with broadcasting."""

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """(B, u, N) through its activation, and a row of ones below."""

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ of (B, P, n) to (B, P, P); the lower triangle is enough."""

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """(matrix + shift·1)⁻¹ target in float64.

        Args:
            matrix: (B, m, m), symmetric, lower triangle.
            shift: (B,).
            target: (B, m).

        Returns:
            (B, m), and (B,) whether the matrix was positive definite.
        """

    def mean_diagonal(self, matrix: Array) -> FloatArray:
        """(B,) trace over size."""


class NumpyArrays:
    """On the CPU, through BLAS and LAPACK."""

    def __init__(self, precision: Precision) -> None:
        self._dtype: Any = np.dtype(precision)
        self._syrk: Any = blas.ssyrk if precision == "float32" else blas.dsyrk

    def asarray(self, values: FloatArray) -> Array:
        """To the precision."""
        return np.ascontiguousarray(values, dtype=self._dtype)

    def inputs(self, X: FloatArray) -> Array:
        """(N, d) or (B, N, d) as (1 or B, d + 1, N) with a row of ones."""
        return self.asarray(rows_last(X))

    def to_numpy(self, values: Array) -> FloatArray:
        """To float64."""
        return np.asarray(values, dtype=np.float64)

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Memory with anything in it."""
        return np.empty(shape, dtype=self._dtype)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Zeros."""
        return np.zeros(shape, dtype=self._dtype)

    def ones_like(self, values: Array) -> Array:
        """Ones of the same shape."""
        return np.ones_like(values)

    def concatenate(self, parts: list[Array]) -> Array:
        """Along the second axis."""
        return np.concatenate(parts, axis=1)

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """a·b into `out`."""
        np.multiply(a, b, out=out)

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """(B, u, N) through its activation, and a row of ones below."""
        networks, units, rows = total.shape
        out = self.empty((networks, units + 1, rows))
        out[:, -1] = 1
        if tanh:
            np.tanh(total, out=out[:, :-1])
        else:
            out[:, :-1] = total
        return out

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ to the lower triangles."""
        for part, matrix in zip(J, total, strict=True):
            # The transposed views are in Fortran's order: nothing is copied. Its upper triangle
            # is our lower one.
            self._syrk(1.0, part.T, beta=1.0, c=matrix.T, trans=1, lower=0, overwrite_c=1)

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """(matrix + shift·1)⁻¹ target by Cholesky, one network after the other."""
        solution = np.zeros(target.shape)
        definite = np.zeros(len(target), dtype=bool)
        for b in range(len(target)):
            shifted = np.array(matrix[b], dtype=np.float64, order="C")
            shifted.flat[:: len(shifted) + 1] += shift[b]
            factor, info = lapack.dpotrf(shifted.T, lower=0, overwrite_a=1, clean=0)
            definite[b] = info == 0
            if info == 0:
                solution[b] = lapack.dpotrs(factor, np.float64(target[b]), lower=0)[0]
        return solution.astype(self._dtype), definite

    def mean_diagonal(self, matrix: Array) -> FloatArray:
        """(B,) trace over size."""
        return np.asarray(np.einsum("bii->b", matrix) / matrix.shape[1], dtype=np.float64)


def rows_last(X: FloatArray) -> FloatArray:
    """(N, d) or (B, N, d) as (1 or B, d + 1, N) with a row of ones."""
    batch = X[None] if X.ndim == 2 else X
    networks, rows, inputs = batch.shape
    out = np.ones((networks, inputs + 1, rows))
    out[:, :-1] = batch.swapaxes(-1, -2)
    return out


def numpy_arrays(precision: Precision) -> Arrays:
    """Arrays on the CPU."""
    return NumpyArrays(precision)
