"""Which groups of friction columns a joint gets: those that predict trajectories they never saw.

Either the best of a few nested lists (`climb`), or forward selection (`select`): in every round
each joint takes the group that lowers its error on the held-out folds most, as long as that is by a
share worth having and not the luck of one fold. The rigid body, shared by all joints, is fitted
again after every round. All of it happens on Gram matrices: a candidate is a small solve, not a
pass over the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.identify.friction.observed import Observed
from hil.typing import FloatArray, IntArray

LEAST_GAIN = 0.003
"""Share by which a group must lower the root-mean-square error on held-out trajectories."""

AS_GOOD = 0.04
"""Share by which a richer list may be worse than the best and still be taken. Two or three
trajectories left out judge lists less well than the robots before them did: on four of a UR10e,
each left out in turn with the choice made on the other three, 0.5 % cost 2 % of accuracy."""

MOST_GROUPS = 24
DEPENDENT = 1e-9
"""A column is left out of a round when the chosen ones explain all but this share of it."""

FAINT = 1e-12
"""Ridge on columns of length 1, against rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was chosen.

    Attributes:
        chosen: Groups per joint, in the order they were taken.
        error: (n,) root-mean-square error on held-out folds with them [N·m].
        start: (n,) the same with the first groups alone.
    """

    chosen: tuple[tuple[str, ...], ...]
    error: FloatArray
    start: FloatArray


def select(
    observed: Observed,
    first: Sequence[str],
    candidates: Sequence[str],
    *,
    least_gain: float = LEAST_GAIN,
) -> Selection:
    """Choose groups for every joint.

    Args:
        observed: At least two folds.
        first: Groups every joint has.
        candidates: Groups a joint may have.
        least_gain: See `LEAST_GAIN`.
    """
    folds = _Folds(observed)
    chosen = [list(first) for _ in range(observed.joints)]
    folds.errors(chosen)  # sets the weights
    start = current = folds.errors(chosen)
    open_joints = set(range(observed.joints)) if candidates else set()
    while open_joints:
        targets = folds.without_rigid(chosen)
        for j in sorted(open_joints):
            best = folds.best(j, targets, chosen[j], candidates, least_gain)
            if best is None:
                open_joints.discard(j)
            else:
                chosen[j].append(best)
                if len(chosen[j]) >= MOST_GROUPS:
                    open_joints.discard(j)
        current = folds.errors(chosen)
    total = float(np.sum(observed.rows))
    return Selection(
        tuple(map(tuple, chosen)),
        np.sqrt(current.sum(axis=1) / total),
        np.sqrt(start.sum(axis=1) / total),
    )


def climb(observed: Observed, rungs: Sequence[Sequence[str]]) -> Selection:
    """Choose one of a few nested lists of groups for every joint.

    A joint takes the richest list whose error on held-out folds is the lowest, or as good.

    Args:
        observed: At least two folds.
        rungs: Lists of groups, from the poorest to the richest.
    """
    folds = _Folds(observed)
    total = float(np.sum(observed.rows))
    tried = []
    for names in rungs:
        everywhere = [names] * observed.joints
        folds.errors(everywhere)  # sets the weights for these groups
        tried.append(np.sqrt(folds.errors(everywhere).sum(axis=1) / total))
    errors = np.array(tried)
    good = errors <= (1.0 + AS_GOOD) * errors.min(axis=0)
    richest = len(rungs) - 1 - np.argmax(good[::-1], axis=0)
    chosen = tuple(tuple(rungs[i]) for i in richest)
    last = np.sqrt(folds.errors(chosen).sum(axis=1) / total)
    return Selection(chosen, last, tried[0])


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
        self.weight = np.ones(observed.joints)
        self.deviation = np.sqrt(diagonal[:, -1])

    def errors(self, chosen: Sequence[Sequence[str]]) -> FloatArray:
        """(n, folds) sums of squares on each fold, fitted to the others; sets the weights."""
        targets = self.without_rigid(chosen)
        out = np.empty((self.observed.joints, len(self.grams)))
        for j, names in enumerate(chosen):
            s = self.observed.indices(names)
            for f, (train, test) in enumerate(targets[j]):
                w = np.append(_solved(train[np.ix_(s, s)], train[s, -1]), -1.0)
                kept = np.append(s, len(test) - 1)
                out[j, f] = w @ test[np.ix_(kept, kept)] @ w
        out = np.maximum(out, 0.0)
        floor = 1e-12 * float(np.max(self.deviation)) or 1.0
        self.weight = 1.0 / np.maximum(np.sqrt(out.sum(axis=1)), floor) ** 2
        return out

    def without_rigid(
        self, chosen: Sequence[Sequence[str]]
    ) -> list[list[tuple[FloatArray, FloatArray]]]:
        """Per joint and fold, Gram matrices of [F, τ − Yβ] of the other folds and of the fold.

        β is fitted to the other folds together with the chosen friction columns.
        """
        rigid = [self._rigid(f, chosen) for f in range(len(self.grams))]
        m = self.observed.columns
        return [
            [
                (_residual(self.train[f, j], m, rigid[f]), _residual(self.grams[f, j], m, rigid[f]))
                for f in range(len(self.grams))
            ]
            for j in range(self.observed.joints)
        ]

    def _rigid(self, fold: int, chosen: Sequence[Sequence[str]]) -> FloatArray:
        m, b = self.observed.columns, self.observed.base
        normal, right = np.zeros((b, b)), np.zeros(b)
        for j, names in enumerate(chosen):
            s, gram = self.observed.indices(names), self.train[fold, j]
            rest = gram[m:, m:] - gram[m:, s] @ _solved(gram[np.ix_(s, s)], gram[s, m:])
            normal += self.weight[j] * rest[:b, :b]
            right += self.weight[j] * rest[:b, b]
        length = np.sqrt(np.diag(normal))
        length[length == 0] = 1.0
        scaled = normal / np.outer(length, length)
        return np.asarray(np.linalg.lstsq(scaled, right / length, rcond=1e-10)[0] / length)

    def best(
        self,
        joint: int,
        targets: list[list[tuple[FloatArray, FloatArray]]],
        chosen: Sequence[str],
        candidates: Sequence[str],
        least_gain: float,
    ) -> str | None:
        """The group that lowers the joint's error on held-out folds most, None if none does."""
        open_groups = [name for name in candidates if name not in chosen]
        s = self.observed.indices(chosen)
        indices = [self.observed.indices([name]) for name in open_groups]
        before, after = _tried(targets[joint], s, indices)
        allowed = (1.0 - least_gain) ** 2 * before.sum()
        better = np.sum(after < before, axis=1) > len(before) / 2
        score = np.where(better, after.sum(axis=1), np.inf)
        if not len(score) or score.min() >= allowed:
            return None
        return open_groups[int(np.argmin(score))]


def _tried(
    folds: Sequence[tuple[FloatArray, FloatArray]], s: IntArray, groups: Sequence[IntArray]
) -> tuple[FloatArray, FloatArray]:
    """Sums of squares per fold (folds,) now, and (groups, folds) with each group added."""
    before, after = np.empty(len(folds)), np.full((len(groups), len(folds)), np.inf)
    for f, (train, test) in enumerate(folds):
        A = _solved(train[np.ix_(s, s)], train[s])
        rest = train - train[:, s] @ A
        cross = test[:, s] @ A
        judged = test - cross - cross.T + A.T @ test[np.ix_(s, s)] @ A
        before[f] = judged[-1, -1]
        for g, c in enumerate(groups):
            own = rest[np.ix_(c, c)]
            if np.min(np.diag(own)) > DEPENDENT * float(np.max(np.diag(train)[c], initial=1e-300)):
                h = _solved(own, rest[c, -1])
                change = -2.0 * h @ judged[c, -1] + h @ judged[np.ix_(c, c)] @ h
                after[g, f] = judged[-1, -1] + change
    return before, after


def _residual(gram: FloatArray, m: int, rigid: FloatArray) -> FloatArray:
    """Gram matrix of [F, τ − Yβ] from that of [F Y τ]."""
    to = np.zeros((len(gram), m + 1))
    to[:m, :m] = np.eye(m)
    to[m:, m] = np.append(-rigid, 1.0)
    out: FloatArray = to.T @ gram @ to
    return out


def _solved(gram: FloatArray, right: FloatArray) -> FloatArray:
    faint = FAINT * float(np.trace(gram)) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram + faint, right))
