"""Modes of operation, which determine how an enabled axis reacts to its set-points.

`Operation` manages the mode of one drive: the mode requested by the master (6060h) and the active
mode (6061h). CSP, CSV and CST (8 to 10) use a new set-point at every SYNC. Profile position (1) and
homing (6) generate the motion in the drive, for tools without SYNC.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis, Between, Ramp, Trapezoid, rows_at_rest
from hil_mock_robot.cia402.body import STEP_S, Demand
from hil_mock_robot.cia402.power import (
    AT_ONCE_BIT,
    MODE_BIT_12,
    MODE_BIT_13,
    NEW_SETPOINT_BIT,
    RELATIVE_BIT,
    TARGET_REACHED,
    slowed,
)

PP, HM, CSP, CSV, CST = 1, 6, 8, 9, 10

CYCLIC = frozenset({CSP, CSV, CST})
"""Modes of operation that need SYNC."""

FOLLOWING = frozenset({PP, CSP})
"""Modes of operation in which the following error is monitored."""

MODE_BITS = {PP: 0, HM: 5, CSP: 7, CSV: 8, CST: 9}
"""Bit numbers of the implemented modes in 6502h."""


class Operation:
    """Operation of an enabled axis: active mode, change of mode, and halt.

    Args:
        axis: Axis whose mode is managed.

    Attributes:
        refused: Modes (6060h) that 6061h does not follow because of an injected fault, although
            6502h contains these modes.
        deaf: Whether the drive ignores its set-points because of an injected fault, and shows this
            by bit 12 of the statusword.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.refused: set[int] = set()
        self.deaf = False
        self.reset()

    def reset(self) -> None:
        """Leave the mode."""
        self._shown = self._axis.registers[keys.MODE_DISPLAY] = 0
        self._mode: Mode = mode_of(0, self._axis)

    @property
    def cyclic(self) -> bool:
        """Whether the active mode needs SYNC."""
        return self._shown in CYCLIC

    @property
    def follows(self) -> bool:
        """Whether the following error is monitored in the active mode."""
        return self._shown in FOLLOWING

    @property
    def led_by_torque(self) -> bool:
        """Whether the active mode is CST, in which the torque determines the joint's motion."""
        return self._shown == CST

    @property
    def status_bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword while the axis is enabled."""
        return self._mode.bits & ~(MODE_BIT_12 * self.deaf)

    def begin(self) -> None:
        """Start the mode at the present set-point when the axis is enabled."""
        self._mode = mode_of(self._shown, self._axis)

    def resume(self) -> None:
        """Resume the active mode after a halt."""
        self._mode.resume()

    def listen(self) -> None:
        """Pass a new controlword to the active mode."""
        self._mode.listen(self.deaf)

    def follow(self, *, enabled: bool) -> None:
        """Activate the requested mode if possible; on an enabled axis it starts immediately."""
        wanted = self._axis.registers[keys.MODE]
        if wanted != self._shown and self._takes(wanted):
            self._shown = self._axis.registers[keys.MODE_DISPLAY] = wanted
            if enabled:
                self.begin()

    def advance(self, steps: int, synced: bool) -> Demand:
        """Return the demand of the next steps; see `Mode`."""
        return self._mode.advance(steps, synced, self.deaf)

    def _takes(self, mode: int) -> bool:
        """Return whether a mode is implemented, supported by 6502h, and not refused."""
        if mode not in MODE_BITS or mode in self.refused:
            return False
        return bool(self._axis.registers[keys.SUPPORTED_MODES] >> MODE_BITS[mode] & 1)


EXTRAPOLATED = 2
"""Number of consecutive missing targets for which an axis extrapolates its motion."""

NAN = math.nan


class Mode(Protocol):
    """Mode of an enabled axis; a new object is created when the mode or the state is entered."""

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """Return the demand of the next steps; also update `axis.demand_q` and `demand_qd`.

        Args:
            steps: Number of steps of `STEP_S`.
            synced: Whether a SYNC begins the steps.
            deaf: Whether new set-points are ignored.
        """

    def listen(self, deaf: bool) -> None:
        """Evaluate a new controlword, because an edge can end before the next steps begin."""

    def resume(self) -> None:
        """Continue from the present set-point of the axis after a halt."""

    @property
    def bits(self) -> int:
        """Bits 10, 12 and 13 of the statusword in this mode."""


class Idle(Mode):
    """Absence of a mode, or mode without set-points: the axis holds its position."""

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
    """CSP: interpolated motion to 607Ah + 60B0h until the next SYNC, with torque offset 60B2h.

    If the RPDO with targets is missing, the axis continues at its speed for up to two SYNCs, and
    then comes to rest.
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
    """CSV: velocity 60FFh + 60B1h, reached at the next SYNC; the position follows the velocity."""

    bits = MODE_BIT_12

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.resume()

    def resume(self) -> None:
        """See `Mode`."""
        self._wanted, self._left = self._axis.demand_qd, 0

    def advance(self, steps: int, synced: bool, deaf: bool) -> Demand:
        """Return the demand; outside of the position limits, the axis moves only back to them."""
        axis, objects = self._axis, self._axis.registers
        if synced:
            raw = 0 if deaf else objects[keys.TARGET_VELOCITY] + objects[keys.VELOCITY_OFFSET]
            self._wanted, self._left = self._allowed(raw / axis.speed_counts), axis.period_steps
        elif not self._left:
            self._wanted = 0.0
        rows = rows_at_rest(axis.demand_q, steps)
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
        """Return a velocity [rad/s], limited by the joint's speed and the position limits."""
        axis, objects = self._axis, self._axis.registers
        low, high = objects[keys.POSITION_LIMIT_MIN], objects[keys.POSITION_LIMIT_MAX]
        raw, raw_speed = axis.raw_position(axis.demand_q), wanted * axis.counts
        out = low < high and ((raw >= high and raw_speed > 0) or (raw <= low and raw_speed < 0))
        most = axis.joint.qd_max
        allowed = 0.0 if out else min(most, max(-most, wanted))
        axis.limited = axis.limited or allowed != wanted
        return allowed


class CyclicTorque(Mode):
    """CST: torque 6071h + 60B2h, limited to 6072h.

    In CST the torque determines the motion of the joint.
    """

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
        return Demand(rows_at_rest(axis.q, steps), self._torque, False, 0.0, axis.torque_limit)


MILLISECOND_STEPS = round(0.001 / STEP_S)


class ProfilePosition:
    """PP: trapezoidal motion (6081h, 6083h, 6084h) to 607Ah at a rising edge of controlword bit 4.

    If controlword bit 5 is set, the new target replaces the present target. If bit 5 is not set,
    the new target waits until the present target is reached. If controlword bit 6 is set, the
    target is relative to the last target. Bit 12 of the statusword acknowledges the set-point.
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
        """Statusword bits for set-point acknowledged and target reached; see `Mode`."""
        settled = self._axis.registers[keys.POSITION_WINDOW_TIME] * MILLISECOND_STEPS
        reached = self._path.done and self._waiting is None and self._inside >= settled
        return MODE_BIT_12 * self._acknowledged | TARGET_REACHED * reached

    def resume(self) -> None:
        """Continue to the present target after a halt; see `Mode`."""
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
        """Count the steps in which the joint is in the position window (6067h)."""
        axis = self._axis
        away = abs(axis.q - self._path.target) * abs(axis.counts)
        inside = away <= axis.registers[keys.POSITION_WINDOW]
        self._inside = self._inside + steps if inside else 0

    def _limits(self) -> tuple[float, float, float]:
        """Return speed, acceleration and deceleration; the joint's limit replaces the value 0."""
        axis, objects = self._axis, self._axis.registers
        counts, joint = abs(axis.counts), self._axis.joint
        speed = min(objects[keys.PROFILE_VELOCITY], objects[keys.MAX_PROFILE_VELOCITY])
        return (
            min(speed / counts, joint.qd_max) or joint.qd_max,
            objects[keys.PROFILE_ACCELERATION] / counts or joint.qdd_max,
            objects[keys.PROFILE_DECELERATION] / counts or joint.qdd_max,
        )


HERE_IS_HOME = (35, 37)
"""Homing methods (6098h) that need no motion."""


class Homing:
    """HM: at a rising edge of controlword bit 4, the present position gets the value of 607Ch.

    Only methods without motion (35, 37) are implemented; any other method ends in a homing error
    (bit 13).
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
        return Demand(rows_at_rest(axis.demand_q, steps), math.nan, False, 0.0, axis.torque_limit)

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


_MODES: dict[int, Callable[[Axis], Mode]] = {
    PP: ProfilePosition,
    HM: Homing,
    CSP: CyclicPosition,
    CSV: CyclicVelocity,
    CST: CyclicTorque,
}


def mode_of(number: int, axis: Axis) -> Mode:
    """Return a mode object for the value of 6061h, starting at the axis' present set-point."""
    return _MODES.get(number, Idle)(axis)
