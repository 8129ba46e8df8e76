"""The power state machine of CiA 402 and the power stage that it switches.

`State`, `Command` and `commanded` are the standard's table as pure functions; the numbers of the
transitions are those of CiA 402-2 (IEC 61800-7-201), figure "power drive system FSA". `PowerStage`
applies it to one axis: which ramp brings it to rest, and when the current is switched off.
`Connection` is what it does when its master is lost (6007h).

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

During the ramp out of operation enabled, only disable voltage and quick stop have an effect.
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
    """A state; its value is its bits in the statusword (0 to 3, 5 and 6)."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """A command in the controlword."""

    NONE = "nothing"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"


class Transition(IntEnum):
    """A change of state by its number in the standard; those without a command are in `EVENTS`."""

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
"""The motor may carry current."""

FAULTED = frozenset({State.FAULT_REACTION_ACTIVE, State.FAULT})
FAULT_RESET_BIT, HALT_BIT = 0x0080, 0x0100

NEW_SETPOINT_BIT, AT_ONCE_BIT, RELATIVE_BIT = 0x0010, 0x0020, 0x0040
"""Bits of the controlword beside the commands; the last three belong to profile position."""

VOLTAGE_ENABLED, WARNING, REMOTE = 0x0010, 0x0080, 0x0200

TARGET_REACHED, INTERNAL_LIMIT, MODE_BIT_12, MODE_BIT_13 = 0x0400, 0x0800, 0x1000, 0x2000
"""Bits of the statusword; what 12 and 13 say depends on the mode."""

_T = Transition

EVENTS: dict[Transition, tuple[State | None, State]] = {
    _T.STARTED: (None, State.NOT_READY_TO_SWITCH_ON),
    _T.INITIALISED: (State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED),
    _T.QUICK_STOP_ENDED: (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED),
    _T.FAULT: (None, State.FAULT_REACTION_ACTIVE),
    _T.FAULT_REACTION_ENDED: (State.FAULT_REACTION_ACTIVE, State.FAULT),
}
"""Transitions that a drive makes on its own: from (None: from anywhere) and to."""

_COMMANDS = (
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)
"""Mask, value and command. Switch on is also what disables the operation."""


def command_of(controlword: int, before: int) -> Command:
    """Return the command in a controlword that follows the one `before` it.

    A fault reset is a rising edge of bit 7; as long as that bit stays set, there is no command.
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
    """Where a command leads from a state; None where it is not legal, and then ignored.

    Args:
        state: Present state.
        command: See `command_of`.
        stays_stopped: The quick stop option code (605Ah) is 5 to 8: only then does transition 16
            lead out of a quick stop back to where the drive was.
    """
    found = _TABLE.get(state, {}).get(command)
    if found is not None and found[0] is Transition.ENABLE_FROM_QUICK_STOP and not stays_stopped:
        return None
    return found


COASTING_STEPS = 50
"""How long a motor without current turns before the brake takes it."""

ENABLED = State.OPERATION_ENABLED

STAYS = 5
"""605Ah from here on: quick stop stays active when the axis rests."""

_OVERRIDING = (Transition.QUICK_STOP, Transition.DISABLE_FROM_ENABLED)
"""What does not wait for a ramp to end."""


class PowerStage:
    """The state machine at work on an axis.

    Args:
        axis: Of this drive.
        begun: Called when the operation is enabled, and when it goes on after a quick stop.
        fault_reset: Called when a master resets a fault; whether it may, or its cause is there yet.

    Attributes:
        state: See `states`.
        powered: The motor may carry current.
        word: What the statusword says of the state.
        stop: What brings the axis to rest, as long as that takes (605Ah = 5 to 8: stays).
        halt: The same by bit 8 of the controlword.
        coasting: Steps for which the motor still turns without current.
    """

    def __init__(
        self, axis: Axis, begun: Callable[[], None], fault_reset: Callable[[], bool]
    ) -> None:
        self._axis, self._begun, self._fault_reset = axis, begun, fault_reset
        self.switch_off()

    def switch_off(self) -> None:
        """All is forgotten, the brake is closed."""
        self.stop: Stop | None = None
        self.halt: Ramp | None = None
        self.coasting = 0
        self._word, self._overruled = 0, -1
        self.enter(State.NOT_READY_TO_SWITCH_ON)

    @property
    def status_bits(self) -> int:
        """Return the state's bits of the statusword; bit 10 while the axis is being stopped."""
        stop, halt = self.stop, self.halt
        rests = stop.rests if stop is not None else halt is not None and halt.done
        return self.word | TARGET_REACHED * rests

    def enter(self, state: State) -> None:
        """Be in a state."""
        self.state, self.powered, self._settled = state, state in POWERED, False
        self.word = state.value | REMOTE | VOLTAGE_ENABLED

    def obey(self) -> bool:
        """Act on the controlword as it stands; whether a halt has just ended."""
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
        """Command this in place of the controlword, which then counts only when it is another."""
        self.command(command)
        self._overruled = self._axis.registers[keys.CONTROLWORD]

    def command(self, command: Command) -> None:
        """Make the transition that it leads to, if any."""
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
        """A fault: by 605Eh, from where the axis' set-point is, if it has torque to stop with."""
        option = option_of(self._axis.registers, keys.FAULT_REACTION_OPTION)
        if keeps_torque and option:
            self._begin_stop(option, State.FAULT)
        elif keeps_torque:
            self._lose(State.FAULT)
        else:
            self.enter(State.FAULT)

    def without(self, steps: int) -> Demand:
        """Return the demand without power: the motor turns freely, then the brake closes."""
        rows = rows_at_rest(self._axis.q, steps)
        if self.coasting <= 0:
            return Demand(rows, math.nan, True)
        self.coasting -= steps
        return Demand(rows, 0.0, False)

    def look(self, qd: float, steps: int) -> None:
        """The joint is measured at `qd` [rad/s]: a stop may be over."""
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
        """By its option code: along a ramp and then, or at once without current."""
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
        """Without current from now on."""
        self.stop = self.halt = None
        self.coasting = COASTING_STEPS
        self.enter(to)

    def _turn_halt(self) -> bool:
        """Begin or end a halt by bit 8; return whether one has ended."""
        if self._word & HALT_BIT:
            self.halt = self._ramp(option_of(self._axis.registers, keys.HALT_OPTION))
            return False
        ended, self.halt = self.halt is not None, None
        return ended


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
    """Return the demand of an axis along a ramp; its set-point follows."""
    rows = ramp.advance(steps)
    axis.demand_q, axis.demand_qd = ramp.q, ramp.qd
    return Demand(rows, math.nan, False, 0.0, axis.torque_limit)


def option_of(registers: Registers, where: int) -> int:
    """Return an option code; makers' own codes (below 0) count as 0."""
    return max(0, registers[where])


TAKEN_OFF = 0x8100
"""Error code: communication; the NMT master has taken an enabled drive out of operation."""

COMMANDS = {2: Command.DISABLE_VOLTAGE, 3: Command.QUICK_STOP}
"""6007h; 0 is nothing."""


class Connection:
    """The reaction to a connection that is lost.

    Args:
        registers: Live.
        power: Of the same drive.
        fault: Lets the drive fail with an error code.
    """

    def __init__(
        self, registers: Registers, power: PowerStage, fault: Callable[[int], None]
    ) -> None:
        self._registers, self._power, self._fault = registers, power, fault

    def lost(self, code: int) -> None:
        """React to an error of the connection: heartbeat or RPDOs overdue, bus off.

        The controlword that the master has left behind counts no more until it is another one.
        """
        option = option_of(self._registers, keys.ABORT_CONNECTION_OPTION)
        if option == FAULT:
            self._fault(code)
        elif option in COMMANDS:
            self._power.overrule(COMMANDS[option])

    def taken_off(self) -> None:
        """The NMT state operational is left, or a reset is to come: the same where it has power."""
        if self._power.powered:
            self.lost(TAKEN_OFF)
