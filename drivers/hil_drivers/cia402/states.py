"""The state machine of CiA 402, from the master's side: pure functions of statusword and goal.

Nothing here keeps a state: what a drive is to be told follows from the statusword that it has just
sent, for each axis on its own, so that all axes go through the states at once.
"""

from __future__ import annotations

from enum import Enum


class State(Enum):
    """Where a drive is; the value is how messages say it."""

    NOT_READY = "not ready to switch on"
    DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "in no state of CiA 402"


class Goal(Enum):
    """Where a drive is to be brought."""

    OFF = "switch on disabled"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop"


PATH = (State.DISABLED, State.READY, State.SWITCHED_ON, State.ENABLED)
"""The way from off to enabled; each is to be confirmed before the next is asked for."""

POWERED = frozenset({State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION})
"""The motor carries current: the axis may move."""

DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE = 0x00, 0x02, 0x06, 0x07, 0x0F
FAULT_RESET = 0x80
"""Controlwords (6040h); bit 2 is active-low, bit 7 counts when it rises."""

VOLTAGE_ENABLED, WARNING, REMOTE = 0x0010, 0x0080, 0x0200
TARGET_REACHED, INTERNAL_LIMIT = 0x0400, 0x0800
FOLLOWS_COMMAND, FOLLOWING_ERROR = 0x1000, 0x2000
"""Bits of the statusword (6041h); the last two mean this in CSP, CSV and CST."""

_BY_4F = {
    0x00: State.NOT_READY,
    0x40: State.DISABLED,
    0x0F: State.FAULT_REACTION,
    0x08: State.FAULT,
}
_BY_6F = {
    0x21: State.READY,
    0x23: State.SWITCHED_ON,
    0x27: State.ENABLED,
    0x07: State.QUICK_STOP,
}

_TOWARDS_ENABLED = {
    State.DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: ENABLE,
    State.ENABLED: ENABLE,
    State.QUICK_STOP: QUICK_STOP,
    State.UNKNOWN: QUICK_STOP,
}
"""An axis that brakes is let brake: it gets to `DISABLED` on its own (605Ah = 2)."""

_TOWARDS_OFF = {State.ENABLED: SWITCH_ON, State.SWITCHED_ON: SHUTDOWN}

_SAID = {
    WARNING: "warning",
    INTERNAL_LIMIT: "internal limit active",
    FOLLOWING_ERROR: "following error",
}


def state_of(statusword: int) -> State:
    """The state that a statusword tells (CiA 402, masks 4Fh and 6Fh)."""
    return _BY_4F.get(statusword & 0x4F) or _BY_6F.get(statusword & 0x6F, State.UNKNOWN)


def controlword_towards(state: State, goal: Goal) -> int:
    """The controlword for the next step from a state towards a goal.

    Never resets a fault: in `FAULT` it is disable voltage, whatever the goal.

    Args:
        state: As the drive has just told it.
        goal: `OFF` is meant for an axis at rest: it goes down one step at a time, and takes the
            voltage from an axis that is in quick stop.
    """
    if goal is Goal.QUICK_STOP:
        return QUICK_STOP
    steps = _TOWARDS_ENABLED if goal is Goal.ENABLED else _TOWARDS_OFF
    return steps.get(state, DISABLE_VOLTAGE)


def controlword_resetting(state: State, last: int) -> int:
    """The controlword of a fault reset that somebody has asked for: one rising edge of bit 7.

    Args:
        state: As the drive has just told it; out of `FAULT` the bit is taken back.
        last: The controlword sent before this one; disable voltage to begin with.
    """
    if state is State.FAULT and last in (DISABLE_VOLTAGE, FAULT_RESET):
        return FAULT_RESET
    return DISABLE_VOLTAGE


def told_by(statusword: int) -> str:
    """A statusword in words, for messages."""
    said = [text for bit, text in _SAID.items() if statusword & bit]
    if not statusword & REMOTE:
        said.append("does not listen to the bus (bit 9)")
    return f"{', '.join([state_of(statusword).value, *said])} (statusword {statusword:04X}h)"
