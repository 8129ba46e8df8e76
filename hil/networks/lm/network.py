"""Multilayer perceptrons of any layout, B of them side by side, and their derivative by weight.

The weights of one network are one vector: layer by layer, and in each layer input by input the
weights to all its units, the biases last. A layer's weights are therefore a matrix (inputs + 1,
units), and a constant 1 as the last input makes the bias a weight like the others.

Arrays are kept with the samples last, (B, units, N): each row of the Jacobian is then one product
of two contiguous rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from hil.core import FloatArray, SpecError
from hil.networks.lm.arrays import Array, Arrays, numpy_arrays
from hil.networks.lm.linearised import Linearised

ACTIVATIONS = ("tanh", "linear")


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
        arrays = numpy_arrays("float64")
        return cast(FloatArray, self.forward(weights, arrays.inputs(X), arrays).output)

    def jacobian(self, weights: FloatArray, X: FloatArray) -> FloatArray:
        """Derivative (B, N, P) of the outputs by the weights (B, P) at (N, d) or (B, N, d)."""
        arrays = numpy_arrays("float64")
        passed = self.forward(weights, arrays.inputs(X), arrays)
        return cast(FloatArray, passed.linearised().jacobian().swapaxes(-1, -2))


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
