"""Ridge regression on compressed observations, its penalty found on trajectories left out.

Columns are scaled to length 1 before they are penalised, so that units do not matter; what must
not be pulled to 0 is left alone. With one triangle per trajectory, leaving one out costs no look at
the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray

GRID = np.concatenate([[0.0], np.geomspace(1e-9, 1e-1, 25)])
"""Penalties that are tried, as shares of a column's sum of squares."""


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """A ridge solution.

    Attributes:
        coefficients: (p,).
        alpha: Penalty of the squared coefficient of a column of length 1.
        errors: (A,) mean squares left out at every alpha of `GRID`; empty if alpha was given.
    """

    coefficients: FloatArray
    alpha: float
    errors: FloatArray


def ridge(X: FloatArray, y: FloatArray, alpha: float, penalised: BoolArray) -> FloatArray:
    """(p,) minimising ‖Xβ − y‖² + alpha Σ (lengthₖ βₖ)² over the penalised columns.

    Args:
        X: (m, p).
        y: (m,).
        alpha: At least 0.
        penalised: (p,).
    """
    length = np.linalg.norm(X, axis=0)
    length = np.where(length > 0, length, 1.0)
    pull = np.diag(np.sqrt(alpha) * penalised.astype(np.float64))
    stacked = np.vstack([X / length, pull])
    scaled = np.linalg.lstsq(stacked, np.append(y, np.zeros(len(pull))), rcond=None)[0]
    return np.asarray(scaled / length)


def left_out_ridge(parts: Sequence[tuple[FloatArray, FloatArray]], penalised: BoolArray) -> Ridge:
    """Ridge with the penalty that predicts best the trajectory that was left out.

    Args:
        parts: X (m, p) and y (m,) of every trajectory, at least two.
        penalised: (p,).
    """
    errors = np.zeros(len(GRID))
    for out, (X, y) in enumerate(parts):
        others = [part for k, part in enumerate(parts) if k != out]
        kept, target = (np.concatenate(side) for side in zip(*others, strict=True))
        for i, alpha in enumerate(GRID):
            errors[i] += np.sum((X @ ridge(kept, target, alpha, penalised) - y) ** 2)
    # Of penalties that do equally well the largest one: it is the most cautious.
    best = int(np.flatnonzero(errors <= errors.min() * (1.0 + 1e-9))[-1])
    X, y = (np.concatenate(side) for side in zip(*parts, strict=True))
    alpha = float(GRID[best])
    return Ridge(ridge(X, y, alpha, penalised), alpha, errors)
