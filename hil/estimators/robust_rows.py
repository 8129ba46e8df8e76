"""All observations, joint by joint, for solutions that weigh single samples."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray
from hil.estimators.jointwise import System


@dataclass(slots=True, eq=False)
class RobustRows:
    """Regressor and target in memory, without the columns a joint cannot feel.

    Attributes:
        columns: Per joint (k_j,) numbers of its columns, ascending.
        blocks: Per joint (N, k_j).
        target: (N, n).
        p: Number of all columns.
    """

    columns: list[IntArray]
    blocks: list[FloatArray]
    target: FloatArray
    p: int

    @staticmethod
    def of(
        observations: Iterable[tuple[slice, FloatArray, FloatArray]], felt: BoolArray
    ) -> RobustRows:
        """Collect W (N·n, p) and targets (N, n); `felt` (n, p) says which joint feels what."""
        joints, p = felt.shape
        columns: list[IntArray] = [np.flatnonzero(own) for own in felt]
        pieces: list[list[FloatArray]] = [[] for _ in range(joints)]
        targets = []
        for _, W, target in observations:
            cube = W.reshape(len(target), joints, p)
            for j, own in enumerate(columns):
                pieces[j].append(cube[:, j, own])
            targets.append(target)
        return RobustRows(columns, [np.concatenate(x) for x in pieces], np.concatenate(targets), p)

    def residual(self, coefficients: FloatArray) -> FloatArray:
        """(N, n) target less prediction."""
        predicted = [
            block @ coefficients[own] for block, own in zip(self.blocks, self.columns, strict=True)
        ]
        return np.asarray(self.target - np.stack(predicted, axis=1))

    def replace(self, joint: int, column: int, values: FloatArray) -> None:
        """Put other values (N,) into one column of one joint."""
        self.blocks[joint][:, int(np.searchsorted(self.columns[joint], column))] = values

    def system(self, weight: FloatArray) -> System:
        """A small system with the weighted rows' Gram matrix; weights (N, n), none below 0."""
        X, y, joint = [], [], []
        for j, (block, own) in enumerate(zip(self.blocks, self.columns, strict=True)):
            root = gram_root(np.column_stack([block, self.target[:, j]]), weight[:, j])
            rows = np.zeros((len(root), self.p))
            rows[:, own] = root[:, :-1]
            X.append(rows)
            y.append(root[:, -1])
            joint.append(np.full(len(root), j))
        return np.vstack(X), np.concatenate(y), np.concatenate(joint)

    def gram(self, weight: FloatArray) -> FloatArray:
        """(p, p) XᵀWX, also for weights (N, n) below 0."""
        total = np.zeros((self.p, self.p))
        for j, (block, own) in enumerate(zip(self.blocks, self.columns, strict=True)):
            total[np.ix_(own, own)] += (block * weight[:, j, None]).T @ block
        return total


def gram_root(matrix: FloatArray, weight: FloatArray) -> FloatArray:
    """(k, k) R with RᵀR = Mᵀ diag(w) M, by the Gram matrix of scaled columns.

    A tenth of the cost of QR; half of the digits are lost, of which regressors need few.
    """
    gram = (matrix * weight[:, None]).T @ matrix
    length = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale = np.where(length > 0, length, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    root: FloatArray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * scale
    return root
