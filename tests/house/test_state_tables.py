"""The tables of states in the docstrings of modules say what the code does."""

from __future__ import annotations

import itertools
import re
from types import ModuleType

import pytest

from hil.engine import engine
from hil_drivers.cia402 import axis
from hil_mock_robot.cia402 import power
from hil_mock_robot.ur import modes


def tables(module: ModuleType) -> list[list[list[str]]]:
    """Tables of a module's docstring: rows of cells, without the heads."""
    assert module.__doc__ is not None
    blocks = re.findall(r"(?:^\|.*\n)+", module.__doc__, re.MULTILINE)
    rows = [[line.strip("|").split("|") for line in block.splitlines()[2:]] for block in blocks]
    return [[[cell.strip() for cell in row] for row in table] for table in rows]


def test_the_runs_table_has_every_edge_of_the_engine() -> None:
    (rows,) = tables(engine)
    edges = set()
    for state, _, to in rows:
        before = {row[0] for row in rows[: rows.index([state, _, to])]}
        edges |= {(one, to) for one in (before if state == "all above" else {state})}
    assert edges == {(a.name, b.name) for a, to in engine.TRANSITIONS.items() for b in to}


def test_the_table_of_cia_402_has_every_transition_of_the_mock_drive() -> None:
    (rows,) = tables(power)
    names = {state: state.name.lower().replace("_", " ") for state in power.State}
    names[power.State.NOT_READY_TO_SWITCH_ON] = "not ready"
    said = {
        (state, word, to)
        for state, event, to in rows
        for word in [command.value for command in power.Command if command.value in event]
    }
    done = set()
    for state, command, stays in itertools.product(power.State, power.Command, (False, True)):
        if found := power.commanded(state, command, stays_stopped=stays):
            done.add((names[state], command.value, names[found[1]]))
    # With 605Ah = 0 a quick stop ends where its ramp would have led.
    done.add(("operation enabled", "quick stop", "switch on disabled"))
    assert said == done
    alone = {(names[a], names[b]) for a, b in power.EVENTS.values() if a is not None}
    assert alone <= {(state, to) for state, _, to in rows}


@pytest.mark.parametrize(("goal", "column"), [(axis.Goal.ENABLED, 1), (axis.Goal.OFF, 2)])
def test_the_table_of_controlwords_is_what_the_driver_sends(goal: axis.Goal, column: int) -> None:
    (rows,) = tables(axis)
    words = {row[0]: int(row[column][:2], 16) for row in rows}
    words[axis.State.UNKNOWN.value] = words.pop("none of CiA 402")
    assert words == {s.value: axis.controlword_towards(s, goal) for s in axis.State}


def test_the_tables_of_the_ur_controller_have_every_transition_of_its_modes() -> None:
    _, rows = tables(modes)
    numbers = {str(mode.name): int(mode) for mode in modes.SafetyMode}
    everything = set(numbers.values())
    groups = {
        "1 to 5": {1, 2, 3, 4, 5},
        "any": everything,
        "ROBOT_, SYSTEM_EMERGENCY_STOP": {6, 7},
        "any but these two": everything - {6, 7},
        "PROTECTIVE_STOP for 5 s": {3},
    }
    said = {
        event: (groups.get(safety) or {numbers[name] for name in safety.split(", ")}, numbers[to])
        for safety, event, to in rows
    }
    changes = [row for row in modes.TRANSITIONS if row.becomes is not None]
    assert said == {
        row.cause: (set(map(int, row.safety)), int(row.becomes or 0)) for row in changes
    }


def test_the_robot_modes_that_follow_are_those_of_the_table() -> None:
    rows, _ = tables(modes)
    said = set()
    for robot, events, then in rows:
        path = tuple(re.findall(r"[A-Z_]{4,}", then))
        safe = "*" in events
        for event in events.strip(" *").replace(" (both)", ", system emergency stop").split(", "):
            said.add((robot, event, safe, path))
    done = set()
    for row in modes.TRANSITIONS:
        if row.path:
            path = tuple(mode.name for mode, _ in row.path if mode is not None)
            robot = "any" if row.robot == modes.ANY else row.robot[0].name
            done.add((robot, row.cause, row.safety == modes.SAFE, path))
    assert said == done
