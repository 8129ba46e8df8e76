"""Modes of operation; here those with a new set-point at every SYNC: CSP, CSV, CST (8 to 10)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import STEP_S, Demand
from hil_mock_robot.cia402.paths import Between, Ramp, held
from hil_mock_robot.cia402.profile_modes import Homing, ProfilePosition
from hil_mock_robot.cia402.states import MODE_BIT_12
from hil_mock_robot.cia402.stopping import slowed

PP, HM, CSP, CSV, CST = 1, 6, 8, 9, 10
CYCLIC = frozenset({CSP, CSV, CST})
"""Modes that need SYNC."""

FOLLOWING = frozenset({PP, CSP})
"""Modes in which the following error is watched."""

MODE_BITS = {PP: 0, HM: 5, CSP: 7, CSV: 8, CST: 9}
"""Of the modes that are built, their bits in 6502h."""

EXTRAPOLATED = 2
"""Targets in a row that an axis does without."""

NAN = math.nan


class Mode(Protocol):
    """What an enabled axis does in one mode; built anew when the mode or the state is entered."""

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """What it asks for during the next steps; `axis.demand_q` and `demand_qd` follow.

        Args:
            steps: Of `STEP_S`.
            synced: A SYNC begins them.
            deaf: New set-points are not taken.
        """

    def listen(self, deaf: bool) -> None:
        """A controlword has come: an edge in it may be over before the next steps begin."""

    def resume(self) -> None:
        """Go on from where the set-point is now, after a halt."""

    @property
    def bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword as this mode has them."""


class Idle(Mode):
    """No mode, or one without set-points yet: the axis is held where it is."""

    bits = 0

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.resume()

    def resume(self) -> None:
        """See `Mode`."""
        axis = self._axis
        self._ramp = Ramp(axis.demand_q, axis.demand_qd, axis.deceleration(1))

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """See `Mode`."""
        return slowed(self._axis, self._ramp, steps)


class CyclicPosition(Mode):
    """CSP: to 607Ah + 60B0h, interpolated to be there at the next SYNC; torque 60B2h is added.

    Where the RPDO that brings targets stays away, it goes on at its speed for up to two SYNCs, and
    then to rest.
    """

    bits = MODE_BIT_12

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.resume()

    def resume(self) -> None:
        """See `Mode`."""
        self._path = Between(self._axis.demand_q, self._axis.demand_qd)

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """See `Mode`."""
        axis, path, objects = self._axis, self._path, self._axis.registers
        if synced and not deaf and axis.missed == 0:
            target = objects[keys.TARGET_POSITION] + objects[keys.POSITION_OFFSET]
            path.aim(axis.target(target), axis.period_steps)
        elif synced and not deaf and axis.missed <= EXTRAPOLATED:
            path.go_on(axis.period_steps, axis.inside)
        rows = path.advance(steps, axis.joint.qdd_max)
        axis.demand_q, axis.demand_qd = path.q, path.qd
        offset = objects[keys.TORQUE_OFFSET] / axis.torque_counts
        return Demand(rows, NAN, False, offset, axis.torque_limit)


class CyclicVelocity(Mode):
    """CSV: velocity 60FFh + 60B1h, reached at the next SYNC; the position that follows is held."""

    bits = MODE_BIT_12

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.resume()

    def resume(self) -> None:
        """See `Mode`."""
        self._wanted, self._left = self._axis.demand_qd, 0

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """See `Mode`; outside the position limits it only goes back."""
        axis, objects = self._axis, self._axis.registers
        if synced:
            raw = 0 if deaf else objects[keys.TARGET_VELOCITY] + objects[keys.VELOCITY_OFFSET]
            self._wanted, self._left = self._allowed(raw / axis.speed_counts), axis.period_steps
        elif not self._left:
            self._wanted = 0.0
        rows = held(axis.demand_q, steps)
        for row in rows:
            before = axis.demand_qd
            if self._left:
                axis.demand_qd += (self._wanted - before) / self._left
                self._left -= 1
            elif not synced:
                most = axis.joint.qdd_max * STEP_S
                axis.demand_qd -= min(most, max(-most, before))
            axis.demand_q += 0.5 * (before + axis.demand_qd) * STEP_S
            row[:] = axis.demand_q, axis.demand_qd, (axis.demand_qd - before) / STEP_S
        offset = objects[keys.TORQUE_OFFSET] / axis.torque_counts
        return Demand(rows, NAN, False, offset, axis.torque_limit)

    def _allowed(self, wanted: float) -> float:
        """At most the joint's speed [rad/s], and none that leads out of the position limits."""
        axis, objects = self._axis, self._axis.registers
        low, high = objects[keys.POSITION_LIMIT_MIN], objects[keys.POSITION_LIMIT_MAX]
        raw, raw_speed = axis.raw_position(axis.demand_q), wanted * axis.counts
        out = low < high and ((raw >= high and raw_speed > 0) or (raw <= low and raw_speed < 0))
        most = axis.joint.qd_max
        allowed = 0.0 if out else min(most, max(-most, wanted))
        axis.limited = axis.limited or allowed != wanted
        return allowed


class CyclicTorque(Mode):
    """CST: torque 6071h + 60B2h, cut to 6072h; the joint goes where it leads."""

    bits = MODE_BIT_12

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.resume()

    def resume(self) -> None:
        """See `Mode`."""
        self._torque = 0.0

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """See `Mode`."""
        axis, objects = self._axis, self._axis.registers
        if synced and not deaf:
            raw = objects[keys.TARGET_TORQUE] + objects[keys.TORQUE_OFFSET]
            most = axis.torque_limit_counts
            cut = min(most, max(-most, raw))
            axis.limited = axis.limited or cut != raw
            self._torque = cut / axis.torque_counts
        axis.demand_q, axis.demand_qd = axis.q, axis.qd
        return Demand(held(axis.q, steps), self._torque, False, 0.0, axis.torque_limit)


_MODES: dict[int, Callable[[Axis], Mode]] = {
    PP: ProfilePosition,
    HM: Homing,
    CSP: CyclicPosition,
    CSV: CyclicVelocity,
    CST: CyclicTorque,
}


def mode_of(number: int, axis: Axis) -> Mode:
    """What 6061h shows, from where the axis' set-point is now."""
    return _MODES.get(number, Idle)(axis)
