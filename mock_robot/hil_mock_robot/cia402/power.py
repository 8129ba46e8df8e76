"""Power state machine of CiA 402, and the power stage that it switches.

`State`, `Command` and `commanded` implement the transition table of CiA 402 as pure functions. The
transitions have the same numbers as in CiA 402-2 (IEC 61800-7-201), figure "power drive system
FSA". `PowerStage` applies the transition table to one axis, selects the ramp to rest, and
determines when the current is switched off. `Connection` implements the reaction of a drive to the
loss of the master (6007h).

| state                 | event                                            | next state            |
|-----------------------|--------------------------------------------------|-----------------------|
| any                   | power on, NMT reset node                         | not ready             |
| not ready             | the first measurement                            | switch on disabled    |
| switch on disabled    | shutdown                                         | ready to switch on    |
| ready to switch on    | switch on, enable operation                      | switched on           |
| ready to switch on    | disable voltage, quick stop                      | switch on disabled    |
| switched on           | enable operation                                 | operation enabled     |
| switched on           | shutdown                                         | ready to switch on    |
| switched on           | disable voltage, quick stop                      | switch on disabled    |
| operation enabled     | switch on; after a ramp, unless 605Ch = 0        | switched on           |
| operation enabled     | shutdown; after a ramp, unless 605Bh = 0         | ready to switch on    |
| operation enabled     | disable voltage, or quick stop with 605Ah = 0    | switch on disabled    |
| operation enabled     | quick stop with another 605Ah                    | quick stop active     |
| quick stop active     | at rest with 605Ah = 1 to 4, or disable voltage  | switch on disabled    |
| quick stop active     | enable operation with 605Ah = 5 to 8             | operation enabled     |
| any but the two below | a fault                                          | fault reaction active |
| fault reaction active | at rest; at once if 605Eh = 0 or without current | fault                 |
| fault                 | fault reset, if its cause is gone                | switch on disabled    |

During the ramp that leaves operation enabled, only the commands disable voltage and quick stop have
an effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, IntEnum

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis, Ramp, rows_at_rest
from hil_mock_robot.cia402.body import Demand
from hil_mock_robot.cia402.keys import Registers

FAULT = 1


class State(Enum):
    """State of the drive; the value contains the bits 0 to 3, 5 and 6 of the statusword."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """Command that a controlword contains."""

    NONE = "nothing"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"


class Transition(IntEnum):
    """State transition by its number in CiA 402; automatic transitions are in `EVENTS`."""

    STARTED = 0
    INITIALISED = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4
    DISABLE_OPERATION = 5
    SHUTDOWN_FROM_SWITCHED_ON = 6
    DISABLE_FROM_READY = 7
    SHUTDOWN_FROM_ENABLED = 8
    DISABLE_FROM_ENABLED = 9
    DISABLE_FROM_SWITCHED_ON = 10
    QUICK_STOP = 11
    QUICK_STOP_ENDED = 12
    FAULT = 13
    FAULT_REACTION_ENDED = 14
    FAULT_RESET = 15
    ENABLE_FROM_QUICK_STOP = 16


POWERED = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE})
"""States in which the motor can carry current."""

FAULTED = frozenset({State.FAULT_REACTION_ACTIVE, State.FAULT})
FAULT_RESET_BIT, HALT_BIT = 0x0080, 0x0100

NEW_SETPOINT_BIT, AT_ONCE_BIT, RELATIVE_BIT = 0x0010, 0x0020, 0x0040
"""Bits of the controlword that are not commands; bits 4 to 6 are for profile position."""

VOLTAGE_ENABLED, WARNING, REMOTE = 0x0010, 0x0080, 0x0200

TARGET_REACHED, INTERNAL_LIMIT, MODE_BIT_12, MODE_BIT_13 = 0x0400, 0x0800, 0x1000, 0x2000
"""Bits of the statusword; the meaning of bits 12 and 13 depends on the mode."""

_T = Transition

EVENTS: dict[Transition, tuple[State | None, State]] = {
    _T.STARTED: (None, State.NOT_READY_TO_SWITCH_ON),
    _T.INITIALISED: (State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED),
    _T.QUICK_STOP_ENDED: (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED),
    _T.FAULT: (None, State.FAULT_REACTION_ACTIVE),
    _T.FAULT_REACTION_ENDED: (State.FAULT_REACTION_ACTIVE, State.FAULT),
}
"""Automatic transitions of a drive: initial state (None for any state) and final state."""

_COMMANDS = (
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)
"""Commands by mask and value of the controlword; switch on also means disable operation."""


def command_of(controlword: int, before: int) -> Command:
    """Return the command in a controlword that was sent after the controlword `before`.

    A fault reset is a rising edge of bit 7; while that bit remains set, there is no command.
    """
    if controlword & FAULT_RESET_BIT:
        return Command.NONE if before & FAULT_RESET_BIT else Command.FAULT_RESET
    for mask, value, command in _COMMANDS:
        if controlword & mask == value:
            return command
    return Command.NONE


_TABLE: dict[State, dict[Command, tuple[Transition, State]]] = {
    State.SWITCH_ON_DISABLED: {
        Command.SHUTDOWN: (_T.SHUTDOWN, State.READY_TO_SWITCH_ON),
    },
    State.READY_TO_SWITCH_ON: {
        Command.SWITCH_ON: (_T.SWITCH_ON, State.SWITCHED_ON),
        Command.ENABLE_OPERATION: (_T.SWITCH_ON, State.SWITCHED_ON),
        Command.DISABLE_VOLTAGE: (_T.DISABLE_FROM_READY, State.SWITCH_ON_DISABLED),
        Command.QUICK_STOP: (_T.DISABLE_FROM_READY, State.SWITCH_ON_DISABLED),
    },
    State.SWITCHED_ON: {
        Command.ENABLE_OPERATION: (_T.ENABLE_OPERATION, State.OPERATION_ENABLED),
        Command.SHUTDOWN: (_T.SHUTDOWN_FROM_SWITCHED_ON, State.READY_TO_SWITCH_ON),
        Command.DISABLE_VOLTAGE: (_T.DISABLE_FROM_SWITCHED_ON, State.SWITCH_ON_DISABLED),
        Command.QUICK_STOP: (_T.DISABLE_FROM_SWITCHED_ON, State.SWITCH_ON_DISABLED),
    },
    State.OPERATION_ENABLED: {
        Command.SWITCH_ON: (_T.DISABLE_OPERATION, State.SWITCHED_ON),
        Command.SHUTDOWN: (_T.SHUTDOWN_FROM_ENABLED, State.READY_TO_SWITCH_ON),
        Command.DISABLE_VOLTAGE: (_T.DISABLE_FROM_ENABLED, State.SWITCH_ON_DISABLED),
        Command.QUICK_STOP: (_T.QUICK_STOP, State.QUICK_STOP_ACTIVE),
    },
    State.QUICK_STOP_ACTIVE: {
        Command.DISABLE_VOLTAGE: (_T.QUICK_STOP_ENDED, State.SWITCH_ON_DISABLED),
        Command.ENABLE_OPERATION: (_T.ENABLE_FROM_QUICK_STOP, State.OPERATION_ENABLED),
    },
    State.FAULT: {
        Command.FAULT_RESET: (_T.FAULT_RESET, State.SWITCH_ON_DISABLED),
    },
}


def commanded(
    state: State, command: Command, *, stays_stopped: bool = False
) -> tuple[Transition, State] | None:
    """Return transition and final state of a command; None if a state does not permit it.

    Args:
        state: Present state.
        command: Command from `command_of`.
        stays_stopped: Whether the quick stop option code (605Ah) is from 5 to 8. Only with the
            codes 5 to 8, transition 16 leads from a quick stop back to operation enabled.
    """
    found = _TABLE.get(state, {}).get(command)
    if found is not None and found[0] is Transition.ENABLE_FROM_QUICK_STOP and not stays_stopped:
        return None
    return found


COASTING_STEPS = 50
"""Number of steps for which a motor without current turns freely before the brake closes."""

ENABLED = State.OPERATION_ENABLED

STAYS = 5
"""Lowest quick stop option code (605Ah) with which an axis at rest stays in quick stop active."""

_OVERRIDING = (Transition.QUICK_STOP, Transition.DISABLE_FROM_ENABLED)
"""State transitions that do not wait for the end of a ramp."""


class PowerStage:
    """Power stage of one axis, which the state machine controls.

    Args:
        axis: Axis of the drive.
        begun: Callback that is called when the operation is enabled or resumes after a quick stop.
        fault_reset: Function that is called for a fault reset and returns whether the cause of the
            fault is gone.

    Attributes:
        state: Present state of the drive.
        powered: Whether the motor can carry current.
        word: Bits of the statusword that show the state.
        stop: Present ramp to rest; None if there is no ramp or the ramp is complete. With 605Ah = 5
            to 8 the ramp remains stored.
        halt: Present ramp of a halt by bit 8 of the controlword; None without a halt.
        coasting: Remaining number of steps for which the motor turns without current.
    """

    def __init__(
        self, axis: Axis, begun: Callable[[], None], fault_reset: Callable[[], bool]
    ) -> None:
        self._axis, self._begun, self._fault_reset = axis, begun, fault_reset
        self.switch_off()

    def switch_off(self) -> None:
        """Reset the power stage, with a closed brake."""
        self.stop: Stop | None = None
        self.halt: Ramp | None = None
        self.coasting = 0
        self._word, self._overruled = 0, -1
        self.enter(State.NOT_READY_TO_SWITCH_ON)

    @property
    def status_bits(self) -> int:
        """Bits of the statusword for the state, with bit 10 if a stop or a halt is complete."""
        stop, halt = self.stop, self.halt
        rests = stop.rests if stop is not None else halt is not None and halt.done
        return self.word | TARGET_REACHED * rests

    def enter(self, state: State) -> None:
        """Enter a state."""
        self.state, self.powered, self._settled = state, state in POWERED, False
        self.word = state.value | REMOTE | VOLTAGE_ENABLED

    def obey(self) -> bool:
        """Apply the present controlword; return whether this ended a halt."""
        word, before = self._axis.registers[keys.CONTROLWORD], self._word
        if word == before and self._settled:
            return False
        self._word, self._settled = word, True
        if word == self._overruled:
            return False
        self._overruled = -1
        self.command(command_of(word, before))
        return bool((word ^ before) & HALT_BIT) and self.state is ENABLED and self._turn_halt()

    def overrule(self, command: Command) -> None:
        """Execute a command and ignore the present controlword until it changes."""
        self.command(command)
        self._overruled = self._axis.registers[keys.CONTROLWORD]

    def command(self, command: Command) -> None:
        """Execute the transition of a command, if the present state permits a transition."""
        stays = option_of(self._axis.registers, keys.QUICK_STOP_OPTION) >= STAYS
        found = commanded(self.state, command, stays_stopped=stays)
        if found is None:
            return
        transition, to = found
        pending = self.stop is not None and self.state is ENABLED
        if not pending or transition in _OVERRIDING:
            self._settled = False
            self._make(transition, to)

    def react(self, keeps_torque: bool) -> None:
        """Start the fault reaction of 605Eh; an axis without torque enters fault immediately."""
        option = option_of(self._axis.registers, keys.FAULT_REACTION_OPTION)
        if keeps_torque and option:
            self._begin_stop(option, State.FAULT)
        elif keeps_torque:
            self._lose(State.FAULT)
        else:
            self.enter(State.FAULT)

    def without(self, steps: int) -> Demand:
        """Return the demand without power: the motor turns freely, until the brake closes."""
        rows = rows_at_rest(self._axis.q, steps)
        if self.coasting <= 0:
            return Demand(rows, math.nan, True)
        self.coasting -= steps
        return Demand(rows, 0.0, False)

    def look(self, qd: float, steps: int) -> None:
        """Check whether a stop is complete at a measured joint speed `qd` [rad/s]."""
        stop = self.stop
        if stop is not None and stop.over(qd, steps) and stop.then is not None:
            self.stop = None
            self.enter(stop.then)

    def _make(self, transition: Transition, to: State) -> None:
        match transition:
            case Transition.SHUTDOWN:
                self._axis.rescale()
                self.enter(to)
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
                if self._fault_reset():
                    self.enter(to)
            case _:
                self.enter(to)

    def _begin(self, to: State) -> None:
        self.stop, self.halt, self.coasting = None, None, 0
        self.enter(to)
        self._begun()
        if self._word & HALT_BIT:
            self._turn_halt()

    def _leave(self, option_key: int, to: State) -> None:
        """Leave operation enabled by an option code: along a ramp, or at once without current."""
        option = option_of(self._axis.registers, option_key)
        if option:
            self._begin_stop(option, to)
        else:
            self._lose(to)

    def _quick_stop(self, to: State) -> None:
        option = option_of(self._axis.registers, keys.QUICK_STOP_OPTION)
        if not option:
            self._lose(State.SWITCH_ON_DISABLED)
            return
        self.enter(to)
        self._begin_stop(option, None if option >= STAYS else State.SWITCH_ON_DISABLED)

    def _ramp(self, option: int) -> Ramp:
        axis = self._axis
        return Ramp(axis.demand_q, axis.demand_qd, axis.deceleration(option))

    def _begin_stop(self, option: int, then: State | None) -> None:
        self.halt = None
        self.stop = Stop(self._ramp(option), then)

    def _lose(self, to: State) -> None:
        """Switch the current off and enter a state."""
        self.stop = self.halt = None
        self.coasting = COASTING_STEPS
        self.enter(to)

    def _turn_halt(self) -> bool:
        """Begin or end a halt by bit 8; return whether a halt has ended."""
        if self._word & HALT_BIT:
            self.halt = self._ramp(option_of(self._axis.registers, keys.HALT_OPTION))
            return False
        ended, self.halt = self.halt is not None, None
        return ended


AT_REST_RAD_S = 0.005

SETTLING_STEPS = 200
"""Number of steps after the ramp before the brake stops a joint that still moves."""


class Stop:
    """Ramp to rest, and the state that follows the ramp.

    Args:
        ramp: Ramp along which the axis decelerates.
        then: State after the stop; None to remain in the present state (605Ah = 5 to 8).

    Attributes:
        ramp: Ramp along which the axis decelerates.
        then: State after the stop, or None.
        rests: Whether the stop is complete.
    """

    def __init__(self, ramp: Ramp, then: State | None) -> None:
        self.ramp, self.then = ramp, then
        self.rests = False
        self._waited = 0

    def over(self, qd: float, steps: int) -> bool:
        """Return whether a joint with a measured speed `qd` [rad/s] has come to rest."""
        if self.ramp.done and not self.rests:
            self._waited += steps
            self.rests = abs(qd) < AT_REST_RAD_S or self._waited > SETTLING_STEPS
        return self.rests


def slowed(axis: Axis, ramp: Ramp, steps: int) -> Demand:
    """Return the demand of an axis along a ramp; also update the set-point of the axis."""
    rows = ramp.advance(steps)
    axis.demand_q, axis.demand_qd = ramp.q, ramp.qd
    return Demand(rows, math.nan, False, 0.0, axis.torque_limit)


def option_of(registers: Registers, where: int) -> int:
    """Return the value of an option code; manufacturer-specific codes (below 0) count as 0."""
    return max(0, registers[where])


TAKEN_OFF = 0x8100
"""Error code (communication) of an enabled drive whose NMT state operational was ended."""

COMMANDS = {2: Command.DISABLE_VOLTAGE, 3: Command.QUICK_STOP}
"""Command that each value of 6007h triggers; 0 means no reaction."""


class Connection:
    """Reaction of a drive to a lost connection.

    Args:
        registers: Live objects of the drive.
        power: Power stage of the same drive.
        fault: Function that starts a fault with an error code.
    """

    def __init__(
        self, registers: Registers, power: PowerStage, fault: Callable[[int], None]
    ) -> None:
        self._registers, self._power, self._fault = registers, power, fault

    def lost(self, code: int) -> None:
        """React to an error of the connection, such as an overdue heartbeat or RPDO, or bus-off.

        After the reaction, the last controlword of the master has no effect until the controlword
        changes.
        """
        option = option_of(self._registers, keys.ABORT_CONNECTION_OPTION)
        if option == FAULT:
            self._fault(code)
        elif option in COMMANDS:
            self._power.overrule(COMMANDS[option])

    def taken_off(self) -> None:
        """React to the end of the NMT state operational, or to a reset, if the drive has power."""
        if self._power.powered:
            self.lost(TAKEN_OFF)
