"""Drives of one mock hear each other on the bus, as nodes on a wire do."""

from __future__ import annotations

import struct

from tests.support.can_station_parts import START, Desk

HEARTBEAT_LOST = 0x8130


def test_a_drive_watches_the_heartbeat_of_another_one() -> None:
    desk = Desk()
    desk.write(2, 0x1017, 0, "H", 50)
    desk.write(1, 0x1016, 1, "I", 2 << 16 | 250)
    desk.sync(200)
    assert desk.emergencies(1) == []
    desk.mock.requests.answer({"do": "fault", "kind": "heartbeat_loss", "axis": 2})
    desk.sync(100)
    assert desk.emergencies(1) == [HEARTBEAT_LOST]


def test_a_tpdo_of_one_drive_may_be_an_rpdo_of_another() -> None:
    desk = Desk()
    target, position = 0x607A_0020, 0x6064_0020
    for node, index, cob_id, entry in ((2, 0x1802, 0x382, position), (5, 0x1402, 0x382, target)):
        for step in (
            (index, 1, "I", cob_id | 1 << 31), (index + 0x200, 0, "B", 0),
            (index + 0x200, 1, "I", entry), (index + 0x200, 0, "B", 1), (index, 2, "B", 1),
            (index, 1, "I", cob_id),
        ):  # fmt: skip
            assert desk.write(node, *step) == 0
    desk.command(START)
    desk.sync(2)
    sent = [data for can_id, data in desk.sent if can_id == 0x382]
    assert desk.unit(5).registers[0x607A << 8] == struct.unpack("<i", sent[0])[0] != 0


def test_a_drive_does_not_hear_itself() -> None:
    desk = Desk()
    desk.write(1, 0x1017, 0, "H", 50)
    desk.write(1, 0x1016, 1, "I", 1 << 16 | 250)
    desk.sync(100)
    desk.write(1, 0x1017, 0, "H", 0)
    desk.sync(100)
    assert desk.emergencies(1) == []


def test_a_drive_that_is_off_the_bus_hears_nobody() -> None:
    desk = Desk()
    desk.write(2, 0x1017, 0, "H", 50)
    desk.write(1, 0x1016, 1, "I", 2 << 16 | 250)
    desk.sync(50)
    desk.mock.requests.answer({"do": "fault", "kind": "bus_off", "axis": 1})
    desk.sync(100)
    assert desk.read_registers(1, 0x1003, 1) == HEARTBEAT_LOST
