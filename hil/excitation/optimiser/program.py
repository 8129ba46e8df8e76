"""Steps of one start: quadratic programs on few of the many rows of limits.

A step's program holds those linear rows that are nearly reached, peaks in time only, and those that
held the last step back; rows that a step would overstep join it, and it is solved again. The other
limits are elastic rows with one common excess, penalised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hil.core import FloatArray, IntArray
from hil.excitation.optimiser.linear_limits import LinearLimits, peaks
from hil.excitation.optimiser.motion_limits import MotionLimits
from hil.excitation.optimiser.objective import Value
from hil.excitation.optimiser.quadratic import Step, damped_update, solve_step

NEAR = 0.1
"""Share of a limit below which a row is handed to the solver from the first."""

NEAR_EXCESS = -1.0
"""The same for the other limits, in their scale: peaks in time above it, and in addition"""

TOUCHING = -0.25
"""everything above this."""

MOST_ELASTIC = 200
"""Rows of the other limits in one program: the worst ones."""

SOLVED = 10
"""Programs for one step at most."""

FIRST_PENALTY = 10.0
"""Of an excess of 1; raised where it is too little to bring the excess to nothing."""

ALLOWED = 1e-6
"""Excess that counts as none; what is beyond is caught on the denser grid."""

ACTIVE = 1e-7
"""Multipliers below it are none."""


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Where a search is: coefficients (n, f), the objective there, the excess (R, N) of limits."""

    free: FloatArray
    value: Value
    excess: FloatArray

    @property
    def violation(self) -> float:
        """Largest excess, 0 for none."""
        return float(self.excess.max(initial=0.0))

    def merit(self, penalty: float) -> float:
        """Objective plus penalty."""
        return self.value.value + penalty * self.violation


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A step from a point.

    Attributes:
        move: (n, f).
        slope: Of the merit along it at its beginning.
        step: The program's solution.
        numbers: Rows of the other limits it looked at.
        rows: Their derivatives, scaled as the solver's variables.
    """

    move: FloatArray
    slope: float
    step: Step
    numbers: IntArray
    rows: FloatArray


class StepProgram:
    """What is kept from one step to the next: curvature, rows that held it back, penalty.

    Args:
        linear: Limits that every step keeps.
        others: Limits that steps approach.
    """

    def __init__(self, linear: LinearLimits, others: MotionLimits) -> None:
        self._linear, self._others = linear, others
        self._scale = linear.unit()
        self._hessian = np.eye(len(self._scale))
        self._held = np.empty(0, dtype=np.int64)
        self.penalty = FIRST_PENALTY

    def propose(self, point: Point) -> Proposal | None:
        """The next step, or None where the solver fails."""
        near = np.flatnonzero(point.excess > TOUCHING)
        numbers = np.union1d(near, peaks(-point.excess, -NEAR_EXCESS))
        worst = np.argsort(-point.excess.ravel()[numbers], kind="stable")[:MOST_ELASTIC]
        numbers = numbers[worst]
        rows = self._others.rows(point.free, numbers) * self._scale
        step = self._solve(point, (rows, -point.excess.ravel()[numbers]))
        if step is None:
            return None
        pull = float(step.elastic.sum())
        if pull > 0.5 * self.penalty and step.excess < ALLOWED:
            self.penalty = 2.0 * pull
        move = self._move(step)
        slope = float(point.value.gradient @ move.ravel())
        slope -= self.penalty * (point.violation - step.excess)
        return Proposal(move, slope, step, numbers, rows)

    def learn(self, taken: Proposal, point: Point, following: Point) -> None:
        """Curvature of the objective and of the elastic rows along the way taken."""
        multipliers = taken.step.elastic
        active = multipliers > ACTIVE
        way = (following.free - point.free).ravel() / self._scale
        turned = (following.value.gradient - point.value.gradient) * self._scale
        if np.any(active):
            after = self._others.rows(following.free, taken.numbers[active]) * self._scale
            turned = turned + multipliers[active] @ (after - taken.rows[active])
        self._hessian = damped_update(self._hessian, way, turned)

    def _solve(self, point: Point, elastic: tuple[FloatArray, FloatArray]) -> Step | None:
        slack = self._linear.slack(point.free)
        gradient = point.value.gradient * self._scale
        work = np.union1d(self._held, peaks(slack, NEAR))
        step: Step | None = None
        for _ in range(SOLVED):
            hard = self._linear.rows(work) * self._scale, slack.ravel()[work]
            step = solve_step(self._hessian, gradient, hard, elastic, self.penalty)
            if step is None:
                break
            self._held = work[step.hard > ACTIVE]
            left = slack - self._linear.change(self._move(step))
            overstepped = np.setdiff1d(peaks(left, -ALLOWED), work)
            if not len(overstepped):
                break
            work = np.union1d(work, overstepped)
        return step

    def _move(self, step: Step) -> FloatArray:
        return (step.move * self._scale).reshape(self._linear.free_shape)
