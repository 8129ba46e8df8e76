"""Mock drive, whose inputs are controlword and set-points and whose outputs are motor demands.

A drive reads and writes its registers (`keys.Registers`) and does not access the bus. At each SYNC
the calls have this order: the node writes RPDOs into the registers and sends TPDOs from them, then
`Drive.advance` of all drives, one `Body.advance`, then `Drive.measured` of all drives. `Watch`
monitors following error, speed and temperature of an enabled drive; `SyncWatch` monitors missing
SYNCs.
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
"""Callback for an EMCY code (0 if all errors are gone) and the error's bits in 1001h."""

SYNC_LOST = 0x8700
RHYTHM = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX)
ENABLED = State.OPERATION_ENABLED
TOO_HOT, TOO_FAST, TOO_FAR = 0x4310, 0x8400, 0x8611


class Drive:
    """One drive of the arm; device time is counted by the steps of `advance`.

    A drive reads the objects that the master has written. A drive writes its measurements (see
    `axis.write_readings`) and the objects 6041h and 6061h. The node of the drive, and not the drive
    itself, writes 603Fh, 1001h and 1003h.

    Args:
        registers: Live objects of the drive.
        joint: Properties of the joint, from `joints_of`.
        emergency: Callback for the occurrence of a fault and for its reset.

    Attributes:
        registers: Live objects of the drive.
        joint: Properties of the joint.
        operation: Present mode of operation.
        connection: Reaction of the drive to the loss of the master.
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
        """Time from SYNC to SYNC that a client has set (60C2h, 1006h) [s]; 0 if no time is set."""
        axis = self._axis
        is_set = axis.rhythm_set or self.registers[keys.CYCLE_PERIOD]
        return axis.period_steps * STEP_S if is_set else 0.0

    @property
    def state(self) -> State:
        """State of the power state machine."""
        return self._power.state

    def reset(self) -> None:
        """Reset the drive, as power off and on or NMT reset node does: brake closed, no faults."""
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
        self._write_statusword()

    def written(self, where: int) -> None:
        """React to an SDO write of the object `key`; controlword, mode and scaling act at once."""
        if where in SCALING and not self._power.powered:
            self._axis.rescale()
        if where in RHYTHM:
            self._axis.rhythm_set = True
        self.obey()
        self._write_statusword()

    def obey(self) -> None:
        """Apply controlword and mode, after RPDOs were received or before the next steps.

        Every received controlword is evaluated, so that a controlword that is replaced within one
        step also has an effect. The statusword shows the effect of the controlword after the next
        steps.
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
            steps: Number of steps of `STEP_S`, at least 1.
            synced: Whether a SYNC begins the steps; False if the drives' own timer begins the
                steps.
            missed: Number of consecutive SYNCs without a set-point, if RPDOs send set-points.
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
        """Write the measurements after `steps` steps to the registers; 0 steps at switching on."""
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
        self._write_statusword()

    def fault(self, code: int) -> None:
        """Start the fault reaction (605Eh) for an EMCY code, after which the drive enters fault.

        `fault` has no effect for code 0, and while a fault is present.
        """
        axis, power = self._axis, self._power
        if not code or power.state in FAULTED:
            return
        powered = power.powered
        power.enter(State.FAULT_REACTION_ACTIVE)
        self._emergency(code, bits_of(code))
        if code == TOO_FAR:  # the set-point is away from the joint
            axis.demand_q, axis.demand_qd = axis.q, axis.qd
        power.react(powered)
        self._write_statusword()

    def slip(self) -> None:
        """Inject a jump of the set-point out of the following error window (fault 8611h)."""
        if self._power.state not in FAULTED:
            self._watch.slip()
            self.fault(TOO_FAR)

    def restart(self) -> None:
        """Execute NMT reset node: call `reset`, after a joint that is being stopped is at rest."""
        stops = self._power.powered and self._power.stop is not None
        self._restarts = stops and abs(self._axis.qd) > AT_REST_RAD_S
        if not self._restarts:
            self.reset()

    def _begun(self) -> None:
        self._sync_watch.reset()
        self._watch.reset()
        self.operation.begin()

    def _fault_reset(self) -> bool:
        """Reset the fault at the request of a master; return whether its cause is gone."""
        if self._watch.hot:
            return False
        self._watch.reset()
        self._axis.slipped = 0
        self._emergency(0, 0)
        return True

    def _write_statusword(self) -> None:
        """Write the statusword."""
        power = self._power
        bits = 0
        if power.stop is None and power.halt is None and power.state is ENABLED:
            bits = self.operation.status_bits
        status = power.status_bits | self._watch.status_bits | bits
        self.registers[keys.STATUSWORD] = status | INTERNAL_LIMIT * self._limited


WARM_C, HOT_C = 80.0, 110.0

OVERSPEED = 1.3
"""Speed from which a drive enters fault, as a multiple of the joint's maximum speed."""

NO_WINDOW = 0xFFFF_FFFF
LEAST_SLIP_RAD, MOST_SLIP = 0.2, 1 << 30


class Watch:
    """Monitor of one axis for following error, speed and temperature.

    Attributes:
        too_far: Whether the following error is or was outside its window (bit 13 of the
            statusword).
        warns: Whether the motor is so warm that bit 7 of the statusword is set.
        hot: Whether the motor is so hot that the drive must enter fault.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.too_far = self.warns = self.hot = False
        self._away = 0

    @property
    def status_bits(self) -> int:
        """Bits 7 and 13 of the statusword, which show the warnings."""
        return WARNING * self.warns | MODE_BIT_13 * self.too_far

    def reset(self) -> None:
        """Clear the record of a following error."""
        self.too_far, self._away = False, 0

    def slip(self) -> None:
        """Inject a jump of the set-point out of the following error window."""
        axis = self._axis
        window, least = axis.registers[keys.FOLLOWING_ERROR_WINDOW], LEAST_SLIP_RAD * axis.counts
        far = 0 if window == NO_WINDOW else min(2 * window, MOST_SLIP)
        axis.slipped = max(round(abs(least)), far)
        self.too_far = True

    def feel(self, celsius: float) -> None:
        """Update the warnings from the motor temperature [°C], with or without power."""
        self.warns, self.hot = celsius >= WARM_C, celsius >= HOT_C

    def look(self, error: int, measured: Measured, steps: int) -> int:
        """Return the EMCY code of a powered axis; 0 if there is no fault.

        Args:
            error: Following error [increments]; 0 if the following error is not monitored.
            measured: Measurements after the last steps.
            steps: Number of steps since the last call.
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
"""Number of steps without SYNC after which a drive in a cyclic mode enters fault."""


class SyncWatch:
    """Monitor of SYNC, which counts steps without SYNC and detects set-points off their path."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.reset()

    def reset(self) -> None:
        """Clear all counts."""
        self._unsynced, self._strayed = 0, False

    def look(self, steps: int, *, synced: bool, cyclic: bool) -> bool:
        """Return whether SYNC is missing too long, or returns when the set-point is off its path.

        While SYNC is missing, the set-point comes to rest along a ramp. If SYNC returned after
        that, the set-point would jump back onto its path.

        Args:
            steps: Number of steps that begin with the call.
            synced: Whether a SYNC begins the steps.
            cyclic: Whether the axis is enabled in a mode that needs SYNC.
        """
        self._unsynced = 0 if synced else self._unsynced + steps
        error = cyclic and (self._strayed if synced else self._unsynced > SYNC_LOST_STEPS)
        if synced or not cyclic:
            self._strayed = False
        elif abs(self._axis.demand_qd) > AT_REST_RAD_S:
            self._strayed = self._strayed or self._unsynced > self._axis.period_steps
        return error
