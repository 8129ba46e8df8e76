"""Ridge regression of many targets, its penalty chosen by holding out whole groups.

Used for what physics leaves over: with a penalty chosen so, a correction that does not carry over
to new poses is shrunk to nothing by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray

FOLDS = 5
PENALTIES = np.logspace(7, 0, 15)
"""Candidates, beside columns of variance 1. The first shrinks everything away, and is the one where
nothing can be held out."""

FARTHEST = 6.0
"""Standard deviations from the mean of training beyond which an input counts as no farther."""


@dataclass(frozen=True, slots=True, eq=False)
class GroupedRidge:
    """A fitted correction of one target.

    Attributes:
        mean, scale: (F,) of the inputs in training.
        weights: (F,) of the standardised inputs.
        leverage: (F, F) G with xᵀGx the leverage of a standardised input x.
        penalty: The one chosen.
        residual: (N,) target less what was predicted without its own group.
    """

    mean: FloatArray
    scale: FloatArray
    weights: FloatArray
    leverage: FloatArray
    penalty: float
    residual: FloatArray

    @staticmethod
    def fit(X: FloatArray, y: FloatArray, groups: IntArray) -> GroupedRidge:
        """Fit y (N,) on X (N, F) without intercept, groups (N,) kept together.

        Every candidate predicts each group from the others; the best one is then fitted to all.
        """
        mean, scale = X.mean(axis=0), X.std(axis=0)
        scale = np.where(scale > 1e-12 * np.abs(X).max(axis=0, initial=0.0), scale, np.inf)
        Z = (X - mean) / scale
        predicted = _out_of_group(Z, y, groups)
        errors = np.mean((y[:, None] - predicted) ** 2, axis=0)
        best = int(np.argmin(errors))
        values, vectors = np.linalg.eigh(Z.T @ Z)
        inverse = (vectors / (np.maximum(values, 0.0) + PENALTIES[best])) @ vectors.T
        return GroupedRidge(
            mean, scale, inverse @ (Z.T @ y), inverse, float(PENALTIES[best]),
            y - predicted[:, best],
        )  # fmt: skip

    def predict(self, X: FloatArray) -> FloatArray:
        """(N,) correction for X (N, F)."""
        correction: FloatArray = self._standardised(X) @ self.weights
        return correction

    def leverages(self, X: FloatArray) -> FloatArray:
        """(N,) how much of one observation's variance a prediction at X (N, F) inherits."""
        Z = self._standardised(X)
        found: FloatArray = np.einsum("nf,fg,ng->n", Z, self.leverage, Z)
        return found

    def _standardised(self, X: FloatArray) -> FloatArray:
        return np.clip((X - self.mean) / self.scale, -FARTHEST, FARTHEST)


def pose_folds(groups: IntArray) -> Iterator[tuple[BoolArray, BoolArray]]:
    """Which rows (N,) to fit on and which to judge on, groups (N,) kept together.

    At most `FOLDS` pairs, the same for the same groups; none with a single group.
    """
    names = np.unique(groups)
    folds = min(FOLDS, len(names))
    order = np.random.default_rng(0).permutation(len(names))
    fold_of = dict(
        zip(names[order].tolist(), (np.arange(len(names)) % folds).tolist(), strict=True)
    )
    fold = np.array([fold_of[group] for group in groups.tolist()])
    for k in range(folds if folds > 1 else 0):
        yield fold != k, fold == k


def _out_of_group(Z: FloatArray, y: FloatArray, groups: IntArray) -> FloatArray:
    """(N, candidates) predictions of each row from the folds its group is not in."""
    predicted = np.zeros((len(y), len(PENALTIES)))
    for rest, out in pose_folds(groups):
        values, vectors = np.linalg.eigh(Z[rest].T @ Z[rest])
        along = vectors.T @ (Z[rest].T @ y[rest])
        shrunk = along[:, None] / (np.maximum(values, 0.0)[:, None] + PENALTIES)
        predicted[out] = Z[out] @ (vectors @ shrunk)
    return predicted
