"""Observations whose friction columns bend: what does not bend is multiplied once.

For every joint the Gram matrix of [Y | C | ∂C/∂s·c | τ] is put together from YᵀY, Yᵀτ and τᵀτ,
computed once, and the products with the few columns that the shapes bend; its Cholesky factor is a
small system with the same least squares.
"""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, IntArray
from hil.estimators.diffnea.forms import Form
from hil.estimators.diffnea.motion import ArmMotion
from hil.estimators.least_squares import System

JITTER = 1e-13
"""Of a Gram matrix's diagonal: columns may coincide, such as those of shapes without effect."""


class BendingRows:
    """Rows kept in memory to evaluate friction columns over and over.

    Args:
        base: (N, n, b) base regressor.
        target: (N, n) torques [N·m].
        motion: Of all rows, for friction with memory needs them all.
        form: Friction law.
        every: Only every so manieth row is fitted; `base` and `target` have those alone.
    """

    def __init__(
        self, base: FloatArray, target: FloatArray, motion: ArmMotion, form: Form, every: int = 1
    ) -> None:
        self._form = form
        self._n, self._b = target.shape[1], base.shape[2]
        fixed = [np.column_stack([base[:, j], target[:, j]]) for j in range(self._n)]
        self._fixed = fixed
        self._fixed_gram = [block.T @ block for block in fixed]
        self._motion = [motion.joint(j).every(every) for j in range(self._n)]

    def __call__(self, values: FloatArray) -> System:
        """The system at values (b + nk + ns,): its columns are those of the values."""
        k, s = len(self._form.terms), len(self._form.shapes)
        c, shapes = np.split(values[self._b :], [self._n * k])
        c, shapes = c.reshape(self._n, k), shapes.reshape(self._n, s)
        blocks = [self._joint(j, c[j], shapes[j]) for j in range(self._n)]
        joint: IntArray = np.repeat(np.arange(self._n), [len(block) for block in blocks])
        X = np.zeros((len(joint), len(values)))
        for j, block in enumerate(blocks):
            rows = joint == j
            X[rows, : self._b] = block[:, : self._b]
            own = self._b + j * k
            X[rows, own : own + k] = block[:, self._b + 1 : self._b + 1 + k]
            bent = self._b + self._n * k + j * s
            X[rows, bent : bent + s] = block[:, self._b + 1 + k :]
        return X, np.concatenate([block[:, self._b] for block in blocks]), joint

    def deviation(self, values: FloatArray) -> FloatArray:
        """(n,) root mean square of each joint's residual at the values [N·m]."""
        X, y, joint = self(values)
        linear = self._b + self._n * len(self._form.terms)
        squares = np.bincount(joint, (y - X[:, :linear] @ values[:linear]) ** 2)
        return np.asarray(np.sqrt(squares / len(self._fixed[0])))

    def _joint(self, j: int, c: FloatArray, shape: FloatArray) -> FloatArray:
        """(m, m) triangle of [Y | τ | C | ∂C/∂s·c] of a joint."""
        C, slope = self._form.columns(self._motion[j], shape)
        bent = np.column_stack([C, np.einsum("Nks,k->Ns", slope, c)])
        across = self._fixed[j].T @ bent
        gram = np.block([[self._fixed_gram[j], across], [across.T, bent.T @ bent]])
        length = np.sqrt(np.diag(gram))
        length[length == 0] = 1.0
        scaled = gram / np.outer(length, length)
        scaled[np.diag_indices_from(scaled)] += JITTER
        upper: FloatArray = np.linalg.cholesky(scaled).T * length
        return upper
