"""How an axis comes to rest, and what becomes of it then."""

from __future__ import annotations

import math

from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import Demand, Registers
from hil_mock_robot.cia402.paths import Ramp
from hil_mock_robot.cia402.states import State

AT_REST_RAD_S = 0.005
SETTLING_STEPS = 200
"""So long after its ramp a joint that does not come to rest is left to the brake."""


class Stop:
    """A ramp, and the state after it.

    Args:
        ramp: Along which the axis slows down.
        then: State when it rests; None where it stays (605Ah = 5 to 8).

    Attributes:
        ramp, then: As given.
        rests: It is over.
    """

    def __init__(self, ramp: Ramp, then: State | None) -> None:
        self.ramp, self.then = ramp, then
        self.rests = False
        self._waited = 0

    def over(self, qd: float, steps: int) -> bool:
        """Whether a joint that is measured at `qd` [rad/s] has come to rest."""
        if self.ramp.done and not self.rests:
            self._waited += steps
            self.rests = abs(qd) < AT_REST_RAD_S or self._waited > SETTLING_STEPS
        return self.rests


def slowed(axis: Axis, ramp: Ramp, steps: int) -> Demand:
    """What an axis asks for along a ramp; its set-point is where that leads."""
    rows = ramp.advance(steps)
    axis.demand_q, axis.demand_qd = ramp.q, ramp.qd
    return Demand(rows, math.nan, False, 0.0, axis.torque_limit)


def option_of(registers: Registers, where: int) -> int:
    """An option code; what makers have for themselves (below 0) counts as 0."""
    return max(0, registers[where])
