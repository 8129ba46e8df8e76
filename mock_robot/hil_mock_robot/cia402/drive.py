"""One axis: controlword and set-points in, demands on its motor and what it measures out.

A drive lives on its registers (`contracts.Registers`) and has no bus. The loop's order within one
SYNC is: RPDOs into the registers and TPDOs out of them (the node), then `Drive.advance` of all
drives, one `Body.advance`, then `Drive.measured` of all drives.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import SCALING, Axis, Joint, joints_of
from hil_mock_robot.cia402.contracts import STEP_S, Demand, Measured, Registers
from hil_mock_robot.cia402.errors import bits_of
from hil_mock_robot.cia402.modes import CST, CYCLIC, FOLLOWING, MODE_BITS, Mode, mode_of
from hil_mock_robot.cia402.paths import Ramp, held
from hil_mock_robot.cia402.power import PowerStage
from hil_mock_robot.cia402.readings import write_readings
from hil_mock_robot.cia402.states import (
    FAULTED,
    INTERNAL_LIMIT,
    MODE_BIT_12,
    MODE_BIT_13,
    WARNING,
    Command,
    State,
)
from hil_mock_robot.cia402.stopping import AT_REST_RAD_S, option_of
from hil_mock_robot.cia402.watch import NO_WINDOW, SYNC_LOST_STEPS, TOO_FAR, Watch

__all__ = ["Drive", "Emergency", "Joint", "joints_of"]

Emergency = Callable[[int, int], None]
"""Told an EMCY code (0: no error any more) and the bits of 1001h that belong to it."""

SYNC_LOST, HEARTBEAT_LOST, TAKEN_OFF = 0x8700, 0x8130, 0x8100
"""Codes of errors; the last one: the NMT master has taken an enabled drive out of operation."""

ABORT_FAULT = 1
ABORT_COMMANDS = {2: Command.DISABLE_VOLTAGE, 3: Command.QUICK_STOP}
"""6007h."""

RHYTHM = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX)
ENABLED = State.OPERATION_ENABLED
LEAST_SLIP_RAD = 0.2


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
        refused_modes: Modes (6060h) that 6061h does not follow though 6502h has them (injected).
        deaf: It ignores its set-points, and says so by bit 12 (injected).
    """

    def __init__(self, registers: Registers, joint: Joint, emergency: Emergency) -> None:
        self.registers, self.joint = registers, joint
        self.refused_modes: set[int] = set()
        self.deaf = False
        self._emergency = emergency
        self._axis = Axis(registers, joint)
        self._watch = Watch(self._axis)
        self._power = PowerStage(self._axis, self._begun, self._fault_reset)
        self.reset()

    @property
    def period_s(self) -> float:
        """Time from SYNC to SYNC as a client has told it (60C2h, 1006h); 0 where none has."""
        axis = self._axis
        told = axis.rhythm_told or self.registers[keys.CYCLE_PERIOD]
        return axis.period_steps * STEP_S if told else 0.0

    @property
    def state(self) -> State:
        """Of the power state machine."""
        return self._power.state

    def reset(self) -> None:
        """Switched off and on: the brake closes, faults are forgotten; NMT reset node."""
        axis = self._axis
        axis.shift = axis.slipped = 0
        axis.rhythm_told = False
        axis.rescale()
        axis.stay()
        self._shown = self.registers[keys.MODE_DISPLAY] = 0
        self._mode: Mode = mode_of(0, axis)
        self._unsynced, self._strayed = 0, False
        self._limited = self._restarts = False
        self._watch.reset()
        self._power.switch_off()
        self._tell()

    def written(self, where: int) -> None:
        """An object (`key`) was written by SDO; controlword, mode and scaling act at once."""
        if where in SCALING and not self._power.powered:
            self._axis.rescale()
        if where in RHYTHM:
            self._axis.rhythm_told = True
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
            self._mode.resume()
        wanted = self.registers[keys.MODE]
        if wanted != self._shown and self._takes(wanted):
            self._shown = self.registers[keys.MODE_DISPLAY] = wanted
            if power.state is ENABLED:
                self._mode = mode_of(wanted, self._axis)
        if power.state is ENABLED and power.stop is None:
            self._mode.listen(self.deaf)

    def advance(self, steps: int, *, synced: bool = True, missed: int = 0) -> Demand:
        """What the axis asks of its motor for the next steps of `STEP_S`.

        Args:
            steps: At least 1.
            synced: A SYNC begins them; False when the drives' own timer makes them.
            missed: How many SYNCs in a row brought no set-point, where RPDOs bring them.
        """
        self.obey()
        axis, power = self._axis, self._power
        axis.limited, axis.missed = False, missed
        self._watch_sync(steps, synced)
        if power.stop is not None:
            return self._slow_down(power.stop.ramp, steps)
        if power.state is ENABLED:
            if power.halt is not None:
                return self._slow_down(power.halt, steps)
            return self._mode.advance(steps, synced, self.deaf)
        axis.stay()
        if power.coasting > 0:
            power.coasting -= steps
            return Demand(held(axis.q, steps), 0.0, False)
        return Demand(held(axis.q, steps), math.nan, True)

    def measured(self, measured: Measured, steps: int = 0) -> None:
        """Take what was measured after those steps (0: when it is switched on) to the registers."""
        axis, power = self._axis, self._power
        axis.q, axis.qd = measured.q, measured.qd
        stopping, powered = power.stop is not None, power.powered
        if not powered or (self._shown == CST and not stopping and power.halt is None):
            axis.demand_q, axis.demand_qd = measured.q, measured.qd
        error = write_readings(axis, measured)
        self._watch.feel(measured.celsius)
        if powered:
            followed = power.state is ENABLED and self._shown in FOLLOWING and not stopping
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
        window = self.registers[keys.FOLLOWING_ERROR_WINDOW]
        if self._power.state in FAULTED:
            return
        away = round(LEAST_SLIP_RAD * abs(self._axis.counts))
        self._axis.slipped = away if window == NO_WINDOW else max(away, min(2 * window, 1 << 30))
        self._watch.too_far = True
        self.fault(TOO_FAR)

    def taken_off(self) -> None:
        """The NMT state operational is left, or a reset is to come: 6007h, where it has power."""
        if self._power.powered:
            self.connection_lost(TAKEN_OFF)

    def restart(self) -> None:
        """NMT reset node: `reset`, but a joint that is being stopped is brought to rest first."""
        stops = self._power.powered and self._power.stop is not None
        self._restarts = stops and abs(self._axis.qd) > AT_REST_RAD_S
        if not self._restarts:
            self.reset()

    def connection_lost(self, code: int = HEARTBEAT_LOST) -> None:
        """The master's heartbeat is overdue, or the bus is off: reaction by 6007h.

        The controlword that the master has left behind counts no more until it is another one.
        """
        option = option_of(self.registers, keys.ABORT_CONNECTION_OPTION)
        if option == ABORT_FAULT:
            self.fault(code)
        elif option in ABORT_COMMANDS:
            self._power.overrule(ABORT_COMMANDS[option])
            self._tell()

    def _watch_sync(self, steps: int, synced: bool) -> None:
        """An error when SYNC stays away too long, or is back after the set-point left its path.

        It would jump onto that path again; as it is, it comes to rest along a ramp.
        """
        cyclic = self._power.state is ENABLED and self._shown in CYCLIC
        self._unsynced = 0 if synced else self._unsynced + steps
        if cyclic and (self._strayed if synced else self._unsynced > SYNC_LOST_STEPS):
            self.fault(SYNC_LOST)
        if synced or not cyclic:
            self._strayed = False
        elif abs(self._axis.demand_qd) > AT_REST_RAD_S:
            self._strayed = self._strayed or self._unsynced > self._axis.period_steps

    def _takes(self, mode: int) -> bool:
        """Whether 6061h follows: the mode is built, supported by 6502h, and not refused."""
        if mode not in MODE_BITS or mode in self.refused_modes:
            return False
        return bool(self.registers[keys.SUPPORTED_MODES] >> MODE_BITS[mode] & 1)

    def _begun(self) -> None:
        self._unsynced, self._strayed = 0, False
        self._watch.reset()
        self._mode = mode_of(self._shown, self._axis)

    def _fault_reset(self) -> bool:
        """A master resets the fault; whether its cause is gone."""
        if self._watch.hot:
            return False
        self._watch.reset()
        self._axis.slipped = 0
        self._emergency(0, 0)
        return True

    def _slow_down(self, ramp: Ramp, steps: int) -> Demand:
        axis = self._axis
        rows = ramp.advance(steps)
        axis.demand_q, axis.demand_qd = ramp.q, ramp.qd
        return Demand(rows, math.nan, False, 0.0, axis.torque_limit)

    def _tell(self) -> None:
        """Write the statusword."""
        power, watch = self._power, self._watch
        word = power.word
        if power.stop is not None or power.halt is not None:
            word |= power.bits
        elif power.state is ENABLED:
            bits = self._mode.bits
            word |= bits & ~MODE_BIT_12 if self.deaf else bits
        if watch.warns:
            word |= WARNING
        if watch.too_far:
            word |= MODE_BIT_13
        if self._limited:
            word |= INTERNAL_LIMIT
        self.registers[keys.STATUSWORD] = word
