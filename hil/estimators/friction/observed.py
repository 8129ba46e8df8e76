"""Observations of a robot, compressed per fold and joint, with all columns of the library.

A fold is one or more whole trajectories. For every fold and joint the rows [F Y τ] (friction
columns, base regressor, target) are kept as the Gram matrix of their QR factor, so that fitting
any choice of columns to any choice of folds, and judging it on the others, costs no more rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray, IntArray
from hil.data import Dataset
from hil.estimators.least_squares import upper_triangle

MOST_FOLDS = 6
BLOCKS = 5
"""Parts that a single trajectory is cut into: nothing better is at hand."""

Block = tuple[int, FloatArray, FloatArray, FloatArray]
"""Fold, friction columns (N, n, m), base regressor (N, n, b) and target (N, n)."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What a fit needs to know of the data.

    Attributes:
        triangles: Per fold, (n, m + b + 1, m + b + 1) with RᵀR the Gram matrix of [F Y τ].
        rows: (folds,) rows per joint.
        slices: Columns of each group among the m friction columns.
        base: Number of base parameters b.
    """

    triangles: tuple[FloatArray, ...]
    rows: IntArray
    slices: dict[str, slice]
    base: int

    @property
    def joints(self) -> int:
        """Number of joints n."""
        return int(self.triangles[0].shape[0])

    @property
    def columns(self) -> int:
        """Number of friction columns m."""
        return int(self.triangles[0].shape[1]) - self.base - 1

    def indices(self, chosen: Sequence[str]) -> IntArray:
        """Positions of the columns of some groups, in the order given."""
        parts = [np.arange(self.slices[name].start, self.slices[name].stop) for name in chosen]
        return np.concatenate(parts).astype(np.int64) if parts else np.empty(0, dtype=np.int64)

    def pooled(self, joint: int, columns: IntArray) -> FloatArray:
        """(k + b + 1,)² triangle of a joint's rows of all folds with these friction columns."""
        kept = np.concatenate([columns, np.arange(self.columns, self.columns + self.base + 1)])
        return upper_triangle(np.vstack([fold[joint][:, kept] for fold in self.triangles]))


def observe(blocks: Iterator[Block], slices: dict[str, slice], base: int) -> Observed:
    """Compress blocks of rows; blocks of one fold may come in any order."""
    found: dict[int, list[FloatArray]] = {}
    rows: dict[int, int] = {}
    for fold, F, Y, target in blocks:
        joined = np.concatenate([F, Y, target[:, :, None]], axis=2)
        for j in range(joined.shape[1]):
            seen = found.setdefault(fold, [])
            if j == len(seen):
                seen.append(_square(joined[:, j]))
            else:
                seen[j] = _square(np.vstack([seen[j], joined[:, j]]))
        rows[fold] = rows.get(fold, 0) + len(target)
    order = sorted(found)
    triangles = tuple(np.stack(found[fold]) for fold in order)
    return Observed(triangles, np.array([rows[fold] for fold in order]), slices, base)


def folds_of(dataset: Dataset) -> tuple[IntArray, bool]:
    """(N,) fold of every row, and whether folds are whole trajectories.

    Pieces of one trajectory of one source, under whatever load, share a fold. A single trajectory
    is cut into blocks.
    """
    keys: dict[tuple[str, object], int] = {}
    row_fold = np.zeros(len(dataset), dtype=np.int64)
    for condition, rows in dataset.slices():
        name = condition.trajectory if condition.trajectory >= 0 else condition.id
        row_fold[rows] = keys.setdefault((condition.source, name), len(keys))
    if len(keys) > 1:
        return row_fold % MOST_FOLDS, True
    return np.arange(len(dataset)) * BLOCKS // max(len(dataset), 1), False


def _square(rows: FloatArray) -> FloatArray:
    """The triangle of some rows, filled up with zeros to a square."""
    R = upper_triangle(rows)
    missing = R.shape[1] - R.shape[0]
    return np.vstack([R, np.zeros((missing, R.shape[1]))]) if missing > 0 else R
