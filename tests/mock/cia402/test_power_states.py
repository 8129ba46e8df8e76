"""The power state machine of CiA 402: the standard's table once, for mock drives and their driver.

The table is written out from CiA 402-2 (IEC 61800-7-201), figure and tables of the "power drive
system FSA". It is walked state by state and command by command, and by random masters.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from hil_drivers.cia402 import axis as driver
from hil_drivers.cia402.axis import Goal, controlword_resetting, controlword_towards, state_of
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.power import (
    COASTING_STEPS,
    POWERED,
    Command,
    State,
    Transition,
    command_of,
    commanded,
)
from tests.support.can_drive_parts import CSP, CSV, OneDrive
from tests.support.fuzzing import examples

NOT_READY, DISABLED = State.NOT_READY_TO_SWITCH_ON, State.SWITCH_ON_DISABLED
READY, ON, ENABLED = State.READY_TO_SWITCH_ON, State.SWITCHED_ON, State.OPERATION_ENABLED
STOPPING = State.QUICK_STOP_ACTIVE
REACTING, FAULT = State.FAULT_REACTION_ACTIVE, State.FAULT

# The table

STATUSWORDS = {
    NOT_READY: "x0xx0000",
    DISABLED: "x1xx0000",
    READY: "x01x0001",
    ON: "x01x0011",
    ENABLED: "x01x0111",
    STOPPING: "x00x0111",
    REACTING: "x0xx1111",
    FAULT: "x0xx1000",
}
"""Bits 7 to 0 of the statusword; x for any."""

CONTROLWORDS = {
    Command.SHUTDOWN: "0xxxx110",
    Command.SWITCH_ON: "0xxx0111",
    Command.ENABLE_OPERATION: "0xxx1111",
    Command.DISABLE_VOLTAGE: "0xxxxx0x",
    Command.QUICK_STOP: "0xxxx01x",
    Command.FAULT_RESET: "1xxxxxxx",
}
"""Bits 7 to 0 of the controlword. Switch on is disable operation where the operation is enabled;
a fault reset is the rising edge of bit 7, and while that is set there is no other command."""


class Row(NamedTuple):
    """A transition by its number; without a command a drive makes it on its own."""

    number: int
    state: State | None
    command: Command | None
    to: State


TABLE = (
    Row(0, None, None, NOT_READY),
    Row(1, NOT_READY, None, DISABLED),
    Row(2, DISABLED, Command.SHUTDOWN, READY),
    Row(3, READY, Command.SWITCH_ON, ON),
    Row(3, READY, Command.ENABLE_OPERATION, ON),  # and then 4
    Row(4, ON, Command.ENABLE_OPERATION, ENABLED),
    Row(5, ENABLED, Command.SWITCH_ON, ON),  # after a ramp unless 605Ch = 0
    Row(6, ON, Command.SHUTDOWN, READY),
    Row(7, READY, Command.DISABLE_VOLTAGE, DISABLED),
    Row(7, READY, Command.QUICK_STOP, DISABLED),
    Row(8, ENABLED, Command.SHUTDOWN, READY),  # after a ramp unless 605Bh = 0
    Row(9, ENABLED, Command.DISABLE_VOLTAGE, DISABLED),
    Row(10, ON, Command.DISABLE_VOLTAGE, DISABLED),
    Row(10, ON, Command.QUICK_STOP, DISABLED),
    Row(11, ENABLED, Command.QUICK_STOP, STOPPING),
    Row(12, STOPPING, Command.DISABLE_VOLTAGE, DISABLED),
    Row(12, STOPPING, None, DISABLED),  # at rest, with 605Ah = 1 to 4
    Row(13, None, None, REACTING),
    Row(14, REACTING, None, FAULT),
    Row(15, FAULT, Command.FAULT_RESET, DISABLED),
    Row(16, STOPPING, Command.ENABLE_OPERATION, ENABLED),  # with 605Ah = 5 to 8
)
COMMANDED = {(row.state, row.command): row for row in TABLE if row.command is not None}
STAYS = range(5, 9)
"""605Ah with which quick stop stays active at rest."""


def fits(bits: int, pattern: str) -> bool:
    return all(p in ("x", b) for p, b in zip(pattern, f"{bits & 0xFF:08b}", strict=True))


def command_in(word: int, before: int = 0) -> Command:
    """The command of a controlword after another one, by the table."""
    found = [command for command, pattern in CONTROLWORDS.items() if fits(word, pattern)]
    assert len(found) <= 1
    if found == [Command.FAULT_RESET] and before & 0x80:
        return Command.NONE
    return found[0] if found else Command.NONE


def after(state: State, word: int, before: int = 0) -> State:
    """Where a controlword leads, by the table, with 605Ah = 5 to 8 and no ramps."""
    row = COMMANDED.get((state, command_in(word, before)))
    return row.to if row else state


def drivers(state: State) -> driver.State:
    """The same state as the driver names it."""
    return driver.State(state.name.lower().replace("_", " "))


MOCKS = {drivers(state): state for state in State}

# Step by step: mock drives


def test_all_transitions_of_the_standard_are_in_the_table() -> None:
    assert {row.number for row in TABLE} == set(range(17)) == {int(each) for each in Transition}


def test_a_controlword_commands_what_its_bit_pattern_says() -> None:
    for word, before in itertools.product(range(256), (0x00, 0x80)):
        assert command_of(word, before) is command_in(word, before), f"{word:02X}h"


@pytest.mark.parametrize("stays", [True, False])
@pytest.mark.parametrize("command", list(Command))
@pytest.mark.parametrize("state", list(State))
def test_a_command_leads_where_the_table_says(state: State, command: Command, stays: bool) -> None:
    row = COMMANDED.get((state, command))
    if row and row.number == 16 and not stays:
        row = None
    found = commanded(state, command, stays_stopped=stays)
    assert found == ((Transition(row.number), row.to) if row else None)


def drive_in(state: State) -> OneDrive:
    """One that was brought there as a master and the world bring it there, without ramps."""
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


WORDS = (0x00, 0x01, 0x02, 0x06, 0x07, 0x0F, 0x1F, 0x80, 0x86, 0x8F, 0x70, 0x76, 0x10F)


@pytest.mark.parametrize("state", list(State))
def test_a_drive_goes_where_the_table_says_and_shows_it(state: State) -> None:
    for word in WORDS:
        one = drive_in(state)
        assert one.status & 0x0210 == 0x0210  # voltage and remote
        one.set(keys.CONTROLWORD, word)
        expected = after(state, word)
        assert one.state is expected, f"{word:02X}h"
        assert fits(one.status, STATUSWORDS[expected])
        assert one.status & 0x0210 == 0x0210


def test_enable_operation_from_ready_goes_through_switched_on() -> None:
    one = drive_in(READY)
    one.set(keys.CONTROLWORD, 0x0F)
    assert one.state is ON
    one.cycles(1)
    assert one.state is ENABLED


@pytest.mark.parametrize("option", range(9))
def test_605ah_decides_where_a_quick_stop_ends_and_whether_there_is_a_way_back(option: int) -> None:
    one = OneDrive().moving(0.5)
    one.set(keys.QUICK_STOP_OPTION, option)
    one.tell(0x02)
    assert one.state is (STOPPING if option else DISABLED)
    one.tell(0x0F)
    assert one.state is (ENABLED if option in STAYS else STOPPING if option else DISABLED)
    if option in STAYS:
        one.tell(0x02)
    one.cycles(500)
    assert one.state is (STOPPING if option in STAYS else DISABLED)


def test_a_fault_reset_is_a_rising_edge_and_keeps_commands_away_while_it_is_set() -> None:
    one = OneDrive().on()
    one.tell(0x80)
    one.drive.fault(0xFF01)
    one.tell(0x80, cycles=5)
    assert one.state is FAULT
    one.tell(0x00)
    one.tell(0x80)
    assert one.state is DISABLED
    one.tell(0x86, cycles=3)
    assert one.state is DISABLED
    one.tell(0x06)
    assert one.state is READY


def test_a_power_stage_comes_up_on_its_own_and_then_waits() -> None:
    one = OneDrive()
    assert one.state is NOT_READY
    one.on()
    one.cycles(10)
    assert one.state is DISABLED
    assert one.cycles(1).braked


def test_a_reset_drive_has_forgotten_its_fault_and_its_mode() -> None:
    one = OneDrive().enabled(CSV)
    one.drive.fault(0xFF01)
    one.drive.reset()
    assert one.state is NOT_READY
    assert one.registers[keys.MODE_DISPLAY] == 0
    one.registers[keys.CONTROLWORD] = 0
    one.cycles(1)
    assert one.state is DISABLED


# Step by step: the driver


def test_the_driver_reads_the_state_of_every_statusword() -> None:
    for low, high in itertools.product(range(256), (0x00, 0x02, 0x16, 0x3A, 0xFF)):
        expected = [state for state, pattern in STATUSWORDS.items() if fits(low, pattern)]
        found = state_of(high << 8 | low)
        assert [found] == ([drivers(each) for each in expected] or [driver.State.UNKNOWN])


def driven(start: State, goal: Goal) -> list[State]:
    """States of a drive, by the table, that the driver brings to a goal; until it stays."""
    way = [start]
    while True:
        word = controlword_towards(drivers(way[-1]), goal)
        if (state := after(way[-1], word)) is way[-1]:
            return way
        way.append(state)


@pytest.mark.parametrize("goal", list(Goal))
@pytest.mark.parametrize("start", list(State))
def test_the_driver_brings_a_drive_to_its_goal_one_confirmed_state_after_the_other(
    start: State, goal: Goal
) -> None:
    up, down = (DISABLED, READY, ON, ENABLED), (ENABLED, ON, READY, DISABLED)
    way = driven(start, goal)
    if start in (NOT_READY, REACTING, FAULT):
        assert way == [start]  # only a drive itself or a fault reset leads out of these
    elif goal is Goal.ENABLED:
        # An axis that brakes is not left without voltage on the way to enabled.
        assert way == ([STOPPING] if start is STOPPING else list(up[up.index(start) :]))
    elif goal is Goal.OFF:
        expected = [READY, DISABLED] if start is READY else list(down[down.index(start) :]) \
            if start in down else [STOPPING, DISABLED]  # fmt: skip
        assert way == expected
    else:
        assert way[-1] is (STOPPING if start in (ENABLED, STOPPING) else DISABLED)


@pytest.mark.parametrize("goal", list(Goal))
def test_no_goal_resets_a_fault(goal: Goal) -> None:
    assert not any(controlword_towards(state, goal) & 0x80 for state in driver.State)


@pytest.mark.parametrize("before", [0x00, 0x02, 0x07, 0x0F, 0x80])
def test_a_fault_reset_is_one_rising_edge_however_long_the_fault_stays(before: int) -> None:
    words = [before]
    for _ in range(10):
        words.append(controlword_resetting(driver.State.FAULT, words[-1]))
    edges = [a for a, b in itertools.pairwise(words) if not a & 0x80 and b & 0x80]
    assert edges == ([] if before == 0x80 else [0x00])
    for state in driver.State:
        if state is not driver.State.FAULT:
            assert controlword_resetting(state, words[-1]) == 0x00
            assert controlword_resetting(state, before) == 0x00


def test_a_statusword_in_words_says_what_matters_and_its_number() -> None:
    assert driver.statusword_text(0x1237) == "operation enabled (statusword 1237h)"
    assert driver.statusword_text(0x3A37) == (
        "operation enabled, internal limit active, following error (statusword 3A37h)"
    )
    assert driver.statusword_text(0x0008) == (
        "fault, not controlled over the bus (remote, bit 9, is 0) (statusword 0008h)"
    )


# By random masters

ENABLING = (0x06, 0x07, 0x0F)
UNSHRUNK = (Phase.explicit, Phase.generate)
"""Shrinking a walk takes longer than reading it."""

SETTINGS = (
    (keys.MODE, (0, 1, 3, 6, 8, 9, 10)),
    (keys.QUICK_STOP_OPTION, range(9)),
    (keys.SHUTDOWN_OPTION, (0, 1)),
    (keys.DISABLE_OPTION, (0, 1)),
    (keys.FAULT_REACTION_OPTION, range(5)),
    (keys.ABORT_CONNECTION_OPTION, range(4)),
    (keys.INTERPOLATION_VALUE, range(1, 12)),
    (keys.HOMING_METHOD, (0, 35, 37)),
)


class Walk(RuleBasedStateMachine):
    """A drive, and what the table allows it to do since its state was last looked at."""

    def __init__(self) -> None:
        super().__init__()
        self.one = OneDrive()
        self.seen, self.word = NOT_READY, 0
        self.commands: set[Command] = set()
        self.events: set[State] = set()
        self.overruled = False
        self.unpowered = 0

    @initialize(enabled=st.booleans())
    def switch_on(self, enabled: bool) -> None:
        self.one.on()
        self.seen = DISABLED
        if enabled:
            self.one.enabled(CSP)
            self.seen, self.word = ENABLED, 0x0F

    def ways(self) -> set[State]:
        """States that a drive may be in by now: transitions by its commands and on its own."""
        found, new = {self.seen}, {self.seen}
        while new:
            new = {
                row.to
                for row in TABLE
                if (row.state in new or (row.state is None and row.to in self.events))
                and (row.command is None or row.command in self.commands)
            } - found
            found |= new
        return found

    @invariant()
    def moves_along_transitions_only(self) -> None:
        state = self.one.state
        assert state in self.ways(), f"{self.seen} to {state} by {self.commands} {self.events}"
        if state is not self.seen:
            self.commands, self.events = {command_in(self.word, self.word)}, set()
            self.seen = state

    def shows_its_state(self) -> None:
        state, status = self.one.state, self.one.status
        assert fits(status, STATUSWORDS[state])
        assert status & 0x0210 == 0x0210
        assert state_of(status) is drivers(state)

    @rule(words=st.permutations(WORDS))
    def write_controlwords(self, words: list[int]) -> None:
        for word in words[:6]:
            self.write_controlword(word)
            self.moves_along_transitions_only()
            self.pass_time(1, 4, True)
            self.moves_along_transitions_only()

    @rule()
    def enable(self) -> None:
        for word in (0x00, 0x80, 0x00, *ENABLING):
            self.write_controlword(word)
            self.moves_along_transitions_only()
            self.pass_time(20 if word == 0x00 else 1, 4, True)  # until it is on its brake
            self.one.registers[keys.TARGET_POSITION] = self.one.registers[keys.POSITION]
            self.moves_along_transitions_only()

    @rule(word=st.sampled_from(WORDS))
    def write_controlword(self, word: int) -> None:
        before, last, ramp = self.one.state, self.word, self.one.drive._power.stop is not None
        self.commands.add(command_in(word, last))
        self.word = word
        self.one.set(keys.CONTROLWORD, word)
        if self.one.state in POWERED:
            self.unpowered = 0
        self.shows_its_state()
        overrides = before is ENABLED and command_in(word) in (
            Command.QUICK_STOP,
            Command.DISABLE_VOLTAGE,
        )
        if (ramp and not overrides) or self.overruled or word == last:
            self.overruled = self.overruled and word == last
            return
        expected = after(before, word, last)
        option = self.one.registers[keys.QUICK_STOP_OPTION]
        if before is ENABLED and expected is STOPPING and not option:
            expected = DISABLED
            self.commands.add(Command.DISABLE_VOLTAGE)
        elif before is STOPPING and expected is ENABLED and option not in STAYS:
            expected = STOPPING
        elif before is ENABLED and expected in (READY, ON):
            option = keys.SHUTDOWN_OPTION if expected is READY else keys.DISABLE_OPTION
            expected = ENABLED if self.one.registers[option] else expected  # along a ramp first
        assert self.one.state is expected

    @rule(setting=st.sampled_from([(key, v) for key, values in SETTINGS for v in values]))
    def write_setting(self, setting: tuple[int, int]) -> None:
        self.one.set(*setting)

    @rule(near=st.floats(-0.05, 0.05), speed=st.floats(-1, 1), torque=st.integers(-100, 100))
    def write_targets(self, near: float, speed: float, torque: int) -> None:
        one = self.one
        target = one.registers[keys.POSITION] + round(near * one.counts)
        one.registers[keys.TARGET_POSITION] = target
        one.registers[keys.TARGET_VELOCITY] = round(speed * one.counts)
        one.registers[keys.TARGET_TORQUE] = torque

    @rule(what=st.sampled_from(("fault", "lost", "taken off", "reset", "restart", "deaf", "slip")))
    def upset(self, what: str) -> None:
        drive = self.one.drive
        if what != "deaf":
            self.events.add(REACTING)
        if what in ("lost", "taken off", "reset", "restart"):
            self.commands |= {Command.DISABLE_VOLTAGE, Command.QUICK_STOP}
            self.overruled = True
        match what:
            case "fault":
                drive.fault(0xFF01)
                assert self.one.state in (REACTING, FAULT)
            case "lost":
                drive.connection.lost(0x8130)
            case "taken off":
                drive.connection.taken_off()
            case "reset" | "restart":
                self.events.add(NOT_READY)
                drive.reset() if what == "reset" else drive.restart()
            case "deaf":
                drive.operation.deaf = not drive.operation.deaf
            case "slip" if drive.state in POWERED:
                drive.slip()

    @rule(count=st.sampled_from((1, 1, 2, 20, 60)), steps=st.integers(1, 11), synced=st.booleans())
    def pass_time(self, count: int, steps: int, synced: bool) -> None:
        """Current flows only with power, and the brake comes after it."""
        one = self.one
        self.events |= {REACTING, NOT_READY}  # following errors, SYNC that is lost, restarts
        self.commands.add(command_in(self.word, self.word))
        for _ in range(count):
            demand = one.cycles(1, synced=synced, steps=steps)
            self.unpowered = 0 if one.state in POWERED else self.unpowered + steps
            assert np.isfinite(demand.setpoints).all()
            if demand.braked:
                assert math.isnan(demand.torque)
            elif one.state not in POWERED and self.unpowered > steps:
                assert demand.torque == 0.0
            if self.unpowered > COASTING_STEPS + 2 * 12:
                assert demand.braked
                assert one.qd == 0.0
        self.shows_its_state()

    def teardown(self) -> None:
        """Any drive can be enabled again."""
        one = self.one
        one.drive.operation.deaf = False
        for key, value in ((keys.QUICK_STOP_OPTION, 2), (keys.MODE, 8)):
            one.set(key, value)
        one.tell(0x00, cycles=500)
        if one.state is REACTING:  # a set-point that jumped is braked from an impossible speed
            one.until(FAULT, most=20_000)
        one.q = 0.3  # wherever it ran to: inside its limits
        one.tell(0x80)
        assert one.state is DISABLED
        one.set(keys.TARGET_POSITION, one.registers[keys.POSITION])
        one.set(keys.POSITION_OFFSET, 0)
        for word in ENABLING:
            one.tell(word)
        assert one.state is ENABLED


TestWalk = Walk.TestCase
TestWalk.settings = settings(examples(20), phases=UNSHRUNK, stateful_step_count=30)


class Pair(RuleBasedStateMachine):
    """The driver and a drive: all goals are reached, a fault is left on request only."""

    def __init__(self) -> None:
        super().__init__()
        self.one = OneDrive().on()
        self.one.set(keys.MODE, CSP)
        self.goal, self.word = Goal.OFF, 0

    def cycle(self, word: int) -> None:
        self.word = word
        self.one.registers[keys.TARGET_POSITION] = self.one.registers[keys.POSITION]
        self.one.tell(word)

    @property
    def state(self) -> driver.State:
        return state_of(self.one.status)

    @rule(goal=st.sampled_from(Goal), cycles=st.integers(1, 12))
    def want(self, goal: Goal, cycles: int) -> None:
        self.goal = goal
        for _ in range(cycles):
            before = self.state
            self.cycle(controlword_towards(before, goal))
            assert MOCKS[before] is not FAULT or self.one.state is FAULT

    @rule()
    def fault(self) -> None:
        self.one.drive.fault(0xFF01)

    @rule()
    def restart(self) -> None:
        self.one.drive.restart()

    @rule()
    def reset(self) -> None:
        self.want(Goal.OFF, 1)  # the driver resets axes that it keeps off
        for _ in range(200):
            self.cycle(controlword_resetting(self.state, self.word))
            if self.one.state is DISABLED:
                break
        assert self.one.state is DISABLED

    @rule(goal=st.sampled_from(Goal))
    def wait_for(self, goal: Goal) -> None:
        faulted = self.one.state in (REACTING, FAULT)
        ends = {Goal.ENABLED: ENABLED, Goal.OFF: DISABLED, Goal.QUICK_STOP: DISABLED}
        end = FAULT if faulted else ends[goal]
        for _ in range(60):
            self.want(goal, 5)
            if self.one.state is end:
                break
        self.want(goal, 5)
        assert self.one.state is end


TestPair = Pair.TestCase
TestPair.settings = settings(examples(8), phases=UNSHRUNK, stateful_step_count=30)
