"""Modes that make their own motion, for tools without SYNC: profile position (1), homing (6)."""

from __future__ import annotations

import math

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import STEP_S, Demand
from hil_mock_robot.cia402.paths import Trapezoid, held
from hil_mock_robot.cia402.states import (
    AT_ONCE_BIT,
    MODE_BIT_12,
    MODE_BIT_13,
    NEW_SETPOINT_BIT,
    RELATIVE_BIT,
    TARGET_REACHED,
)

HERE_IS_HOME = (35, 37)
"""Homing methods (6098h) that do not move."""

MILLISECOND_STEPS = round(0.001 / STEP_S)


class ProfilePosition:
    """PP: to 607Ah along a trapezoid (6081h, 6083h, 6084h) when bit 4 of the controlword rises.

    Bit 5 drops the present target for the new one, else one target waits for the present one to
    be reached; bit 6 makes it relative to the last target. Bit 12 of the statusword acknowledges.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._path = Trapezoid(axis.demand_q, axis.demand_qd, axis.demand_q, self._limits())
        self._raw = axis.raw_position(axis.demand_q)
        self._waiting: int | None = None
        self._asked = bool(axis.registers[keys.CONTROLWORD] & NEW_SETPOINT_BIT)
        self._acknowledged = False
        self._inside = 0

    @property
    def bits(self) -> int:
        """See `Mode`: set-point acknowledge, target reached."""
        settled = self._axis.registers[keys.POSITION_WINDOW_TIME] * MILLISECOND_STEPS
        reached = self._path.done and self._waiting is None and self._inside >= settled
        return MODE_BIT_12 * self._acknowledged | TARGET_REACHED * reached

    def resume(self) -> None:
        """See `Mode`: on to the same target."""
        self._path.q, self._path.qd = self._axis.demand_q, self._axis.demand_qd

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """See `Mode`."""
        axis, path = self._axis, self._path
        self.listen(deaf)
        if path.done and self._waiting is not None:
            self._go(self._waiting)
            self._waiting = None
        path.limits = self._limits()
        rows = path.advance(steps)
        axis.demand_q, axis.demand_qd = path.q, path.qd
        self._settle(steps)
        return Demand(rows, math.nan, False, 0.0, axis.torque_limit)

    def listen(self, deaf: bool) -> None:
        """See `Mode`."""
        word = self._axis.registers[keys.CONTROLWORD]
        asked = bool(word & NEW_SETPOINT_BIT)
        if asked and not self._asked and not deaf and self._waiting is None:
            raw = self._axis.registers[keys.TARGET_POSITION]
            raw += self._raw if word & RELATIVE_BIT else 0
            self._acknowledged = True
            if self._path.done or word & AT_ONCE_BIT:
                self._go(raw)
            else:
                self._waiting = raw
        elif not asked:
            self._acknowledged = self._waiting is not None
        self._asked = asked

    def _go(self, raw: int) -> None:
        self._raw, self._inside = raw, 0
        self._path.target = self._axis.target(raw)

    def _settle(self, steps: int) -> None:
        """Count how long the joint has been in the position window (6067h)."""
        axis = self._axis
        away = abs(axis.q - self._path.target) * abs(axis.counts)
        inside = away <= axis.registers[keys.POSITION_WINDOW]
        self._inside = self._inside + steps if inside else 0

    def _limits(self) -> tuple[float, float, float]:
        """Speed, acceleration, deceleration at the joint; what is 0 is what it can do."""
        axis, objects = self._axis, self._axis.registers
        counts, joint = abs(axis.counts), self._axis.joint
        speed = min(objects[keys.PROFILE_VELOCITY], objects[keys.MAX_PROFILE_VELOCITY])
        return (
            min(speed / counts, joint.qd_max) or joint.qd_max,
            objects[keys.PROFILE_ACCELERATION] / counts or joint.qdd_max,
            objects[keys.PROFILE_DECELERATION] / counts or joint.qdd_max,
        )


class Homing:
    """HM: when bit 4 of the controlword rises, the present position becomes 607Ch.

    Only methods that do not move (35, 37); any other one ends in a homing error (bit 13).
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._asked = bool(axis.registers[keys.CONTROLWORD] & NEW_SETPOINT_BIT)
        self.bits = TARGET_REACHED

    def resume(self) -> None:
        """See `Mode`."""

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """See `Mode`."""
        self.listen(deaf)
        axis = self._axis
        axis.demand_qd = 0.0
        return Demand(held(axis.demand_q, steps), math.nan, False, 0.0, axis.torque_limit)

    def listen(self, deaf: bool) -> None:
        """See `Mode`."""
        asked = bool(self._axis.registers[keys.CONTROLWORD] & NEW_SETPOINT_BIT)
        if asked and not self._asked and not deaf:
            self._start()
        self._asked = asked

    def _start(self) -> None:
        axis, objects = self._axis, self._axis.registers
        if objects[keys.HOMING_METHOD] not in HERE_IS_HOME:
            self.bits = TARGET_REACHED | MODE_BIT_13
            return
        axis.shift += objects[keys.HOME_OFFSET] - axis.raw_position(axis.q)
        self.bits = TARGET_REACHED | MODE_BIT_12
