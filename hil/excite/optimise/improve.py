"""One start, improved: sequential quadratic programming on few of the many rows of limits.

Linear limits are kept by every iterate. A step's program holds those rows that are nearly reached;
rows it would overstep join it, and it is solved again. Other limits are elastic rows with one
common excess, penalised, and a line search looks at objective plus penalty (Nocedal and Wright
2006, ch. 18). The objective grows sharper from stage to stage (`log_condition`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hil.excite.optimise.linear_limits import LinearLimits, peaks
from hil.excite.optimise.motion_limits import MotionLimits
from hil.excite.optimise.quadratic import Step, damped_update, solve_step
from hil.excite.optimise.value import Value, ValueOf
from hil.typing import FloatArray, IntArray

NEAR = 0.1
"""Share of a limit below which a row is handed to the solver from the first."""

NEAR_EXCESS = -0.5
"""The same for the other limits, in their scale."""

MOST_ELASTIC = 200
"""Rows of the other limits in one program: the worst ones."""

PROGRAMS = 10
"""Solved for one step at most."""

ARMIJO = 1e-4
SHORTEST = 1e-3

SMALL = 2e-4
PATIENCE = 3
"""A stage ends after so many steps in a row that each better the logarithm by less than `SMALL`."""

ALLOWED = 1e-6
"""Excess that counts as none; what is beyond is caught on the denser grid."""

FIRST_PENALTY = 10.0
"""Of an excess of 1; doubled where it is too little to bring the excess to nothing."""

MOST_EXCESS = 0.1
"""No step leads to more than this, or to more than there was: bodies deep in each other have no
slope that leads out again."""

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


@dataclass
class Search:
    """One start.

    Attributes:
        linear, others: The limits.
        value_of: The objective.
        free: (n, f) where it is, within the linear limits.
        told: Called after every step.
        deadline: CPU time at which to end [s].
        best: Best point within all limits so far, None before the first one.
        best_value: The objective there; infinite before.
        violation: Largest excess where it is.
        iterations: Steps so far.
        ended: Why the last stage ended.
    """

    linear: LinearLimits
    others: MotionLimits
    value_of: ValueOf
    free: FloatArray
    told: Callable[[Search], None] = lambda _: None
    deadline: float = np.inf
    best: FloatArray | None = None
    best_value: float = np.inf
    violation: float = np.inf
    iterations: int = 0
    ended: str = "iterations"
    _penalty: float = FIRST_PENALTY
    _hessian: FloatArray = field(init=False)
    _scale: FloatArray = field(init=False)
    _work: IntArray = field(init=False)

    def __post_init__(self) -> None:
        self._scale = self.linear.unit()
        self._hessian = np.eye(self.free.size)
        self._work = np.empty(0, dtype=np.int64)

    def forget(self) -> None:
        """The limits have changed: what was best may not be allowed any more."""
        self.best, self.best_value = None, np.inf

    def run(self, sharpness: float, iterations: int) -> None:
        """One stage."""
        point = self._at(self.free, sharpness)
        slow = 0
        for _ in range(iterations):
            if time.process_time() > self.deadline:
                self.ended = "budget"
                return
            following = self._next(point, sharpness)
            if following is None:
                break
            gain = point.merit(self._penalty) - following.merit(self._penalty)
            point, slow = following, slow + 1 if gain < SMALL else 0
            self.iterations += 1
            self.told(self)
            if slow >= PATIENCE:
                break
        else:
            self.ended = "iterations"
            return
        self.ended = "converged"

    def _at(self, free: FloatArray, sharpness: float) -> Point:
        return Point(free, self.value_of(free, sharpness), self.others.excess(free))

    def _next(self, point: Point, sharpness: float) -> Point | None:
        """The next point, or None where no step betters the merit."""
        numbers = self._near(point.excess)
        rows = self.others.rows(point.free, numbers) * self._scale
        step = self._step(point, numbers, rows)
        if step is None:
            return None
        following = self._search_along(step, point, sharpness)
        if following is None:
            return None
        self._learn(step, point, following, numbers, rows)
        self.free, self.violation = following.free, following.violation
        if following.violation <= ALLOWED and following.value.exact < self.best_value:
            self.best, self.best_value = following.free, following.value.exact
        return following

    def _near(self, excess: FloatArray) -> IntArray:
        """Rows of the other limits that a step may come to."""
        numbers = np.flatnonzero(excess > NEAR_EXCESS)
        worst = np.argsort(-excess.ravel()[numbers], kind="stable")[:MOST_ELASTIC]
        return numbers[worst]

    def _step(self, point: Point, numbers: IntArray, rows: FloatArray) -> Step | None:
        """The step that all linear limits allow."""
        slack = self.linear.slack(point.free)
        elastic = rows, -point.excess.ravel()[numbers]
        work = np.union1d(self._work, peaks(slack, NEAR))
        for _ in range(PROGRAMS):
            hard = self.linear.rows(work) * self._scale, slack.ravel()[work]
            gradient = point.value.gradient * self._scale
            step = solve_step(self._hessian, gradient, hard, elastic, self._penalty)
            if step is None:
                return None
            self._work = work[step.hard > ACTIVE]
            left = slack - self.linear.change(self._move(step))
            overstepped = np.setdiff1d(peaks(left, -ALLOWED), work)
            if not len(overstepped):
                break
            work = np.union1d(work, overstepped)
        pull = float(step.elastic.sum())
        if pull > 0.5 * self._penalty and step.excess < ALLOWED:
            self._penalty = 2.0 * pull
        return step

    def _search_along(self, step: Step, point: Point, sharpness: float) -> Point | None:
        """As far along the step as the merit becomes better and no linear limit is overstepped."""
        move = self._move(step)
        share = self._allowed_share(point.free, move)
        slope = float(point.value.gradient @ move.ravel())
        slope -= self._penalty * (point.violation - step.excess)
        if slope > -1e-9:
            return None
        now = point.merit(self._penalty)
        while share > SHORTEST:
            trial = self._at(point.free + share * move, sharpness)
            change = trial.merit(self._penalty) - now
            worse = trial.violation > max(MOST_EXCESS, point.violation)
            if change <= ARMIJO * share * slope and not worse:
                return trial
            # The least point of the parabola through both values and the slope.
            lowest = -0.5 * slope * share / (change - slope * share)
            share *= 0.5 if worse else float(np.clip(lowest, 0.1, 0.5))
        return None

    def _allowed_share(self, free: FloatArray, move: FloatArray) -> float:
        slack, change = self.linear.slack(free), self.linear.change(move)
        least = np.min(np.where(change > ALLOWED, slack / np.maximum(change, ALLOWED), 1.0))
        return float(np.clip(least, 0.0, 1.0))

    def _learn(
        self, step: Step, point: Point, following: Point, numbers: IntArray, rows: FloatArray
    ) -> None:
        """Curvature of objective and elastic rows along the way taken."""
        active = step.elastic > ACTIVE
        way = (following.free - point.free).ravel() / self._scale
        turned = (following.value.gradient - point.value.gradient) * self._scale
        if np.any(active):
            after = self.others.rows(following.free, numbers[active]) * self._scale
            turned = turned + step.elastic[active] @ (after - rows[active])
        self._hessian = damped_update(self._hessian, way, turned)

    def _move(self, step: Step) -> FloatArray:
        return (step.move * self._scale).reshape(self.free.shape)
