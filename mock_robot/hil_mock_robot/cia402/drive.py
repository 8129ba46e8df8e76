"""One drive: controlword and set-points in, demands on its motor and what it measures out.

A drive lives on its registers (`keys.Registers`) and has no bus. The order within one SYNC is:
RPDOs into the registers and TPDOs out of them (the node), then `Drive.advance` of all drives, one
`Body.advance`, then `Drive.measured` of all drives. `Watch` and `SyncWatch` are what an enabled
drive monitors on its own: following error, speed, temperature, and a SYNC that stays away.
"""

from __future__ import annotations

from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import SCALING, Axis, Joint, write_readings
from hil_mock_robot.cia402.body import STEP_S, Demand, Measured
from hil_mock_robot.cia402.keys import Registers
from hil_mock_robot.cia402.modes import Operation
from hil_mock_robot.cia402.node import bits_of
from hil_mock_robot.cia402.power import (
    AT_REST_RAD_S,
    FAULTED,
    INTERNAL_LIMIT,
    MODE_BIT_13,
    WARNING,
    Connection,
    PowerStage,
    State,
    slowed,
)

Emergency = Callable[[int, int], None]
"""Told an EMCY code (0: no error any more) and the bits of 1001h that belong to it."""

SYNC_LOST = 0x8700
RHYTHM = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX)
ENABLED = State.OPERATION_ENABLED
TOO_HOT, TOO_FAST, TOO_FAR = 0x4310, 0x8400, 0x8611


class Drive:
    """One axis of the arm; times are device time, counted by the steps of `advance`.

    It reads what the master writes, and writes what it measures (see `readings`), 6041h and 6061h.
    603Fh, 1001h and 1003h are the node's.

    Args:
        registers: Its live objects.
        joint: See `joints_of`.
        emergency: Called when a fault comes and when it is reset.

    Attributes:
        registers, joint: As given.
        operation: The mode in which it operates.
        connection: To its master.
    """

    def __init__(self, registers: Registers, joint: Joint, emergency: Emergency) -> None:
        self.registers, self.joint = registers, joint
        self._emergency = emergency
        self._axis = Axis(registers, joint)
        self._watch, self._sync_watch = Watch(self._axis), SyncWatch(self._axis)
        self._power = PowerStage(self._axis, self._begun, self._fault_reset)
        self.operation = Operation(self._axis)
        self.connection = Connection(registers, self._power, self.fault)
        self.reset()

    @property
    def period_s(self) -> float:
        """Time from SYNC to SYNC as a client has set it (60C2h, 1006h); 0 if none has [s]."""
        axis = self._axis
        is_set = axis.rhythm_set or self.registers[keys.CYCLE_PERIOD]
        return axis.period_steps * STEP_S if is_set else 0.0

    @property
    def state(self) -> State:
        """Of the power state machine."""
        return self._power.state

    def reset(self) -> None:
        """Switched off and on: the brake closes, faults are forgotten; NMT reset node."""
        axis = self._axis
        axis.shift = axis.slipped = 0
        axis.rhythm_set = False
        axis.rescale()
        axis.stay()
        self.operation.reset()
        self._sync_watch.reset()
        self._limited = self._restarts = False
        self._watch.reset()
        self._power.switch_off()
        self._tell()

    def written(self, where: int) -> None:
        """An object (`key`) was written by SDO; controlword, mode and scaling act at once."""
        if where in SCALING and not self._power.powered:
            self._axis.rescale()
        if where in RHYTHM:
            self._axis.rhythm_set = True
        self.obey()
        self._tell()

    def obey(self) -> None:
        """Take over controlword and mode as they stand: RPDOs have come, or steps begin.

        Each controlword is looked at, so that one that stands for less than a step counts; what
        becomes of it is in the statusword after the next steps.
        """
        power = self._power
        if self._restarts:
            return
        if power.obey():
            self.operation.resume()
        enabled = power.state is ENABLED
        self.operation.follow(enabled=enabled)
        if enabled and power.stop is None:
            self.operation.listen()

    def advance(self, steps: int, *, synced: bool = True, missed: int = 0) -> Demand:
        """Return the demand on the motor for the next steps of `STEP_S`.

        Args:
            steps: At least 1.
            synced: A SYNC begins them; False when the drives' own timer makes them.
            missed: How many SYNCs in a row brought no set-point, where RPDOs bring them.
        """
        self.obey()
        axis, power = self._axis, self._power
        axis.limited, axis.missed = False, missed
        cyclic = power.state is ENABLED and self.operation.cyclic
        if self._sync_watch.look(steps, synced=synced, cyclic=cyclic):
            self.fault(SYNC_LOST)
        if power.stop is not None:
            return slowed(axis, power.stop.ramp, steps)
        if power.state is ENABLED:
            if power.halt is not None:
                return slowed(axis, power.halt, steps)
            return self.operation.advance(steps, synced)
        axis.stay()
        return power.without(steps)

    def measured(self, measured: Measured, steps: int = 0) -> None:
        """Write measurements after those steps (0: at switching on) to the registers."""
        axis, power = self._axis, self._power
        axis.q, axis.qd = measured.q, measured.qd
        stopping, powered = power.stop is not None, power.powered
        if not powered or (self.operation.led_by_torque and not stopping and power.halt is None):
            axis.demand_q, axis.demand_qd = measured.q, measured.qd
        error = write_readings(axis, measured)
        self._watch.feel(measured.celsius)
        if powered:
            followed = power.state is ENABLED and self.operation.follows and not stopping
            if power.state not in FAULTED:
                self.fault(self._watch.look(error if followed else 0, measured, steps))
            power.look(axis.qd, steps)
            if self._restarts and not power.powered:
                self.reset()
        elif power.state is State.NOT_READY_TO_SWITCH_ON:
            power.enter(State.SWITCH_ON_DISABLED)
        self._limited = axis.limited or (measured.limited and powered)
        self._tell()

    def fault(self, code: int) -> None:
        """Something is wrong (an EMCY code): fault reaction by 605Eh, then fault.

        Without effect while there is a fault already, and for 0.
        """
        axis, power = self._axis, self._power
        if not code or power.state in FAULTED:
            return
        powered = power.powered
        power.enter(State.FAULT_REACTION_ACTIVE)
        self._emergency(code, bits_of(code))
        if code == TOO_FAR:  # the set-point is where the joint is not
            axis.demand_q, axis.demand_qd = axis.q, axis.qd
        power.react(powered)
        self._tell()

    def slip(self) -> None:
        """Its set-point jumps out of the window around the joint (injected): 8611h."""
        if self._power.state not in FAULTED:
            self._watch.slip()
            self.fault(TOO_FAR)

    def restart(self) -> None:
        """NMT reset node: `reset`, but a joint that is being stopped is brought to rest first."""
        stops = self._power.powered and self._power.stop is not None
        self._restarts = stops and abs(self._axis.qd) > AT_REST_RAD_S
        if not self._restarts:
            self.reset()

    def _begun(self) -> None:
        self._sync_watch.reset()
        self._watch.reset()
        self.operation.begin()

    def _fault_reset(self) -> bool:
        """A master resets the fault; whether its cause is gone."""
        if self._watch.hot:
            return False
        self._watch.reset()
        self._axis.slipped = 0
        self._emergency(0, 0)
        return True

    def _tell(self) -> None:
        """Write the statusword."""
        power = self._power
        bits = 0
        if power.stop is None and power.halt is None and power.state is ENABLED:
            bits = self.operation.status_bits
        status = power.status_bits | self._watch.status_bits | bits
        self.registers[keys.STATUSWORD] = status | INTERNAL_LIMIT * self._limited


WARM_C, HOT_C = 80.0, 110.0

OVERSPEED = 1.3
"""Of the joint's highest speed."""

NO_WINDOW = 0xFFFF_FFFF
LEAST_SLIP_RAD, MOST_SLIP = 0.2, 1 << 30


class Watch:
    """The watch on one axis.

    Attributes:
        too_far: The following error is outside its window (bit 13), or was when it tripped.
        warns: The motor is warm (bit 7).
        hot: It is too hot.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.too_far = self.warns = self.hot = False
        self._away = 0

    @property
    def status_bits(self) -> int:
        """Bits 7 and 13 of the statusword."""
        return WARNING * self.warns | MODE_BIT_13 * self.too_far

    def reset(self) -> None:
        """Forget what was."""
        self.too_far, self._away = False, 0

    def slip(self) -> None:
        """The set-point jumps out of the window around the joint (injected)."""
        axis = self._axis
        window, least = axis.registers[keys.FOLLOWING_ERROR_WINDOW], LEAST_SLIP_RAD * axis.counts
        far = 0 if window == NO_WINDOW else min(2 * window, MOST_SLIP)
        axis.slipped = max(round(abs(least)), far)
        self.too_far = True

    def feel(self, celsius: float) -> None:
        """The motor is so warm [°C], whether it has power or not."""
        self.warns, self.hot = celsius >= WARM_C, celsius >= HOT_C

    def look(self, error: int, measured: Measured, steps: int) -> int:
        """Return the EMCY code of an axis with power, or 0.

        Args:
            error: Following error [increments]; 0 where it does not matter.
            measured: After the last steps.
            steps: How many they were.
        """
        if self.hot:
            return TOO_HOT
        if abs(measured.qd) > OVERSPEED * self._axis.joint.qd_max:
            return TOO_FAST
        return self._following(error, steps)

    def _following(self, error: int, steps: int) -> int:
        objects = self._axis.registers
        window = objects[keys.FOLLOWING_ERROR_WINDOW]
        self.too_far = abs(error) > window != NO_WINDOW
        if not self.too_far:
            self._away = 0
            return 0
        self._away += steps
        return TOO_FAR if self._away > objects[keys.FOLLOWING_ERROR_TIMEOUT] else 0


SYNC_LOST_STEPS = 100
"""Device time without SYNC that a cyclic mode survives."""


class SyncWatch:
    """Counts the steps without SYNC, and sees whether the set-point leaves its path meanwhile."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.reset()

    def reset(self) -> None:
        """Forget what was."""
        self._unsynced, self._strayed = 0, False

    def look(self, steps: int, *, synced: bool, cyclic: bool) -> bool:
        """Whether it is an error: SYNC stays away too long, or is back after the set-point left.

        It would jump onto its path again; as it is, it comes to rest along a ramp.

        Args:
            steps: That begin now.
            synced: A SYNC begins them.
            cyclic: The axis is enabled in a mode that needs SYNC.
        """
        self._unsynced = 0 if synced else self._unsynced + steps
        error = cyclic and (self._strayed if synced else self._unsynced > SYNC_LOST_STEPS)
        if synced or not cyclic:
            self._strayed = False
        elif abs(self._axis.demand_qd) > AT_REST_RAD_S:
            self._strayed = self._strayed or self._unsynced > self._axis.period_steps
        return error
