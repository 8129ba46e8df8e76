"""The rows a training sees: checked, weighted, and averaged where their inputs are the same.

Rows with equal inputs have equal outputs, so Σ (yₖ − f)² over such a group is its size times
(mean − f)² plus the scatter about the mean, in which the network does not occur. One row per group,
weighted by its size, therefore has the same gradient, Gauss–Newton matrix and minimum as all of
them; the constant is added again to what is reported. Inputs that differ within a group are
refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.core import FitError, FloatArray, IntArray

MOST_SPREAD = 0.05
"""Within groups an input may vary by this share of its deviation: noise, a step of a thermometer.
That moves the output by as large a share of its own at most, and the RMSE by the square of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Inputs, targets and weights.

    Attributes:
        X: (1, N, d), or (B, N, d) when every network has its own inputs.
        Y: (N, B).
        weight: (N,), sums to 1.
        scatter: (B,) weighted mean square of what averaging took away; 0 without.
        input_scatter: (1 or B, d) the same of the inputs, which should be next to nothing.
    """

    X: FloatArray
    Y: FloatArray
    weight: FloatArray
    scatter: FloatArray
    input_scatter: FloatArray

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def networks(self) -> int:
        """Number of targets B."""
        return int(self.Y.shape[1])

    def single(self, network: int) -> Rows:
        """What one of the networks sees."""
        one = slice(network, network + 1)
        own = one if len(self.X) > 1 else slice(None)
        return Rows(
            self.X[own], self.Y[:, one], self.weight, self.scatter[one], self.input_scatter[own]
        )


def checked_rows(
    X: Any, Y: Any, sample_weight: Any = None, groups: Any = None, *, what: str = "training"
) -> Rows:
    """Rows for training or validation.

    Args:
        X: (N, d), or (B, N, d).
        Y: (N,) or (N, B).
        sample_weight: (N,), all 1 when None.
        groups: (N,) labels; rows of the same label are averaged. None averages nothing.
        what: The rows' purpose, for messages.

    Raises:
        FitError: Shapes do not match, values are not finite, or there are too few rows.
    """
    X, Y = np.asarray(X, dtype=np.float64), np.asarray(Y, dtype=np.float64)
    Y = Y[:, None] if Y.ndim == 1 else Y
    X = X[None] if X.ndim == 2 else X
    _require_shapes(X, Y, what)
    _require_finite(X, "inputs", what)
    _require_finite(Y, "targets", what)
    weight = _weights(sample_weight, len(Y), what)
    scatter, of_inputs = np.zeros(Y.shape[1]), np.zeros((X.shape[0], X.shape[2]))
    if groups is not None:
        X, Y, weight, scatter, of_inputs = averaged(X, Y, weight, np.asarray(groups))
    if len(Y) < 2:
        raise FitError(
            f"{len(Y)} {what} row(s) are too few for a network",
            hint="give at least two rows that differ",
        )
    return Rows(X, Y, weight, scatter, of_inputs)


def averaged(
    X: FloatArray, Y: FloatArray, weight: FloatArray, groups: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """One row per group: means of X (B, N, d) and Y (N, B), total weight, scatter (B,) and (B, d).

    Groups keep the order of their labels. Groups of weight 0 vanish.

    Raises:
        FitError: There is not one label per row.
    """
    if groups.shape != weight.shape:
        raise FitError(f"groups has the shape {groups.shape}, but there are {len(weight)} rows")
    groups, weight_used = groups[weight > 0], weight[weight > 0]
    X, Y = X[:, weight > 0], Y[weight > 0]
    order = np.argsort(groups, kind="stable")
    labels = groups[order]
    starts = np.flatnonzero(np.concatenate(([True], labels[1:] != labels[:-1])))
    total = np.add.reduceat(weight_used[order], starts)
    count = np.diff(np.append(starts, len(labels)))
    share = weight_used[order] / np.repeat(total, count)
    X_mean = np.add.reduceat(X[:, order] * share[:, None], starts, axis=1)
    Y_mean = np.add.reduceat(Y[order] * share[:, None], starts, axis=0)
    astray = Y[order] - np.repeat(Y_mean, count, axis=0)
    X_astray = X[:, order] - np.repeat(X_mean, count, axis=1)
    of_inputs = np.einsum("n,bnd->bd", weight_used[order], X_astray**2)
    return X_mean, Y_mean, total, weight_used[order] @ astray**2, of_inputs


def require_alike(rows: Rows, input_scale: FloatArray) -> None:
    """Refuse groups whose inputs differ: their rows are not one row, nor is the error told theirs.

    Args:
        rows: For training or validation.
        input_scale: (1 or B, d) standard deviation of the training inputs between groups. It judges
            validation rows as well: those may be of one pose, where noise is all there is.

    Raises:
        FitError: An input varies within groups.
    """
    within = np.sqrt(rows.input_scatter)
    share = np.max(within / np.hypot(input_scale, within), axis=0)
    if np.any(share > MOST_SPREAD):
        worst = int(np.argmax(share))
        raise FitError(
            f"input {worst + 1} of {len(share)} varies within the groups that are to be averaged, "
            f"by {share[worst]:.0%} of all its variation, so their rows are not alike",
            hint="do not average (averaging: false, or no groups), or use an input that is the "
            "same in all rows of a group",
        )


def equal_inputs(X: FloatArray) -> IntArray:
    """(N,) label of each row of (N, d) or (B, N, d): the same for rows whose inputs are equal."""
    flat = X if X.ndim == 2 else np.concatenate(list(X), axis=1)
    _, label = np.unique(flat, axis=0, return_inverse=True)
    return np.asarray(label, dtype=np.int64).reshape(-1)


def _require_shapes(X: FloatArray, Y: FloatArray, what: str) -> None:
    if X.ndim != 3 or Y.ndim != 2 or X.shape[1] != len(Y) or X.shape[0] not in (1, Y.shape[1]):
        raise FitError(
            f"the {what} inputs {X.shape} and targets {Y.shape} do not go together",
            hint="inputs are (N, d) or (B, N, d), targets (N,) or (N, B)",
        )


def _require_finite(values: FloatArray, name: str, what: str) -> None:
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise FitError(
            f"{bad} of the {what} {name} are NaN or infinite",
            hint="leave those rows out, or find out why they were recorded so",
        )


def _weights(sample_weight: Any, rows: int, what: str) -> FloatArray:
    if sample_weight is None:
        return np.full(rows, 1.0 / max(rows, 1))
    weight = np.asarray(sample_weight, dtype=np.float64)
    if weight.shape != (rows,):
        raise FitError(f"{what} sample_weight has the shape {weight.shape}, not ({rows},)")
    if not np.all(np.isfinite(weight)) or np.any(weight < 0) or not np.any(weight):
        raise FitError(
            f"{what} sample_weight must be finite, not negative, and not zero everywhere"
        )
    return np.asarray(weight / weight.sum())
