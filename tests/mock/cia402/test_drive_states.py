"""The power state machine of the mock drives, against the tables of CiA 402 written out here."""

import pytest

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.power import Command, State, Transition, command_of, commanded
from tests.support.can_drive_parts import CSP, CSV, OneDrive

NOT_READY, DISABLED = State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED
READY, ON, ENABLED = State.READY_TO_SWITCH_ON, State.SWITCHED_ON, State.OPERATION_ENABLED
STOPPING = State.QUICK_STOP_ACTIVE
REACTING, FAULT = State.FAULT_REACTION_ACTIVE, State.FAULT

PATTERNS = {
    Command.SHUTDOWN: "0xxxx110",
    Command.SWITCH_ON: "0xxx0111",
    Command.ENABLE_OPERATION: "0xxx1111",
    Command.DISABLE_VOLTAGE: "0xxxxx0x",
    Command.QUICK_STOP: "0xxxx01x",
}
"""Bits 7 to 0 of the controlword, as the standard's table of commands has them."""

STATUS_PATTERNS = {
    NOT_READY: "x0xx0000",
    DISABLED: "x1xx0000",
    READY: "x01x0001",
    ON: "x01x0011",
    ENABLED: "x01x0111",
    STOPPING: "x00x0111",
    REACTING: "x0xx1111",
    FAULT: "x0xx1000",
}
"""Bits 7 to 0 of the statusword."""

WORDS = (0x06, 0x07, 0x0F, 0x00, 0x02, 0x80)
LEADS_TO = {
    NOT_READY: (None, None, None, None, None, None),
    DISABLED: (READY, None, None, None, None, None),
    READY: (None, ON, ON, DISABLED, DISABLED, None),
    ON: (READY, None, ENABLED, DISABLED, DISABLED, None),
    ENABLED: (READY, ON, None, DISABLED, STOPPING, None),
    STOPPING: (None, None, ENABLED, DISABLED, None, None),
    REACTING: (None, None, None, None, None, None),
    FAULT: (None, None, None, None, None, DISABLED),
}
"""Where each of `WORDS` leads from a state; None: nowhere. Quick stop with 605Ah = 6."""

NUMBERS = {
    (DISABLED, 0x06): 2, (READY, 0x07): 3, (ON, 0x0F): 4, (ENABLED, 0x07): 5, (ON, 0x06): 6,
    (READY, 0x00): 7, (READY, 0x02): 7, (ENABLED, 0x06): 8, (ENABLED, 0x00): 9, (ON, 0x00): 10,
    (ON, 0x02): 10, (ENABLED, 0x02): 11, (STOPPING, 0x00): 12, (FAULT, 0x80): 15,
    (STOPPING, 0x0F): 16, (READY, 0x0F): 3,
}  # fmt: skip
"""Transitions of the standard's figure that a master commands."""

EVERY = [(state, word) for state in State for word in WORDS]


def fits(bits: int, pattern: str) -> bool:
    return all(p in ("x", b) for p, b in zip(pattern, f"{bits & 0xFF:08b}", strict=True))


def drive_in(state: State) -> OneDrive:
    """One that was brought there as a master and the world bring it there."""
    one = OneDrive()
    one.set(keys.QUICK_STOP_OPTION, 6)
    one.set(keys.SHUTDOWN_OPTION, 0)
    one.set(keys.DISABLE_OPTION, 0)
    if state is NOT_READY:
        return one
    one.on()
    if state is FAULT:
        one.drive.fault(0xFF01)
    elif state is REACTING:
        one.moving(1.0).drive.fault(0xFF01)
    elif state is not DISABLED:
        one.set(keys.MODE, CSP)
        one.set(keys.TARGET_POSITION, one.registers[keys.POSITION])
        for word, reached in ((0x06, READY), (0x07, ON), (0x0F, ENABLED), (0x02, STOPPING)):
            one.tell(word)
            if reached is state:
                break
    one.registers[keys.CONTROLWORD] = 0
    one.drive._power._word = 0
    assert one.state is state
    return one


@pytest.mark.parametrize("word", range(256))
def test_a_controlword_asks_for_what_the_standards_bit_pattern_says(word):
    fitting = [command for command, pattern in PATTERNS.items() if fits(word, pattern)]
    if word & 0x80:
        fitting = [Command.FAULT_RESET]
    assert len(fitting) <= 1
    assert command_of(word, 0) is (fitting[0] if fitting else Command.NONE)


@pytest.mark.parametrize(("state", "word"), EVERY)
def test_every_command_leads_from_every_state_where_the_table_says(state, word):
    found = commanded(state, command_of(word, 0), stays_stopped=True)
    assert (found[1] if found else None) is LEADS_TO[state][WORDS.index(word)]
    assert (int(found[0]) if found else None) == NUMBERS.get((state, word))


@pytest.mark.parametrize(("state", "word"), EVERY)
def test_a_drive_goes_where_the_table_says_and_shows_it(state, word):
    one = drive_in(state)
    one.set(keys.CONTROLWORD, word)
    expected = LEADS_TO[state][WORDS.index(word)] or state
    assert one.state is expected
    assert fits(one.status, STATUS_PATTERNS[expected])


def test_all_transitions_of_the_standard_are_there():
    assert sorted(int(number) for number in Transition) == list(range(17))
    assert {*NUMBERS.values(), 0, 1, 12, 13, 14} == set(range(17))


@pytest.mark.parametrize("option", [0, 1, 2, 3, 4])
def test_there_is_no_way_back_from_a_quick_stop_that_ends_disabled(option):
    one = OneDrive().moving(0.5)
    one.set(keys.QUICK_STOP_OPTION, option)
    one.tell(0x02)
    one.tell(0x0F)
    one.cycles(500)
    assert one.state is DISABLED


def test_enable_operation_from_ready_goes_through_switched_on():
    one = drive_in(READY)
    one.set(keys.CONTROLWORD, 0x0F)
    assert one.state is ON
    one.cycles(1)
    assert one.state is ENABLED


def test_a_fault_reset_is_a_rising_edge_only():
    one = OneDrive().on()
    one.tell(0x80)
    one.drive.fault(0xFF01)
    one.tell(0x80, cycles=5)
    assert one.state is FAULT
    one.tell(0x00)
    one.tell(0x80)
    assert one.state is DISABLED


def test_a_reset_bit_that_stays_set_keeps_commands_away():
    one = OneDrive().on()
    one.drive.fault(0xFF01)
    one.tell(0x80)
    one.tell(0x86, cycles=3)
    assert one.state is DISABLED
    one.tell(0x06)
    assert one.state is READY


def test_a_power_stage_comes_up_on_its_own_and_then_waits():
    one = OneDrive()
    assert one.state is NOT_READY
    one.on()
    one.cycles(10)
    assert one.state is DISABLED
    assert one.cycles(1).braked


def test_voltage_and_remote_are_told_in_every_state():
    for state in State:
        one = drive_in(state)
        assert one.status & 0x0210 == 0x0210


def test_a_reset_drive_has_forgotten_its_fault_and_its_mode():
    one = OneDrive().enabled(CSV)
    one.drive.fault(0xFF01)
    one.drive.reset()
    assert one.state is NOT_READY
    assert one.registers[keys.MODE_DISPLAY] == 0
    one.registers[keys.CONTROLWORD] = 0
    one.cycles(1)
    assert one.state is DISABLED
