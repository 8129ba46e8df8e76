"""Process data of the mock drive: when RPDOs are applied, when TPDOs are sent, what is wrong."""

from __future__ import annotations

import struct

import pytest

from hil_mock_robot.cia402.keys import key
from tests.support.can_node_parts import EMERGENCY, NODE, PRE_OPERATIONAL, START, Bench

STATUSWORD, CONTROLWORD, TARGET = 0x6041_0010, 0x6040_0010, 0x607A_0020
RPDO, TPDO = 0x200 + NODE, 0x180 + NODE
TOO_SHORT, TOO_LONG, TIMED_OUT = 0x8210, 0x8220, 0x8250


def command(controlword: int, target: int) -> bytes:
    return struct.pack("<Hi", controlword, target)


def sending(type_: int, **timers: int) -> Bench:
    """Operational, the statusword in TPDO1 of that type."""
    bench = Bench()
    for sub, value in {"inhibit": 3, "event": 5}.items():
        if sub in timers:
            bench.write(0x1800, 1, 0xC000_0180 + NODE, 4)
            bench.write(0x1800, value, timers[sub], 2)
    bench.map(1, [STATUSWORD], transmit=True, type_=type_)
    bench.operational()
    return bench


def receiving(type_: int, timeout_ms: int = 0) -> Bench:
    """Operational, controlword and target in RPDO1 of that type; no TPDO."""
    bench = Bench()
    bench.write(0x1400, 5, timeout_ms, 2)
    bench.map(1, [CONTROLWORD, TARGET], transmit=False, type_=type_)
    bench.map(1, [], transmit=True)
    bench.operational()
    return bench


def syncs_answered(bench: Bench, n: int) -> list[int]:
    """Which of so many SYNCs, from 1, a TPDO came after."""
    answered = []
    for sync in range(1, n + 1):
        bench.node.synced()
        answered += [sync] * len(bench.taken())
    return answered


@pytest.mark.parametrize(("type_", "expected"), [(1, [1, 2, 3, 4]), (2, [2, 4]), (3, [3])])
def test_a_cyclic_tpdo_is_sent_with_every_nth_sync(type_, expected):
    assert syncs_answered(sending(type_), 4) == expected


def test_the_slowest_cyclic_tpdo_is_sent_with_every_240th_sync():
    assert syncs_answered(sending(240), 500) == [240, 480]


def test_an_acyclic_tpdo_is_sent_with_the_sync_after_something_changed():
    bench = sending(0)
    assert syncs_answered(bench, 2) == [1]
    bench.registers[key(0x6041)] = 0x40
    bench.node.ticked(0.5)
    assert bench.taken() == []
    assert syncs_answered(bench, 2) == [1]


@pytest.mark.parametrize("type_", [254, 255])
def test_an_event_driven_tpdo_is_sent_when_something_changed_and_not_by_sync(type_):
    bench = sending(type_)
    assert syncs_answered(bench, 3) == []
    bench.node.ticked(0.01)
    assert bench.taken() == []
    bench.registers[key(0x6041)] = 0x40
    bench.node.ticked(0.02)
    assert bench.taken() == [(TPDO, b"\x40\x00")]


def test_an_event_driven_tpdo_is_sent_when_the_node_becomes_operational():
    bench = sending(255)
    bench.command(PRE_OPERATIONAL)
    bench.command(START)
    bench.node.ticked(0.001)
    assert bench.taken() == [(TPDO, b"\x00\x00")]


def times_sent(bench: Bench, until_ms: int, changing: bool) -> list[int]:
    sent = []
    for ms in range(1, until_ms + 1):
        bench.registers[key(0x6041)] = ms if changing else 0
        bench.node.ticked(ms / 1000)
        sent += [ms] * len(bench.taken())
    return sent


def test_the_event_timer_repeats_what_has_not_changed():
    assert times_sent(sending(255, event=10), 35, changing=False) == [10, 20, 30]


def test_the_inhibit_time_keeps_events_apart():
    assert times_sent(sending(255, inhibit=50), 16, changing=True) == [5, 10, 15]


@pytest.mark.parametrize("type_", [0, 1, 240])
def test_a_synchronous_rpdo_is_applied_with_the_next_sync(type_):
    bench = receiving(type_)
    bench.node.heard(RPDO, command(6, -100))
    assert bench.registers[key(0x607A)] == 0
    assert bench.told == []
    bench.node.synced()
    assert (bench.registers[key(0x6040)], bench.registers[key(0x607A)]) == (6, -100)
    assert bench.told == [("applied",)]


def test_of_two_rpdos_before_a_sync_the_last_counts():
    bench = receiving(1)
    bench.node.heard(RPDO, command(6, 1))
    bench.node.heard(RPDO, command(7, 2))
    bench.node.synced()
    assert bench.registers[key(0x607A)] == 2


def test_a_sync_without_rpdo_applies_nothing():
    bench = receiving(1)
    bench.node.heard(RPDO, command(6, 1))
    bench.node.synced()
    bench.registers[key(0x607A)] = 77
    bench.told.clear()
    bench.node.synced()
    assert bench.registers[key(0x607A)] == 77
    assert bench.told == []


@pytest.mark.parametrize("type_", [254, 255])
def test_an_asynchronous_rpdo_is_applied_at_once(type_):
    bench = receiving(type_)
    bench.node.heard(RPDO, command(15, 9))
    assert bench.registers[key(0x607A)] == 9
    assert bench.told == [("applied",)]


def test_tpdos_of_a_sync_show_what_its_rpdos_brought():
    bench = receiving(1)
    bench.command(PRE_OPERATIONAL)
    bench.map(2, [CONTROLWORD], transmit=True)
    bench.operational()
    bench.node.heard(RPDO, command(0x1234, 0))
    bench.node.synced()
    assert bench.taken() == [(0x280 + NODE, b"\x34\x12")]


def test_an_rpdo_that_came_while_the_node_was_not_operational_is_not_applied_later():
    bench = receiving(1)
    bench.node.heard(RPDO, command(6, 1))
    bench.command(PRE_OPERATIONAL)
    bench.node.heard(RPDO, command(6, 2))
    bench.node.synced()
    bench.command(START)
    bench.node.synced()
    assert bench.registers[key(0x607A)] == 0


def test_an_rpdo_that_is_too_short_is_an_error_and_not_applied():
    bench = receiving(1)
    bench.node.heard(RPDO, command(6, 1)[:5])
    bench.node.synced()
    assert bench.registers[key(0x607A)] == 0
    assert bench.taken() == [(EMERGENCY, struct.pack("<HB5x", TOO_SHORT, 0x11))]


def test_an_rpdo_that_is_too_long_is_an_error_and_its_beginning_applied():
    bench = receiving(1)
    bench.node.heard(RPDO, command(6, 1) + b"\xff")
    bench.node.synced()
    assert bench.registers[key(0x607A)] == 1
    assert bench.taken() == [(EMERGENCY, struct.pack("<HB5x", TOO_LONG, 0x11))]


def test_a_wrong_length_is_told_once_and_ends_with_an_rpdo_that_is_right():
    bench = receiving(1)
    for _ in range(3):
        bench.node.heard(RPDO, b"\x06")
    bench.node.heard(RPDO, command(6, 1))
    codes = [struct.unpack_from("<HB", data) for _, data in bench.taken()]
    assert codes == [(TOO_SHORT, 0x11), (0, 0)]


def test_an_rpdo_that_stays_away_is_told_after_its_timer():
    bench = receiving(1, timeout_ms=20)
    bench.node.ticked(5.0)
    assert bench.taken() == []
    bench.node.heard(RPDO, command(6, 1))
    bench.node.ticked(5.02)
    assert bench.taken() == []
    bench.node.ticked(5.021)
    assert [struct.unpack_from("<H", data)[0] for _, data in bench.taken()] == [TIMED_OUT]
    assert ("connection_lost", TIMED_OUT) in bench.told


def test_an_rpdo_in_time_is_not_missed():
    bench = receiving(1, timeout_ms=20)
    for ms in range(0, 200, 15):
        bench.node.heard(RPDO, command(6, ms))
        bench.node.ticked(ms / 1000)
    assert bench.taken() == []
