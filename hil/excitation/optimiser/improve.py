"""One start, improved by sequential quadratic programming (Nocedal and Wright 2006, ch. 18).

Linear limits are kept by every iterate; the others are approached, and a line search looks at the
objective plus a penalty. The objective grows sharper from stage to stage (`log_condition`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hil.core import FloatArray
from hil.excitation.optimiser.linear_limits import LinearLimits
from hil.excitation.optimiser.motion_limits import TOLERATED, MotionLimits
from hil.excitation.optimiser.objective import ValueOf
from hil.excitation.optimiser.program import ALLOWED, Point, Proposal, StepProgram

ARMIJO = 1e-4
SHORTEST = 1e-3
FLAT = -1e-9

SMALL = 2e-4
PATIENCE = 3
"""A stage ends after so many steps in a row that each better the logarithm by less than `SMALL`."""

MOST_EXCESS = 0.1
"""No step leads to more than this, or to more than there was: bodies deep in each other have no
slope that leads out again."""


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
    _program: StepProgram = field(init=False)

    def __post_init__(self) -> None:
        self._program = StepProgram(self.linear, self.others)

    def forget(self) -> None:
        """The limits have changed: what was best may not be allowed any more."""
        if self.best is not None:
            self.free = self.best
        self.best, self.best_value = None, np.inf

    def run(self, sharpness: float, iterations: int) -> None:
        """One stage."""
        point: Point | None = self._at(self.free, sharpness)
        slow = 0
        self.ended = "iterations"
        for _ in range(iterations):
            if time.process_time() > self.deadline:
                self.ended = "budget"
                return
            assert point is not None
            before = point.merit(self._program.penalty)
            point = self._next(point, sharpness)
            if point is not None:
                gain = before - point.merit(self._program.penalty)
                slow = slow + 1 if gain < SMALL else 0
            if point is None or slow >= PATIENCE:
                self.ended = "converged"
                return

    def _at(self, free: FloatArray, sharpness: float) -> Point:
        """Also notes the point where it is the best one so far."""
        point = Point(free, self.value_of(free, sharpness), self.others.excess(free))
        if point.violation <= TOLERATED and point.value.exact < self.best_value:
            self.best, self.best_value = free, point.value.exact
        return point

    def _next(self, point: Point, sharpness: float) -> Point | None:
        """The next point, or None where no step betters the merit."""
        proposal = self._program.propose(point)
        if proposal is None:
            return None
        following = self._search_along(proposal, point, sharpness)
        if following is None:
            return None
        self._program.learn(proposal, point, following)
        self.free, self.violation = following.free, following.violation
        self.iterations += 1
        self.told(self)
        return following

    def _search_along(self, proposal: Proposal, point: Point, sharpness: float) -> Point | None:
        """As far along the step as the merit becomes better and no linear limit is overstepped."""
        if proposal.slope > FLAT:
            return None
        share = self._allowed_share(point.free, proposal.move)
        penalty, slope = self._program.penalty, proposal.slope
        while share > SHORTEST:
            trial = self._at(point.free + share * proposal.move, sharpness)
            change = trial.merit(penalty) - point.merit(penalty)
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
