"""Limits of position, speed, acceleration and jerk: linear in the coefficients, rows on demand.

The limits are kept at all times and not just at the points of a grid: a trigonometric polynomial
of degree H on m·H points exceeds its largest absolute value there by a factor of 1/cos(π/m) at most
(Ehlich and Zeller 1964), and so much is taken off every limit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.core import FloatArray, IntArray

if TYPE_CHECKING:
    from hil.excitation.optimiser.problem import ExcitationProblem

POINTS_PER_HARMONIC = 40
"""Costs 0.3 % of every limit."""

KINDS = ("q", "qd", "qdd", "jerk")


class LinearLimits:
    """|map·free − centre| ≤ half, for every kind of limit, joint and point of a grid.

    Rows are numbered by kind, sign, joint and point, and normalised: slack 1 is the whole limit.

    Args:
        problem: Whose limits.
    """

    def __init__(self, problem: ExcitationProblem) -> None:
        grid = problem.basis.grid(POINTS_PER_HARMONIC * problem.harmonics)
        self._maps = np.stack(grid)
        self._n = problem.robot.n
        low, high = problem.limit("q_min"), problem.limit("q_max")
        bounded = np.isfinite(high - low)
        centre = np.where(bounded, 0.5 * (low + high), 0.0)
        half = [np.where(bounded, 0.5 * (high - low), np.inf)]
        half += [problem.limit(name) for name in ("qd_max", "qdd_max", "jerk_max")]
        self._centre = np.stack([centre, *np.zeros((3, self._n))])
        self._half = np.stack(half) * np.cos(np.pi / POINTS_PER_HARMONIC)
        self.shape = (len(KINDS), 2, self._n, self._maps.shape[1])
        self.free_shape = (self._n, problem.basis.free)

    def slack(self, free: FloatArray) -> FloatArray:
        """(kinds, 2, n, N) share of each limit that is left, for free coefficients (n, f)."""
        way = (np.matmul(self._maps, free.T) - self._centre[:, None]) / self._half[:, None]
        way = way.transpose(0, 2, 1)
        return np.stack([1.0 - way, 1.0 + way], axis=1)

    def change(self, step: FloatArray) -> FloatArray:
        """(kinds, 2, n, N) by how much a step (n, f) of the coefficients lessens the slack."""
        way = (np.matmul(self._maps, step.T) / self._half[:, None]).transpose(0, 2, 1)
        return np.stack([way, -way], axis=1)

    def rows(self, numbers: IntArray) -> FloatArray:
        """(len(numbers), n·f) dense rows A with A·step = `change` there."""
        kind, sign, joint, point = np.unravel_index(numbers, self.shape)
        values = self._maps[kind, point] * (1.0 - 2.0 * sign)[:, None]
        out = np.zeros((len(numbers), self._n, self._maps.shape[2]))
        out[np.arange(len(numbers)), joint] = values / self._half[kind, joint][:, None]
        return out.reshape(len(numbers), self._n * self._maps.shape[2])

    def unit(self) -> FloatArray:
        """(n·f,) size of every coefficient that alone reaches a limit; of the centre 1 rad."""
        reached = np.abs(self._maps).max(axis=1)[:, None] / self._half[:, :, None]
        out = 1.0 / np.maximum(reached.max(axis=0), 1e-12)
        out[:, 0] = 1.0
        return np.asarray(out.ravel())

    def largest_scale(self, free: FloatArray) -> FloatArray:
        """(n,) by which the motion of each joint about its centre can be multiplied."""
        moved = free.copy()
        moved[:, 0] = 0.0
        way = np.matmul(self._maps, moved.T)
        reached = np.abs(way[1:]).max(axis=1) / self._half[1:]
        # Of the range only its width counts: the centre is chosen afterwards.
        width = 0.5 * (way[0].max(axis=0) - way[0].min(axis=0)) / self._half[0]
        return np.asarray(1.0 / np.maximum(reached.max(axis=0), width))

    def centres(self, free: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Least and greatest q₀ (n,) that keep a motion in the box; ±π where there is none."""
        moved = free.copy()
        moved[:, 0] = 0.0
        q = self._maps[0] @ moved.T
        half = np.where(np.isfinite(self._half[0]), self._half[0], np.pi + np.abs(q).max(axis=0))
        low, high = self._centre[0] - half - q.min(axis=0), self._centre[0] + half - q.max(axis=0)
        return np.minimum(low, high), np.maximum(low, high)


def peaks(slack: FloatArray, below: float) -> IntArray:
    """Numbers of the rows whose slack is below a value and least among their neighbours in time."""
    before, after = np.roll(slack, 1, axis=-1), np.roll(slack, -1, axis=-1)
    return np.flatnonzero((slack < below) & (slack <= before) & (slack <= after))
