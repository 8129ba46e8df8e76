"""Multilayer perceptrons of any layout, evaluated as a batch of B, and derivatives by the weights.

`Mlp` describes a layout; the weights are passed separately. The weights of one network form one
vector, ordered by layer. Within a layer, the weights from the first input to all units come first,
followed by those of the next input; the biases come last. The weights of a layer are therefore a
matrix (inputs + 1, units): a constant 1 as the last input makes the bias a weight like the others.
In all arrays the samples are the last axis, (B, units, N); each row of the Jacobian is then the
product of two contiguous rows.

`Linearised` stores the Jacobian J as factors; most operations never compute the full matrix J. The
derivative of the output by the weight from input k to unit i of a layer is a_k·δ_i: the input of
the layer times the derivative of the output by the weighted sum of the unit. The products Jᵀv and
J·u are therefore products of small matrices per layer. J·Jᵀ is Σ (aᵀa)∘(δᵀδ) over the layers (∘:
element by element). For the network of the static paper, this sum costs one seventh of multiplying
the rows of J.

`Arrays` contains the few operations that differ between numpy on the CPU and torch on a GPU.
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
"""Array of numpy or tensor of torch."""


@dataclass(frozen=True, slots=True)
class Mlp:
    """Layout of a network with one output.

    Args:
        layers: Units per layer from the inputs to the output, such as (4, 20, 20, 10, 1).
        activations: Activation of each layer after the inputs, `tanh` or `linear`; the default is
            tanh in the hidden layers and a linear output. In the static paper the first hidden
            layer is linear: (linear, tanh, tanh, linear).

    Raises:
        SpecError: The layers or activations do not describe a network with one output.
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
        """Shape (inputs + 1, units) of the weights of each layer."""
        return tuple((a + 1, b) for a, b in zip(self.layers, self.layers[1:], strict=False))

    @property
    def n_weights(self) -> int:
        """Number of weights P, biases included."""
        return sum(rows * units for rows, units in self.shapes)

    def __str__(self) -> str:
        return "-".join(str(units) for units in self.layers)

    def initial(self, seed: int, network: int = 0) -> FloatArray:
        """Return start weights (P,), drawn for standardised inputs and target.

        Start weights and biases are uniform within ±√(3 / (inputs + 1)). With inputs of variance 1
        the weighted sum of every unit then has variance 1, for which tanh is neither saturated nor
        linear.

        Args:
            seed: Seed of the training.
            network: Number of the network within the batch; every network of a batch has different
                start weights.
        """
        random = np.random.default_rng([seed, network])
        parts = [
            random.uniform(-1.0, 1.0, rows * units) * np.sqrt(3.0 / rows)
            for rows, units in self.shapes
        ]
        return np.concatenate(parts)

    def matrices(self, weights: Array) -> list[Array]:
        """Return views (B, inputs + 1, units), one per layer, of weights (B, P)."""
        found, start = [], 0
        for rows, units in self.shapes:
            stop = start + rows * units
            found.append(weights[:, start:stop].reshape(-1, rows, units))
            start = stop
        return found

    def forward(self, weights: Array, inputs: Array, arrays: Arrays) -> Pass:
        """Run the networks on a batch of inputs.

        Args:
            weights: Weights (B, P) of the networks.
            inputs: Inputs (B or 1, d + 1, N), of which the last row contains ones.
            arrays: Array backend.
        """
        matrices = self.matrices(weights)
        seen = [inputs]
        for matrix, activation in zip(matrices, self.activations, strict=True):
            total = matrix.swapaxes(-1, -2) @ seen[-1]
            seen.append(arrays.with_ones(total, tanh=activation == "tanh"))
        return Pass(self, matrices, seen, arrays)

    def predict(self, weights: FloatArray, X: FloatArray) -> FloatArray:
        """Return outputs (B, N) for weights (B, P) and inputs (N, d) or (B, N, d)."""
        arrays = NumpyArrays("float64")
        return cast("FloatArray", self.forward(weights, arrays.inputs(X), arrays).output)

    def jacobian(self, weights: FloatArray, X: FloatArray) -> FloatArray:
        """Return the derivative (B, N, P) of the outputs by the weights.

        Args:
            weights: Weights (B, P).
            X: Inputs (N, d) or (B, N, d).
        """
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
            hint="train one network per output; hil trains them together",
        )
    return tuple(layers)


def _checked_activations(activations: Any, count: int) -> tuple[str, ...]:
    if activations is None:
        return ("tanh",) * (count - 1) + ("linear",)
    given = tuple(activations) if isinstance(activations, list | tuple) else ()
    if len(given) != count or not set(given) <= set(ACTIVATIONS):
        raise SpecError(
            f"activations is {activations!r}, but must be a list of {count} entries, each tanh "
            "or linear",
            hint="one entry per layer after the inputs; the static paper uses linear, tanh, "
            "tanh, linear",
        )
    return given


class Pass:
    """Intermediate results of a forward pass, from which derivatives by the weights are computed.

    Attributes:
        output: Outputs (B, N) of the networks.
    """

    def __init__(self, mlp: Mlp, matrices: list[Array], seen: list[Array], arrays: Arrays) -> None:
        self._mlp, self._matrices, self._seen, self._arrays = mlp, matrices, seen, arrays
        self.output: Array = seen[-1][:, 0]

    def linearised(self, row_scale: Array | None = None) -> Linearised:
        """Return the linearised networks, which one backward pass computes.

        Args:
            row_scale: (N,) factor of each row; None means that rows are not scaled.
        """
        delta = self._slope(-1, self._arrays.ones_like(self._seen[-1][:, :-1]))
        if row_scale is not None:
            delta = delta * row_scale
        deltas = [delta]
        for layer in range(len(self._matrices) - 1, 0, -1):
            back = self._matrices[layer][:, :-1] @ deltas[0]
            deltas.insert(0, self._slope(layer - 1, back))
        return Linearised(self._seen[:-1], deltas, self._arrays)

    def _slope(self, layer: int, delta: Array) -> Array:
        """Multiply `delta` in place by the slope of the layer's activation: tanh′ = 1 − tanh²."""
        if self._mlp.activations[layer] == "tanh":
            value = self._seen[layer if layer < 0 else layer + 1][:, :-1]
            delta *= 1 - value * value
        return delta


CHUNK = 512
"""Number of samples whose part of the Jacobian is computed at once and fits into the CPU cache."""

BLOCK = 192
"""Number of rows of J·Jᵀ that are computed at once."""


class Linearised:
    """Networks that are linearised at their weights.

    Args:
        seen: Inputs of each layer, (B or 1, inputs + 1, N), of which the last row contains ones.
        deltas: Derivatives of the output by the weighted sums of each layer's units, (B, units, N).
        arrays: Array backend.
    """

    def __init__(self, seen: list[Array], deltas: list[Array], arrays: Arrays) -> None:
        self._seen, self._deltas, self._arrays = seen, deltas, arrays
        self.networks, _, self.rows = deltas[0].shape
        self.weights = sum(a.shape[1] * d.shape[1] for a, d in self._layers())

    def jacobian(self, rows: slice = slice(None), out: Array | None = None) -> Array:
        """Return the transposed Jacobian (B, P, rows) as a full array."""
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
        """Return Jᵀv (B, P) for v (B, N)."""
        parts = [
            (seen @ (delta * v[:, None]).swapaxes(-1, -2)).reshape(self.networks, -1)
            for seen, delta in self._layers()
        ]
        return self._arrays.concatenate(parts)

    def times(self, matrices: list[Array]) -> Array:
        """Return J·u (B, N) for a vector u that is passed as one matrix per layer."""
        return sum(
            ((matrix.swapaxes(-1, -2) @ seen) * delta).sum(1)
            for matrix, (seen, delta) in zip(matrices, self._layers(), strict=True)
        )

    def normal_matrix(self) -> Array:
        """Return JᵀJ (B, P, P); on the CPU only the lower triangle is computed."""
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
        """Return J·Jᵀ (B, N, N) in blocks on and below the diagonal; other entries are 0."""
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
    """Return the array backend for `cpu` (numpy) or a torch device: `cuda`, `cuda:1`, `torch-cpu`.

    Raises:
        SpecError: torch is not installed, or does not have the requested device.
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
    """Interface of an array backend with a device and a precision."""

    def asarray(self, values: FloatArray) -> Array:
        """Convert values to the device and precision of the backend."""

    def inputs(self, X: FloatArray) -> Array:
        """Return inputs (N, d) or (B, N, d) as (1 or B, d + 1, N) with a row of ones."""
        batch = X[None] if X.ndim == 2 else X
        networks, rows, inputs = batch.shape
        out = np.ones((networks, inputs + 1, rows))
        out[:, :-1] = batch.swapaxes(-1, -2)
        return self.asarray(out)

    def to_numpy(self, values: Array) -> FloatArray:
        """Convert values to float64 on the CPU."""

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Return an uninitialised array."""

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Return an array of zeros."""

    def ones_like(self, values: Array) -> Array:
        """Return an array of ones with the same shape."""

    def concatenate(self, parts: list[Array]) -> Array:
        """Concatenate arrays along the second axis."""

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """Write the product a·b, with broadcasting, into `out`."""

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """Apply the activation function to (B, u, N) and append a row of ones."""

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ, for J (B, P, n), to `total` (B, P, P); only the lower triangle is required."""

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """Return (matrix + shift·1)⁻¹ target, computed in float64.

        Args:
            matrix: (B, m, m) symmetric matrices, of which the lower triangle is used.
            shift: (B,) numbers that are added to the diagonals of the matrices.
            target: (B, m) right-hand sides of the equations.

        Returns:
            Solutions (B, m), and whether each shifted matrix was positive definite (B,).
        """

    def mean_diagonal(self, matrix: Array) -> FloatArray:
        """Return the mean of the diagonal (B,) of each matrix."""


class NumpyArrays(Arrays):
    """Array backend on the CPU, which uses BLAS and LAPACK."""

    def __init__(self, precision: Precision) -> None:
        self._dtype: Any = np.dtype(precision)
        self._syrk: Any = blas.ssyrk if precision == "float32" else blas.dsyrk

    def asarray(self, values: FloatArray) -> Array:
        """Convert values to the precision of the backend."""
        return np.ascontiguousarray(values, dtype=self._dtype)

    def to_numpy(self, values: Array) -> FloatArray:
        """Convert values to float64."""
        return np.asarray(values, dtype=np.float64)

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Return an uninitialised array."""
        return np.empty(shape, dtype=self._dtype)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Return an array of zeros."""
        return np.zeros(shape, dtype=self._dtype)

    def ones_like(self, values: Array) -> Array:
        """Return an array of ones with the same shape."""
        return np.ones_like(values)

    def concatenate(self, parts: list[Array]) -> Array:
        """Concatenate arrays along the second axis."""
        return np.concatenate(parts, axis=1)

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """Write the product a·b into `out`."""
        np.multiply(a, b, out=out)

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """Apply the activation function to (B, u, N) and append a row of ones."""
        networks, units, rows = total.shape
        out = self.empty((networks, units + 1, rows))
        out[:, -1] = 1
        if tanh:
            np.tanh(total, out=out[:, :-1])
        else:
            out[:, :-1] = total
        return out

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ to the lower triangles of `total`."""
        for part, matrix in zip(J, total, strict=True):
            # The transposed views are in Fortran order, so BLAS copies nothing. The upper triangle
            # of a view is the lower triangle of the matrix.
            self._syrk(1.0, part.T, beta=1.0, c=matrix.T, trans=1, lower=0, overwrite_c=1)

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """Return (matrix + shift·1)⁻¹ target by Cholesky factorisation, one network at a time."""
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
        """Return the mean of the diagonal (B,) of each matrix."""
        return np.asarray(np.einsum("bii->b", matrix) / matrix.shape[1], dtype=np.float64)


class TorchArrays(Arrays):
    """Array backend on a torch device, which computes all networks in one call.

    Args:
        torch: Module `torch`, passed as an argument because importing it takes seconds.
        device: Name of the torch device.
        precision: Precision of all values; equations are always solved in float64.

    Raises:
        SpecError: torch does not have the requested device.
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
        """Convert values to the device and precision of the backend."""
        return self._torch.as_tensor(values, dtype=self._dtype, device=self._device).contiguous()

    def to_numpy(self, values: Array) -> FloatArray:
        """Convert values to float64 on the CPU."""
        return np.asarray(values.double().cpu().numpy())

    def empty(self, shape: tuple[int, ...]) -> Array:
        """Return an uninitialised array."""
        return self._torch.empty(shape, dtype=self._dtype, device=self._device)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """Return an array of zeros."""
        return self._torch.zeros(shape, dtype=self._dtype, device=self._device)

    def ones_like(self, values: Array) -> Array:
        """Return an array of ones with the same shape."""
        return self._torch.ones_like(values)

    def concatenate(self, parts: list[Array]) -> Array:
        """Concatenate arrays along the second axis."""
        return self._torch.cat(parts, dim=1)

    def multiply(self, a: Array, b: Array, *, out: Array) -> None:
        """Write the product a·b into `out`."""
        self._torch.mul(a, b, out=out)

    def with_ones(self, total: Array, *, tanh: bool) -> Array:
        """Apply the activation function to (B, u, N) and append a row of ones."""
        value = self._torch.tanh(total) if tanh else total
        return self._torch.cat([value, self._torch.ones_like(value[:, :1])], dim=1)

    def add_gram(self, J: Array, total: Array) -> None:
        """Add J·Jᵀ to the full matrices `total`."""
        total.baddbmm_(J, J.mT)

    def solve(self, matrix: Array, shift: FloatArray, target: Array) -> tuple[Array, BoolArray]:
        """Return (matrix + shift·1)⁻¹ target by Cholesky factorisation, all networks at once."""
        shifted = matrix.double().clone()
        added = self._torch.as_tensor(shift, dtype=self._torch.float64, device=self._device)
        shifted.diagonal(dim1=-2, dim2=-1).add_(added[:, None])
        factor, info = self._torch.linalg.cholesky_ex(shifted)
        solution = self._torch.cholesky_solve(target.double()[..., None], factor)[..., 0]
        definite: BoolArray = (info == 0).cpu().numpy()
        return solution.to(self._dtype), definite

    def mean_diagonal(self, matrix: Array) -> FloatArray:
        """Return the mean of the diagonal (B,) of each matrix."""
        return self.to_numpy(matrix.diagonal(dim1=-2, dim2=-1).double().mean(-1))
