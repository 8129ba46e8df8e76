"""The power state machine of CiA 402 as a drive has it: pure functions, no time, no motion.

Numbers of transitions are those of CiA 402-2 (IEC 61800-7-201), figure "power drive system FSA".
"""

from __future__ import annotations

from enum import Enum, IntEnum


class State(Enum):
    """A state; its value is what the statusword says of it (bits 0 to 3, 5 and 6)."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """What a controlword asks for."""

    NONE = "nothing"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"


class Transition(IntEnum):
    """A change of state by its number in the standard; what is not commanded is in `EVENTS`."""

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

VOLTAGE_ENABLED, QUICK_STOP_OFF, WARNING, REMOTE = 0x0010, 0x0020, 0x0080, 0x0200
TARGET_REACHED, INTERNAL_LIMIT, MODE_BIT_12, MODE_BIT_13 = 0x0400, 0x0800, 0x1000, 0x2000
"""Bits of the statusword; what 12 and 13 say depends on the mode."""

_COMMANDS = (
    (0x82, 0x00, Command.DISABLE_VOLTAGE),
    (0x86, 0x02, Command.QUICK_STOP),
    (0x87, 0x06, Command.SHUTDOWN),
    (0x8F, 0x07, Command.SWITCH_ON),
    (0x8F, 0x0F, Command.ENABLE_OPERATION),
)
"""Mask, value and command. Switch on is also what disables the operation."""

_T = Transition
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

EVENTS: dict[Transition, tuple[State | None, State]] = {
    _T.STARTED: (None, State.NOT_READY_TO_SWITCH_ON),
    _T.INITIALISED: (State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED),
    _T.QUICK_STOP_ENDED: (State.QUICK_STOP_ACTIVE, State.SWITCH_ON_DISABLED),
    _T.FAULT: (None, State.FAULT_REACTION_ACTIVE),
    _T.FAULT_REACTION_ENDED: (State.FAULT_REACTION_ACTIVE, State.FAULT),
}
"""Transitions that a drive makes on its own: from (None: from anywhere) and to."""


def command_of(controlword: int, before: int) -> Command:
    """What a controlword asks for, after the one `before` it.

    A fault reset is a rising edge of bit 7; as long as that bit stays set, there is no command.
    """
    if controlword & FAULT_RESET_BIT:
        return Command.NONE if before & FAULT_RESET_BIT else Command.FAULT_RESET
    for mask, value, command in _COMMANDS:
        if controlword & mask == value:
            return command
    return Command.NONE


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
