"""Which friction a joint gets, and how firmly it is held: what predicts trajectories left out.

A few nested lists of groups (`library.rungs`) are tried with a few penalties. Every trajectory is
left out in turn, rigid body and friction are fitted to the others, and the error on it counts. All
of it happens on Gram matrices: a trial is a handful of small solves, not a pass over the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray
from hil.estimators.friction.library import CORE
from hil.estimators.friction.observed import Observed

PENALTIES = (1e-5, 1e-4, 1e-3, 1e-2)
"""Share of a column's own sum of squares that is added to it: what a column explains only here and
there is held near 0, which is what other trajectories and loads ask for."""

FREE = (CORE, "load")
"""Groups without penalty."""

AS_GOOD = 0.04
"""Share by which a richer list may be worse than the best and still be taken. Two or three
trajectories left out judge lists less well than the robots before them did: on four of a UR10e,
each left out in turn with the choice made on the other three, 0.5 % cost 2 % of accuracy."""

FAINT = 1e-12
"""Ridge on columns of length 1, against rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was chosen.

    Attributes:
        chosen: Groups per joint.
        penalty: (n,) share of a column's sum of squares that is added to it.
        error: (n,) root-mean-square error on held-out folds with them [N·m].
    """

    chosen: tuple[tuple[str, ...], ...]
    penalty: FloatArray
    error: FloatArray


def climb(
    observed: Observed, ladders: Sequence[Sequence[Sequence[str]]], *, as_good: float
) -> Selection:
    """Choose one of a few nested lists of groups, and a penalty, for every joint.

    A joint takes the richest list whose error on held-out folds is the lowest, or as good.

    Args:
        observed: At least two folds.
        ladders: Per joint its lists, from the poorest to the richest; equally many for all.
        as_good: Share by which the error may be above the lowest; see `AS_GOOD`.
    """
    folds, n, rungs = _Folds(observed), observed.joints, range(len(ladders[0]))
    errors = np.array(
        [
            [folds.judged([own[i] for own in ladders], np.full(n, p)) for p in PENALTIES]
            for i in rungs
        ]
    )
    lowest = errors.min(axis=1)
    good = lowest <= (1.0 + as_good) * lowest.min(axis=0)
    richest = len(rungs) - 1 - np.argmax(good[::-1], axis=0)
    penalty = np.array(PENALTIES)[np.argmin(errors[richest, :, np.arange(n)], axis=1)]
    chosen = tuple(tuple(own[i]) for own, i in zip(ladders, richest, strict=True))
    return Selection(chosen, penalty, folds.judged(chosen, penalty))


def penalised(observed: Observed, joint: int, chosen: Sequence[str], penalty: float) -> FloatArray:
    """(k, k + b + 1) rows [F Y τ] that stand for a joint's penalty."""
    s = observed.indices(chosen)
    length = np.sqrt(sum(np.sum(fold[joint][:, s] ** 2, axis=0) for fold in observed.triangles))
    share = np.where(_is_free(observed)[s], 0.0, penalty)
    rows = np.zeros((len(s), len(s) + observed.base + 1))
    rows[:, : len(s)] = np.diag(np.sqrt(share) * length)
    return rows


def _is_free(observed: Observed) -> FloatArray:
    """(m,) 1 for columns without penalty, else 0."""
    free = np.zeros(observed.columns)
    for name in FREE:
        if name in observed.slices:
            free[observed.slices[name]] = 1.0
    return free


class _Folds:
    """Gram matrices of the folds, columns scaled to length 1 over all of them."""

    def __init__(self, observed: Observed) -> None:
        self.observed = observed
        grams = np.stack([R.transpose(0, 2, 1) @ R for R in observed.triangles])
        diagonal = np.einsum("fjkk->jk", grams)
        length = np.sqrt(diagonal)
        length[:, observed.columns :] = 1.0  # the base parameters are shared by all joints
        length[length == 0] = 1.0
        self.grams = grams / (length[:, :, None] * length[:, None, :])
        self.train = self.grams.sum(axis=0) - self.grams
        self.held = 1.0 - _is_free(observed)
        self.weight = 1.0 / np.maximum(diagonal[:, -1], 1e-24 * float(diagonal[:, -1].max()) or 1.0)

    def judged(self, chosen: Sequence[Sequence[str]], penalty: FloatArray) -> FloatArray:
        """(n,) error on held-out folds [N·m]; joints weighted by the error of a first round."""
        squares = self._squares(chosen, penalty, self.weight)
        weight = 1.0 / np.maximum(squares, 1e-24 * float(squares.max()) or 1.0)
        squares = self._squares(chosen, penalty, weight)
        return np.sqrt(squares / float(np.sum(self.observed.rows)))

    def _squares(
        self, chosen: Sequence[Sequence[str]], penalty: FloatArray, weight: FloatArray
    ) -> FloatArray:
        """(n,) sums of squares on each fold, fitted to the others, over all folds."""
        out, m = np.zeros(self.observed.joints), self.observed.columns
        indices = [self.observed.indices(names) for names in chosen]
        for fold in range(len(self.grams)):
            solved, normal, right = [], 0.0, 0.0
            for j, s in enumerate(indices):
                gram = self.train[fold, j]
                held = np.diag(penalty[j] * self.held[s] + FAINT * max(len(s), 1))
                A = np.linalg.solve(gram[np.ix_(s, s)] + held, gram[s, m:])
                rest = gram[m:, m:] - gram[m:, s] @ A
                normal = normal + weight[j] * rest[:-1, :-1]
                right = right + weight[j] * rest[:-1, -1]
                solved.append(A)
            rigid = _scaled_solve(np.asarray(normal), np.asarray(right))
            tail = np.append(-rigid, 1.0)
            for j, (s, A) in enumerate(zip(indices, solved, strict=True)):
                w = np.concatenate([-(A @ tail), tail])
                kept = np.append(s, np.arange(m, len(self.grams[fold, j])))
                out[j] += max(float(w @ self.grams[fold, j][np.ix_(kept, kept)] @ w), 0.0)
        return out


def _scaled_solve(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Least-squares solution of normal equations, directions that are not excited left out."""
    length = np.sqrt(np.maximum(np.diag(normal), 0.0))
    length[length == 0] = 1.0
    scaled = normal / np.outer(length, length)
    return np.asarray(np.linalg.lstsq(scaled, right / length, rcond=1e-10)[0] / length)
