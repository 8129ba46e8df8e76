"""Multilayer perceptrons of any layout, B of them side by side, and their derivative by weight.

`Mlp` is a layout; weights are handed over. Those of one network are one vector: layer by layer, and
in each layer input by input the weights to all its units, the biases last. A layer's weights are
therefore a matrix (inputs + 1, units), and a constant 1 as the last input makes the bias a weight
like the others. Arrays are kept with the samples last, (B, units, N): each row of the Jacobian is
then one product of two contiguous rows.

`Linearised` keeps the Jacobian as its factors; most operations never write it out. The derivative
of the output by the weight from input k to unit i of a layer is a_k·δ_i: the input of the layer
times the derivative of the output by the unit's sum. Hence Jᵀv and J·u are a product of small
matrices per layer, and J·Jᵀ = Σ (aᵀa)∘(δᵀδ) over the layers (∘: element by element), which costs a
seventh of multiplying the rows of J for the static paper's network.

`Arrays` holds the few operations that differ between numpy on the CPU and torch on a GPU.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, Protocol, TypeAlias, cast

import numpy as np
from scipy.linalg import blas, lapack

from hil.core import BoolArray, FloatArray, SpecError

ACTIVATIONS = ("tanh", "linear")

Array: TypeAlias = Any
"""A numpy array or a torch tensor."""


@dataclass(frozen=True, slots=True)
class Mlp:
    """Layout of a network with one output.

    Args:
        layers: Units per layer from the inputs to the output, such as (4, 20, 20, 10, 1).
        activations: One per layer behind the inputs, `tanh` or `linear`; by default tanh in the
            hidden layers and a linear output. The static paper has a linear first hidden layer:
            (linear, tanh, tanh, linear).

    Raises:
        SpecError: That is no network with one output.
    """

    layers: tuple[int, ...]
    activations: tuple[str, ...] = ()

    def __init__(self, layers: Sequence[int], activations: Sequence[str] | None = None) -> None:
        object.__setattr__(self, "layers", _checked_layers(layers))
        object.__setattr__(self, "activations", _checked_activations(activations, len(layers) - 1))

    @property
    def inputs(self) -> int:
        """Number of inputs d."""
        return self.layers[0]

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """(inputs + 1, units) of each layer's weights."""
        return tuple((a + 1, b) for a, b in zip(self.layers, self.layers[1:], strict=False))

    @property
    def n_weights(self) -> int:
        """Number of weights P, biases included."""
        return sum(rows * units for rows, units in self.shapes)

    def __str__(self) -> str:
        return "-".join(str(units) for units in self.layers)

    def initial(self, seed: int, network: int = 0) -> FloatArray:
        """Start weights (P,), drawn for standardised inputs and target.

        Weights and biases are uniform within ±√(3 / (inputs + 1)), so that with inputs of variance
        1 every unit's sum has variance 1: tanh is then neither flat nor straight.

        Args:
            seed: Of the training.
            network: Number within the batch; every network has its own draw.
        """
        random = np.random.default_rng([seed, network])
        parts = [
            random.uniform(-1.0, 1.0, rows * units) * np.sqrt(3.0 / rows)
            for rows, units in self.shapes
        ]
        return np.concatenate(parts)

    def matrices(self, weights: Array) -> list[Array]:
        """Views (B, inputs + 1, units), one per layer, of weights (B, P)."""
        found, start = [], 0
        for rows, units in self.shapes:
            stop = start + rows * units
            found.append(weights[:, start:stop].reshape(-1, rows, units))
            start = stop
        return found

    def forward(self, weights: Array, inputs: Array, arrays: Arrays) -> Pass:
        """Run the networks (B, P) on inputs with a row of ones, (B or 1, d + 1, N)."""
        matrices = self.matrices(weights)
        seen = [inputs]
        for matrix, activation in zip(matrices, self.activations, strict=True):
            total = matrix.swapaxes(-1, -2) @ seen[-1]
            seen.append(arrays.with_ones(total, tanh=activation == "tanh"))
        return Pass(self, matrices, seen, arrays)

    def predict(self, weights: FloatArray, X: FloatArray) -> FloatArray:
        """Outputs (B, N) for weights (B, P) and inputs (N, d) or (B, N, d)."""
        arrays = NumpyArrays("float64")
        return cast("FloatArray", self.forward(weights, arrays.inputs(X), arrays).output)

    def jacobian(self, weights: FloatArray, X: FloatArray) -> FloatArray:
        """Derivative (B, N, P) of the outputs by the weights (B, P) at (N, d) or (B, N, d)."""
        arrays = NumpyArrays("float64")
        passed = self.forward(weights, arrays.inputs(X), arrays)
        return cast("FloatArray", passed.linearised().jacobian().swapaxes(-1, -2))


def _checked_layers(layers: Any) -> tuple[int, ...]:
    numbers = isinstance(layers, list | tuple) and all(
        isinstance(units, int) and not isinstance(units, bool) and units > 0 for units in layers
    )
    if not numbers or len(layers) < 2:
        raise SpecError(
            f"layers is {layers!r}, but must be a list of at least two positive whole numbers",
            hint="inputs first, output last, for example [4, 20, 20, 10, 1]",
        )
    if layers[-1] != 1:
        raise SpecError(
            f"layers ends with {layers[-1]}, but a network has one output",
            hint="train one network per output: they are trained together",
        )
    return tuple(layers)


def _checked_activations(activations: Any, count: int) -> tuple[str, ...]:
    if activations is None:
        return ("tanh",) * (count - 1) + ("linear",)
    given = tuple(activations) if isinstance(activations, list | tuple) else ()
    if len(given) != count or not set(given) <= set(ACTIVATIONS):
        raise SpecError(
            f"activations is {activations!r}, but must be {count} words, each tanh or linear",
            hint="one per layer behind the inputs; the paper's are linear, tanh, tanh, linear",
        )
    return given


class Pass:
    """What went through the networks: kept for the derivative.

    Attributes:
        output: (B, N).
    """

    def __init__(self, mlp: Mlp, matrices: list[Array], seen: list[Array], arrays: Arrays) -> None:
        self._mlp, self._matrices, self._seen, self._arrays = mlp, matrices, seen, arrays
        self.output: Array = seen[-1][:, 0]

    def linearised(self, row_scale: Array | None = None) -> Linearised:
        """The derivative, by one backward sweep; each row times `row_scale` (N,) if given."""
        delta = self._slope(-1, self._arrays.ones_like(self._seen[-1][:, :-1]))
        if row_scale is not None:
            delta = delta * row_scale
        deltas = [delta]
        for layer in range(len(self._matrices) - 1, 0, -1):
            back = self._matrices[layer][:, :-1] @ deltas[0]
            deltas.insert(0, self._slope(layer - 1, back))
        return Linearised(self._seen[:-1], deltas, self._arrays)

    def _slope(self, layer: int, delta: Array) -> Array:
        """Through the activation of a layer, in place: tanh′ = 1 − tanh²."""
        if self._mlp.activations[layer] == "tanh":
            value = self._seen[layer if layer < 0 else layer + 1][:, :-1]
            delta *= 1 - value * value
        return delta


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


Precision = Literal["float64", "float32"]


def arrays_on(device: str, precision: Precision) -> Arrays:
    """Return arrays on `cpu` (numpy), or on a device of torch: `cuda`, `cuda:1`, `torch-cpu`.

    Raises:
        SpecError: torch is missing, or has no such device.
    """
    if device == "cpu":
        return NumpyArrays(precision)
    try:
        import torch
    except ImportError as error:
        raise SpecError(
            f"device {device!r} needs torch, which is not installed",
            hint='pip install "hil[learn]", or use device: cpu',
        ) from error
    return TorchArrays(torch, device.removeprefix("torch-"), precision)


class Arrays(Protocol):
    """Where networks are computed and with how many digits."""

    def asarray(self, values: FloatArray) -> Array:
        """To the device and the precision."""

    def inputs(self, X: FloatArray) -> Array:
        """(N, d) or (B, N, d) as (1 or B, d + 1, N) with a row of ones."""
        batch = X[None] if X.ndim == 2 else X
        networks, rows, inputs = batch.shape
        out = np.ones((networks, inputs + 1, rows))
        out[:, :-1] = batch.swapaxes(-1, -2)
        return self.asarray(out)

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


class NumpyArrays(Arrays):
    """On the CPU, through BLAS and LAPACK."""

    def __init__(self, precision: Precision) -> None:
        self._dtype: Any = np.dtype(precision)
        self._syrk: Any = blas.ssyrk if precision == "float32" else blas.dsyrk

    def asarray(self, values: FloatArray) -> Array:
        """To the precision."""
        return np.ascontiguousarray(values, dtype=self._dtype)

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


class TorchArrays(Arrays):
    """On a device of torch, all networks in one call.

    Args:
        torch: The module, which only a GPU needs and which takes seconds to import.
        device: As torch names it.
        precision: Of all but the solution of equations.

    Raises:
        SpecError: torch has no such device here.
    """

    def __init__(self, torch: Any, device: str, precision: Precision) -> None:
        self._torch = torch
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
        return self._torch.as_tensor(values, dtype=self._dtype, device=self._device).contiguous()

    def to_numpy(self, values: Array) -> FloatArray:
        """Back to float64 on the CPU."""
        return np.asarray(values.double().cpu().numpy())

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Memory with anything in it."""
        return self._torch.empty(shape, dtype=self._dtype, device=self._device)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Zeros."""
        return self._torch.zeros(shape, dtype=self._dtype, device=self._device)

    def ones_like(self, values: Array) -> Array:
        """Ones of the same shape."""
        return self._torch.ones_like(values)

    def concatenate(self, parts: list[Array]) -> Array:
        """Along the second axis."""
        return self._torch.cat(parts, dim=1)

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """a·b into `out`."""
        self._torch.mul(a, b, out=out)

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """(B, u, N) through its activation, and a row of ones below."""
        value = self._torch.tanh(total) if tanh else total
        return self._torch.cat([value, self._torch.ones_like(value[:, :1])], dim=1)

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ, the whole of it."""
        total.baddbmm_(J, J.mT)

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """(matrix + shift·1)⁻¹ target by Cholesky, all networks at once."""
        shifted = matrix.double().clone()
        added = self._torch.as_tensor(shift, dtype=self._torch.float64, device=self._device)
        shifted.diagonal(dim1=-2, dim2=-1).add_(added[:, None])
        factor, info = self._torch.linalg.cholesky_ex(shifted)
        solution = self._torch.cholesky_solve(target.double()[..., None], factor)[..., 0]
        definite: BoolArray = (info == 0).cpu().numpy()
        return solution.to(self._dtype), definite

    def mean_diagonal(self, matrix: Array) -> FloatArray:
        """(B,) trace over size."""
        return self.to_numpy(matrix.diagonal(dim1=-2, dim2=-1).double().mean(-1))
