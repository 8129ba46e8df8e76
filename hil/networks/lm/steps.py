"""One Levenberg–Marquardt step for each of B networks.

The cost is the weighted mean square error (weights sum to 1, target of variance 1) plus
`weight_decay` times the sum of squared weights. With J the Jacobian, rows times √weight, and r the
residual, the step solves (JᵀJ + λ·1)·s = Jᵀr − α·θ, λ = α + damping × mean diagonal of JᵀJ.

The same step follows from the dual system of as many unknowns as rows,
s = Jᵀ(J·Jᵀ + λ·1)⁻¹(r + α/λ·J·θ) − α/λ·θ, which is less work when rows are few.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from hil.core import BoolArray, FloatArray
from hil.networks.lm.arrays import Array, Arrays
from hil.networks.lm.linearised import Linearised
from hil.networks.lm.network import Mlp

Solver = Literal["auto", "primal", "dual"]


class System(Protocol):
    """A linearised problem that can be solved for several dampings."""

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Steps (B, P) for dampings (B,), and whether each could be computed."""


class Primal:
    """Unknowns are the weights: (JᵀJ + λ·1)·s = g."""

    def __init__(
        self, at: Linearised, residual: Array, weights: Array, decay: float, arrays: Arrays
    ) -> None:
        self._matrix = at.normal_matrix()
        self._target = at.transposed_times(residual) - decay * weights
        self._size = arrays.mean_diagonal(self._matrix)
        self._decay, self._arrays = decay, arrays

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Steps (B, P)."""
        shift = self._decay + damping * self._size
        return self._arrays.solve(self._matrix, shift, self._target)


class Dual:
    """Unknowns are the rows."""

    def __init__(
        self, at: Linearised, residual: Array, weights: Array, decay: float, arrays: Arrays,
        mlp: Mlp,
    ) -> None:  # fmt: skip
        self._at, self._residual, self._weights = at, residual, weights
        self._matrix = at.kernel()
        self._size = arrays.mean_diagonal(self._matrix) * at.rows / at.weights
        self._decay, self._arrays = decay, arrays
        self._along = at.times(mlp.matrices(weights)) if decay else None

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Steps (B, P)."""
        shift = self._decay + damping * self._size
        target = self._residual
        share = self._arrays.asarray(self._decay / np.maximum(shift, np.finfo(float).tiny))[:, None]
        if self._along is not None:
            target = target + share * self._along
        dual, definite = self._arrays.solve(self._matrix, shift, target)
        step = self._at.transposed_times(dual)
        return step - share * self._weights if self._along is not None else step, definite


def dual_is_faster(mlp: Mlp, rows: int) -> bool:
    """Whether the dual system is less work: multiplications to build and to factor it."""
    factors = sum(inputs + units for inputs, units in mlp.shapes)
    # Blocks of the kernel are small products, which run at about a third of the speed of a big one.
    dual = 3 * rows**2 * factors + rows**3 / 3
    primal = rows * mlp.n_weights**2 + mlp.n_weights**3 / 3
    return dual < primal
