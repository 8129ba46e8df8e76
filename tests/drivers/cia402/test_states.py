"""The CiA 402 state machine from the master's side, over all statuswords and goals."""

from __future__ import annotations

import itertools

import pytest

from hil_drivers.cia402.axis import (
    Goal,
    State,
    controlword_resetting,
    controlword_towards,
    state_of,
    statusword_text,
)

# CiA 402-2, statusword bits 6 5 3 2 1 0, x for "whatever"; written out, not computed.
PATTERNS = {
    "0x0000": State.NOT_READY,
    "1x0000": State.DISABLED,
    "010001": State.READY,
    "010011": State.SWITCHED_ON,
    "010111": State.ENABLED,
    "000111": State.QUICK_STOP,
    "0x1111": State.FAULT_REACTION,
    "0x1000": State.FAULT,
}

# What a drive does with a controlword (CiA 402-2, transitions 2 to 16), without its own moves.
_SHUTDOWN, _SWITCH_ON, _ENABLE, _QUICK = 0x06, 0x07, 0x0F, 0x02


def matches(bits: str, pattern: str) -> bool:
    return all(p in ("x", b) for b, p in zip(bits, pattern, strict=True))


def drive_after(state: State, word: int) -> State:
    """An independent slave: where a drive goes from a state with a controlword."""
    if state in (State.NOT_READY, State.FAULT_REACTION, State.FAULT, State.UNKNOWN):
        return state
    if not word & 0x02:
        return State.DISABLED
    if not word & 0x04:
        return State.QUICK_STOP if state in (State.ENABLED, State.QUICK_STOP) else State.DISABLED
    if state is State.QUICK_STOP:
        return state
    command = word & 0x0F
    if command & 0x07 == _SHUTDOWN:
        return State.READY
    if state is State.DISABLED:
        return state
    if command == _ENABLE and state in (State.SWITCHED_ON, State.ENABLED):
        return State.ENABLED
    return State.SWITCHED_ON


@pytest.mark.thorough
def test_every_statusword_tells_the_state_of_its_pattern():
    for word in range(1 << 16):
        bits = "".join(str(word >> bit & 1) for bit in (6, 5, 3, 2, 1, 0))
        expected = [state for pattern, state in PATTERNS.items() if matches(bits, pattern)]
        assert [state_of(word)] == (expected or [State.UNKNOWN]), f"{word:04X}h"


PATH = (State.DISABLED, State.READY, State.SWITCHED_ON, State.ENABLED)


@pytest.mark.parametrize("start", PATH)
def test_a_drive_gets_enabled_one_confirmed_state_after_the_other(start):
    state, way = start, [start]
    while state is not State.ENABLED:
        state = drive_after(state, controlword_towards(state, Goal.ENABLED))
        way.append(state)
    assert way == list(PATH[PATH.index(start) :])


def test_a_drive_is_switched_off_one_state_after_the_other():
    state, way = State.ENABLED, []
    while state is not State.DISABLED:
        state = drive_after(state, controlword_towards(state, Goal.OFF))
        way.append(state)
    assert way == [State.SWITCHED_ON, State.READY, State.DISABLED]


def test_an_axis_that_brakes_is_not_left_without_voltage_on_the_way_to_enabled():
    assert controlword_towards(State.QUICK_STOP, Goal.ENABLED) & 0x0F == _QUICK
    assert drive_after(State.QUICK_STOP, 0x02) is State.QUICK_STOP


@pytest.mark.parametrize("state", list(State))
def test_quick_stop_brakes_an_enabled_axis_and_holds_no_other_one_powered(state):
    after = drive_after(state, controlword_towards(state, Goal.QUICK_STOP))
    if state in (State.ENABLED, State.QUICK_STOP):
        assert after is State.QUICK_STOP
    else:
        assert after in (State.DISABLED, state)
        assert after not in (State.READY, State.SWITCHED_ON, State.ENABLED)


@pytest.mark.parametrize(("state", "goal"), list(itertools.product(State, Goal)))
def test_no_goal_ever_resets_a_fault(state, goal):
    assert not controlword_towards(state, goal) & 0x80


@pytest.mark.parametrize("before", [0x00, 0x02, 0x07, 0x0F, 0x80])
def test_a_fault_reset_is_one_rising_edge_however_long_the_fault_stays(before):
    words = [before]
    for _ in range(10):
        words.append(controlword_resetting(State.FAULT, words[-1]))
    edges = [a for a, b in itertools.pairwise(words) if not a & 0x80 and b & 0x80]
    assert edges == ([] if before == 0x80 else [0x00])


@pytest.mark.parametrize("state", [each for each in State if each is not State.FAULT])
def test_out_of_fault_the_reset_is_taken_back(state):
    assert controlword_resetting(state, 0x80) == 0x00
    assert controlword_resetting(state, 0x00) == 0x00


def test_a_statusword_in_words_says_what_matters_and_its_number():
    assert statusword_text(0x1237) == "operation enabled (statusword 1237h)"
    assert statusword_text(0x3A37) == (
        "operation enabled, internal limit active, following error (statusword 3A37h)"
    )
    assert statusword_text(0x0008) == "fault, does not listen to the bus (bit 9) (statusword 0008h)"
