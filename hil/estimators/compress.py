"""Observation matrices of any length, kept as one small triangle per joint.

For each joint j the rows of [W τ] are reduced by QR to R_j with R_jᵀR_j = [W τ]ⱼᵀ[W τ]ⱼ. Every
least-squares solution, residual norm and per-joint weighting follows from the triangles alone, so
memory stays bounded and weighting again costs nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.core import FloatArray, IntArray


class JointwiseQR:
    """Accumulates regressor rows and targets joint by joint.

    Attributes:
        rows: (n,) rows seen per joint.
    """

    def __init__(self, n_joints: int) -> None:
        self.rows: IntArray = np.zeros(n_joints, dtype=np.int64)
        self._triangles: list[FloatArray | None] = [None] * n_joints

    def add(self, W: FloatArray, target: FloatArray) -> None:
        """Add W (N·n, p), sample-major, and the target (N, n)."""
        samples, joints = target.shape
        cube = W.reshape(samples, joints, -1)
        for j in range(joints):
            block = np.column_stack([cube[:, j], target[:, j]])
            previous = self._triangles[j]
            stacked = block if previous is None else np.vstack([previous, block])
            self._triangles[j] = _compressed(stacked)
            self.rows[j] += samples

    def add_joint(self, joint: int, rows: FloatArray, samples: int) -> None:
        """Add rows [W τ] (m, p + 1) of one joint that stand for so many samples."""
        previous = self._triangles[joint]
        self._triangles[joint] = rows if previous is None else np.vstack([previous, rows])
        self.rows[joint] += samples

    @staticmethod
    def merged(parts: Sequence[JointwiseQR]) -> JointwiseQR:
        """What one would hold that had seen the rows of all parts."""
        whole = JointwiseQR(len(parts[0].rows))
        for j in range(len(whole.rows)):
            seen = [R for part in parts if (R := part.triangle(j)) is not None]
            whole._triangles[j] = _compressed(np.vstack(seen)) if seen else None
        whole.rows = np.sum([part.rows for part in parts], axis=0)
        return whole

    def triangle(self, joint: int) -> FloatArray | None:
        """R of [W τ] of one joint; None before its first row."""
        return self._triangles[joint]

    def system(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """An equivalent small system: X (m, p), y (m,) and the joint (m,) of each row."""
        triangles = self._filled()
        joint = np.concatenate([np.full(len(R), j) for j, R in enumerate(triangles)])
        stacked = np.vstack(triangles)
        return stacked[:, :-1], stacked[:, -1], joint

    def residual_std(self, coefficients: FloatArray) -> FloatArray:
        """(n,) standard deviation per joint of target − W·coefficients (p,).

        The parameters' degrees of freedom are shared equally among the joints.
        """
        extended = np.append(coefficients, -1.0)
        squares = np.array([np.sum((R @ extended) ** 2) for R in self._filled()])
        degrees = np.maximum(self.rows - len(coefficients) / len(self.rows), 1.0)
        deviation: FloatArray = np.sqrt(squares / degrees)
        return deviation

    def _filled(self) -> list[FloatArray]:
        return [R for R in self._triangles if R is not None]


def _compressed(matrix: FloatArray) -> FloatArray:
    """R with RᵀR = matrixᵀ matrix; columns of zeros cost nothing.

    A joint feels no link before its own, so half of a base regressor's blocks are zero.
    """
    used = np.any(matrix != 0.0, axis=0)
    triangle = upper_triangle(matrix[:, used])
    R = np.zeros((len(triangle), matrix.shape[1]))
    R[:, used] = triangle
    return R


def upper_triangle(matrix: FloatArray) -> FloatArray:
    """R of the QR decomposition: RᵀR = matrixᵀ matrix."""
    # numpy's stubs know the pair (Q, R) only.
    R: Any = np.linalg.qr(matrix, mode="r")
    return np.asarray(R, dtype=np.float64)
