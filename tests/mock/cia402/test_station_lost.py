"""What drives do when the network is taken from them: NMT commands, resets, bus off (6007h)."""

from __future__ import annotations

import pytest

from tests.support.can_station_parts import (
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Desk,
)

COMMUNICATION, BUS_OFF = 0x8100, 0x8140
FAULT_REACTION, DISABLE_VOLTAGE, QUICK_STOP = 1, 2, 3
LEAVING = [PRE_OPERATIONAL, STOP, RESET_COMMUNICATION, RESET_NODE]


def turning(option: int, node: int = 1) -> Desk:
    desk = Desk()
    desk.map(node)
    assert desk.write(node, 0x6007, 0, "h", option) == 0
    desk.enable(node)
    desk.turning(node)
    assert desk.speed[node - 1] > 0.8
    desk.sent.clear()
    return desk


@pytest.mark.parametrize("command", LEAVING)
def test_a_drive_that_is_taken_off_stops_quickly_along_its_ramp(command: int) -> None:
    desk = turning(QUICK_STOP)
    before = desk.speed[0]
    desk.command(command, 1)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"
    desk.sync(3)
    ramp = desk.read(1, 0x6085) if command != STOP else desk.unit(1).registers[0x6085 << 8]
    slower = before - ramp / desk.unit(1).drive._axis.counts * 3 * 0.004
    assert desk.speed[0] == pytest.approx(slower, abs=0.1)
    desk.sync(150)
    assert desk.state(1) == "SWITCH_ON_DISABLED"
    assert desk.speed[0] == pytest.approx(0.0, abs=1e-3)
    assert desk.emergencies(1) == []


@pytest.mark.parametrize("command", LEAVING)
def test_6007h_1_makes_it_a_fault_of_communication(command: int) -> None:
    desk = turning(FAULT_REACTION)
    desk.command(command, 1)
    assert desk.state(1) == "FAULT_REACTION_ACTIVE"
    assert desk.emergencies(1) == ([] if command == STOP else [COMMUNICATION])
    if command != RESET_NODE:
        desk.command(PRE_OPERATIONAL, 1)
        assert desk.read(1, 0x1003, 1) == desk.read(1, 0x603F) == COMMUNICATION
        assert desk.read(1, 0x1001) == 0x11
    desk.sync(150)
    assert desk.state(1) == ("SWITCH_ON_DISABLED" if command == RESET_NODE else "FAULT")


def test_6007h_0_lets_a_drive_that_is_taken_off_go_on() -> None:
    desk = turning(0)
    desk.command(PRE_OPERATIONAL, 1)
    desk.sync(10)
    assert desk.state(1) == "OPERATION_ENABLED"


def test_a_drive_that_never_was_operational_does_not_mind_to_be_preoperational() -> None:
    desk = Desk()
    for word in (0x06, 0x07, 0x0F):
        desk.write(1, 0x6040, 0, "H", word)
    desk.command(PRE_OPERATIONAL, 1)
    desk.wait(0.1)
    assert desk.state(1) == "OPERATION_ENABLED"
    desk.command(STOP, 1)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"


def test_a_drive_without_power_obeys_the_controlword_it_was_left_with() -> None:
    desk = Desk()
    desk.map(1)
    desk.rpdo(1, 0x06)
    desk.sync(3)
    desk.command(PRE_OPERATIONAL, 1)
    assert desk.state(1) == "READY_TO_SWITCH_ON"


def test_a_node_that_is_reset_in_motion_forgets_all_but_stops_first() -> None:
    desk = turning(QUICK_STOP)
    desk.command(RESET_NODE, 1)
    assert (0x701, b"\x00") in desk.sent
    assert desk.read(1, 0x6040) == 0
    desk.write(1, 0x6040, 0, "H", 0x06)
    desk.sync(2)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"
    desk.sync(150)
    assert desk.state(1) == "READY_TO_SWITCH_ON"


def test_a_node_that_is_reset_at_rest_has_started_anew_at_once() -> None:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    desk.sync(50)
    desk.command(RESET_NODE, 1)
    assert desk.state(1) == "NOT_READY_TO_SWITCH_ON"


@pytest.mark.parametrize("option", [FAULT_REACTION, QUICK_STOP])
def test_bus_off_is_told_when_the_drive_is_back(option: int) -> None:
    desk = turning(option)
    desk.mock.requests.answer({"do": "fault", "kind": "bus_off", "axis": 1})
    desk.sync(20)
    assert desk.emergencies(1) == []
    desk.mock.requests.answer({"do": "clear"})
    assert desk.emergencies(1)[0] == BUS_OFF
    assert desk.unit(1).node.nmt.state == "PRE-OPERATIONAL"  # 1029h:1 = 0
    assert desk.read(1, 0x1003) == 1
    assert desk.read(1, 0x1003, 1) == BUS_OFF
    in_fault = option == FAULT_REACTION
    assert desk.read(1, 0x1001) == (0x11 if in_fault else 0)
    desk.sync(150)
    assert desk.state(1) == ("FAULT" if in_fault else "SWITCH_ON_DISABLED")


def test_1029h_1_keeps_a_drive_operational_through_bus_off() -> None:
    desk = Desk()
    desk.write(1, 0x1029, 1, "B", 1)
    desk.command(START)
    desk.mock.requests.answer({"do": "fault", "kind": "bus_off", "axis": 1})
    assert desk.unit(1).node.nmt.state == "OPERATIONAL"


def test_an_injected_following_error_shows_where_it_is_looked_for() -> None:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    desk.mock.requests.answer({"do": "fault", "kind": "following_error", "axis": 1})
    desk.sync(2)
    assert desk.read(1, 0x6041) & 0x2000
    assert abs(desk.unit(1).registers[0x60F4 << 8]) > desk.read(1, 0x6065)
