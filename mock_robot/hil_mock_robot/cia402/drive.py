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
from hil_mock_robot.cia402.contracts import Demand, Measured, Registers
from hil_mock_robot.cia402.modes import CST, CYCLIC, FOLLOWING, MODE_BITS, Idle, Mode, mode_of
from hil_mock_robot.cia402.paths import Ramp, held
from hil_mock_robot.cia402.readings import write_readings
from hil_mock_robot.cia402.states import (
    FAULTED,
    HALT_BIT,
    INTERNAL_LIMIT,
    MODE_BIT_12,
    MODE_BIT_13,
    POWERED,
    REMOTE,
    TARGET_REACHED,
    VOLTAGE_ENABLED,
    WARNING,
    Command,
    State,
    Transition,
    command_of,
    commanded,
)
from hil_mock_robot.cia402.stopping import Stop, option_of
from hil_mock_robot.cia402.watch import SYNC_LOST_STEPS, Watch, register_bits

__all__ = ["Drive", "Emergency", "Joint", "joints_of"]

Emergency = Callable[[int, int], None]
"""Told an EMCY code (0: no error any more) and the bits of 1001h that belong to it."""

COASTING_STEPS = 50
"""How long a motor without current turns before the brake takes it."""

FOLLOWING_ERROR, SYNC_LOST, HEARTBEAT_LOST = 0x8611, 0x8700, 0x8130
ABORT_FAULT, ABORT_DISABLE, ABORT_QUICK_STOP = 1, 2, 3
"""6007h."""

ENABLED, STOPPING = State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE


class Drive:
    """One axis of the arm; times are device time, counted by the steps of `advance`.

    It reads what the master writes, and writes what it measures (see `readings`), 6041h and 6061h.
    603Fh, 1001h and 1003h are the node's.

    Args:
        registers: Its live objects.
        joint: See `axis.joints_of`.
        emergency: Called when a fault comes and when it is reset.

    Attributes:
        state: Of the power state machine.
        refused_modes: Modes (6060h) that 6061h does not follow though 6502h has them (injected).
        deaf: It ignores its set-points, and says so by bit 12 (injected).
    """

    def __init__(self, registers: Registers, joint: Joint, emergency: Emergency) -> None:
        self.registers = registers
        self.refused_modes: set[int] = set()
        self.deaf = False
        self._axis = Axis(registers, joint)
        self._emergency = emergency
        self._watch = Watch(self._axis)
        self.reset()

    @property
    def joint(self) -> Joint:
        """What it turns."""
        return self._axis.joint

    def reset(self) -> None:
        """Switched off and on: the brake closes, faults are forgotten; NMT reset node."""
        axis = self._axis
        axis.shift = 0
        axis.rescale()
        axis.stay()
        self._mode: Mode = Idle(axis)
        self._shown = 0
        self._stop: Stop | None = None
        self._halt: Ramp | None = None
        self._coasting = self._unsynced = 0
        self._word, self._overruled, self._settled = 0, -1, False
        self._bits = REMOTE | VOLTAGE_ENABLED
        self._enter(State.NOT_READY_TO_SWITCH_ON)
        self._watch.reset()
        self.registers[keys.MODE_DISPLAY] = 0
        self._tell()

    def written(self, where: int) -> None:
        """An object (`key`) was written by SDO; controlword, mode and scaling act at once.

        What RPDOs write is seen by the next `advance`.
        """
        if where == keys.CONTROLWORD:
            self._obey()
        elif where in SCALING and self.state not in POWERED:
            self._axis.rescale()
        self._follow_mode()
        self._tell()

    def advance(self, steps: int, *, synced: bool = True) -> Demand:
        """What the axis asks of its motor for the next steps of `STEP_S`.

        Args:
            steps: At least 1.
            synced: A SYNC begins them; False when the drives' own timer makes them.
        """
        self._obey()
        self._follow_mode()
        axis = self._axis
        axis.limited = False
        self._unsynced = 0 if synced else self._unsynced + steps
        if self.state is ENABLED and self._shown in CYCLIC and self._unsynced > SYNC_LOST_STEPS:
            self.fault(SYNC_LOST)
        if self._stop is not None:
            return self._slow_down(self._stop.ramp, steps)
        if self.state is ENABLED:
            if self._halt is not None:
                return self._slow_down(self._halt, steps)
            return self._mode.advance(steps, synced, self.deaf)
        axis.stay()
        if self._coasting > 0:
            self._coasting -= steps
            return Demand(held(axis.q, steps), 0.0, False)
        return Demand(held(axis.q, steps), math.nan, True)

    def measured(self, measured: Measured, steps: int = 0) -> None:
        """Take what was measured after those steps (0: when it is switched on) to the registers."""
        axis, state = self._axis, self.state
        axis.q, axis.qd = measured.q, measured.qd
        free = state is ENABLED and self._shown == CST and self._stop is None
        if free or state not in POWERED:
            axis.demand_q, axis.demand_qd = measured.q, measured.qd
        error = write_readings(axis, measured)
        if state is State.NOT_READY_TO_SWITCH_ON:
            self._enter(State.SWITCH_ON_DISABLED)
        elif state in POWERED:
            follows = state is ENABLED and self._shown in FOLLOWING and self._stop is None
            if code := self._watch.look(error if follows else 0, measured, steps):
                self.fault(code)
            if self._stop is not None and self._stop.over(axis.qd, steps):
                self._stopped(self._stop)
        self._limited = axis.limited or (measured.limited and state in POWERED)
        self._tell()

    def fault(self, code: int) -> None:
        """Something is wrong (an EMCY code): fault reaction by 605Eh, then fault.

        Without effect while there is a fault already.
        """
        if self.state in FAULTED:
            return
        powered = self.state in POWERED
        self._enter(State.FAULT_REACTION_ACTIVE)
        self._emergency(code, register_bits(code))
        option = option_of(self.registers, keys.FAULT_REACTION_OPTION)
        if powered and option:
            axis = self._axis
            if code == FOLLOWING_ERROR:  # the set-point is where the joint is not
                axis.demand_q, axis.demand_qd = axis.q, axis.qd
            self._begin_stop(option, State.FAULT)
        else:
            self._lose(State.FAULT) if powered else self._enter(State.FAULT)
        self._tell()

    def connection_lost(self, code: int = HEARTBEAT_LOST) -> None:
        """The master's heartbeat is overdue, or the bus is off: reaction by 6007h.

        The controlword that the master has left behind counts no more until it is another one.
        """
        option = option_of(self.registers, keys.ABORT_CONNECTION_OPTION)
        commands = {ABORT_DISABLE: Command.DISABLE_VOLTAGE, ABORT_QUICK_STOP: Command.QUICK_STOP}
        if option == ABORT_FAULT:
            self.fault(code)
        elif option in commands:
            self._command(commands[option])
            self._overruled = self.registers[keys.CONTROLWORD]
        self._tell()

    def _obey(self) -> None:
        """Act on the controlword as it stands."""
        word, before = self.registers[keys.CONTROLWORD], self._word
        if word == before and self._settled:
            return
        self._word, self._settled = word, True
        if word != self._overruled:
            self._overruled = -1
            self._command(command_of(word, before))
            if (word ^ before) & HALT_BIT and self.state is ENABLED:
                self._turn_halt()

    def _command(self, command: Command) -> None:
        stays = option_of(self.registers, keys.QUICK_STOP_OPTION) > 4
        found = commanded(self.state, command, stays_stopped=stays)
        if found is None:
            return
        transition, to = found
        pending = self._stop is not None and self.state is ENABLED
        if pending and transition not in _OVERRIDING:
            return
        self._settled = False
        self._make(transition, to)

    def _make(self, transition: Transition, to: State) -> None:
        """Go through a commanded transition."""
        match transition:
            case Transition.SHUTDOWN:
                self._axis.rescale()
                self._enter(to)
            case Transition.ENABLE_OPERATION:
                self._axis.stay()
                self._begin(to)
            case Transition.ENABLE_FROM_QUICK_STOP:
                self._begin(to)
            case Transition.DISABLE_OPERATION:
                self._leave(keys.DISABLE_OPTION, to)
            case Transition.SHUTDOWN_FROM_ENABLED:
                self._leave(keys.SHUTDOWN_OPTION, to)
            case Transition.QUICK_STOP:
                self._quick_stop(to)
            case Transition.DISABLE_FROM_ENABLED | Transition.QUICK_STOP_ENDED:
                self._lose(to)
            case Transition.FAULT_RESET:
                self._reset_fault(to)
            case _:
                self._enter(to)

    def _begin(self, to: State) -> None:
        self._stop, self._coasting, self._unsynced = None, 0, 0
        self._enter(to)
        self._watch.reset()
        self._start_mode()
        self._halt = None
        if self._word & HALT_BIT:
            self._turn_halt()

    def _leave(self, option_key: int, to: State) -> None:
        """By its option code: along a ramp and then, or at once without current."""
        option = option_of(self.registers, option_key)
        if option:
            self._begin_stop(option, to)
        else:
            self._lose(to)

    def _quick_stop(self, to: State) -> None:
        option = option_of(self.registers, keys.QUICK_STOP_OPTION)
        if not option:
            self._lose(State.SWITCH_ON_DISABLED)
            return
        self._enter(to)
        self._begin_stop(option, None if option > 4 else State.SWITCH_ON_DISABLED)

    def _begin_stop(self, option: int, then: State | None) -> None:
        axis = self._axis
        self._halt = None
        ramp = Ramp(axis.demand_q, axis.demand_qd, axis.deceleration(option))
        self._stop = Stop(ramp, then)

    def _stopped(self, stop: Stop) -> None:
        if stop.then is not None:
            self._stop = None
            self._enter(stop.then)

    def _lose(self, to: State) -> None:
        """Without current from now on."""
        self._stop = self._halt = None
        self._coasting = COASTING_STEPS
        self._enter(to)

    def _reset_fault(self, to: State) -> None:
        self._watch.reset()
        self._enter(to)
        self._emergency(0, 0)

    def _turn_halt(self) -> None:
        axis = self._axis
        if self._word & HALT_BIT:
            option = option_of(self.registers, keys.HALT_OPTION)
            self._halt = Ramp(axis.demand_q, axis.demand_qd, axis.deceleration(option))
        elif self._halt is not None:
            self._halt = None
            self._mode.resume()

    def _slow_down(self, ramp: Ramp, steps: int) -> Demand:
        axis = self._axis
        rows = ramp.advance(steps)
        axis.demand_q, axis.demand_qd = ramp.q, ramp.qd
        return Demand(rows, math.nan, False, 0.0, axis.torque_limit)

    def _follow_mode(self) -> None:
        """6061h follows 6060h where the mode is built, supported and not refused."""
        wanted = self.registers[keys.MODE]
        if wanted == self._shown or wanted not in MODE_BITS or wanted in self.refused_modes:
            return
        if not self.registers[keys.SUPPORTED_MODES] >> MODE_BITS[wanted] & 1:
            return
        self._shown = self.registers[keys.MODE_DISPLAY] = wanted
        if self.state is ENABLED and self._stop is None:
            self._start_mode()

    def _start_mode(self) -> None:
        self._mode = mode_of(self._shown, self._axis)

    def _enter(self, state: State) -> None:
        self.state = state
        self._base = state.value | REMOTE | VOLTAGE_ENABLED
        self._settled, self._limited = False, False

    def _tell(self) -> None:
        """Write the statusword."""
        word = self._base
        if self._watch.warns:
            word |= WARNING
        if self._limited:
            word |= INTERNAL_LIMIT
        stop = self._stop
        if stop is not None:
            if stop.rests:
                word |= TARGET_REACHED
        elif self._halt is not None:
            if self._halt.done:
                word |= TARGET_REACHED
        elif self.state is ENABLED:
            bits = self._mode.bits
            word |= bits & ~MODE_BIT_12 if self.deaf else bits
        if self._watch.too_far:
            word |= MODE_BIT_13
        self.registers[keys.STATUSWORD] = word


_OVERRIDING = (Transition.QUICK_STOP, Transition.DISABLE_FROM_ENABLED)
"""What does not wait for a ramp to end."""
