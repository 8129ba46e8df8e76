"""Process data of the mock drive: mapping, when RPDOs are applied, when TPDOs are sent."""

from __future__ import annotations

import struct

import pytest

from hil_mock_robot.cia402.keys import key
from tests.support.can_node_parts import EMERGENCY, NODE, PRE_OPERATIONAL, START, SYNC, Bench

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


# PDO mapping of the mock drive: the procedure of CiA 301, and each way to do it wrong.


NO_OBJECT, NO_SUB_INDEX, RANGE, STATE = 0x0602_0000, 0x0609_0011, 0x0609_0030, 0x0800_0022
NOT_MAPPABLE, TOO_MANY_BITS, INCOMPATIBLE = 0x0604_0041, 0x0604_0042, 0x0604_0043
NOT_VALID, NO_RTR = 0x8000_0000, 0x4000_0000

MODE_DISPLAY, POSITION, VELOCITY = 0x6061_0008, 0x6064_0020, 0x606C_0020
TORQUE, CURRENT, TEMPERATURE = 0x6077_0010, 0x6078_0010, 0x2110_0010
MODE = 0x6060_0008


@pytest.fixture
def bench() -> Bench:
    return Bench()


def invalidated(bench: Bench, parameters: int, count: int | None = 0) -> None:
    """Steps 1 and 2 of the procedure."""
    bench.write(parameters, 1, bench.read(parameters, 1) | NOT_VALID, 4)
    if count is not None:
        bench.write(parameters + 0x200, 0, count, 1)


def test_the_procedure_lays_out_what_is_sent(bench):
    bench.map(1, [STATUSWORD, POSITION, MODE_DISPLAY], transmit=True)
    bench.map(2, [VELOCITY, TORQUE, CURRENT], transmit=True)
    bench.operational()
    bench.registers.update(
        {
            key(0x6041): 0x1237, key(0x6064): -2, key(0x6061): 8,
            key(0x606C): 7, key(0x6077): -1, key(0x6078): 3,
        }
    )  # fmt: skip
    bench.node.synced()
    assert bench.taken() == [
        (0x180 + NODE, bytes.fromhex("3712 feffffff 08")),
        (0x280 + NODE, bytes.fromhex("07000000 ffff 0300")),
    ]


def test_what_was_laid_out_is_read_back(bench):
    bench.map(2, [CONTROLWORD, MODE, TARGET], transmit=False)
    assert bench.read(0x1601, 0) == 3
    assert [bench.read(0x1601, sub) for sub in (1, 2, 3)] == [CONTROLWORD, MODE, TARGET]
    assert bench.read(0x1401, 1) == NO_RTR | 0x300 + NODE
    assert bench.read(0x1401, 2) == 1


@pytest.mark.parametrize("parameters", [0x1400, 0x1800])
@pytest.mark.parametrize(("sub", "size"), [(0, 1), (1, 4)])
def test_a_mapping_does_not_change_while_the_pdo_is_valid(bench, parameters, sub, size):
    assert bench.aborts(parameters + 0x200, sub, 0, size) == STATE


def test_entries_do_not_change_before_their_number_is_zero(bench):
    invalidated(bench, 0x1801, count=None)
    assert bench.aborts(0x1A01, 1, POSITION, 4) == STATE
    bench.write(0x1A01, 0, 0, 1)
    bench.write(0x1A01, 1, POSITION, 4)


def test_a_pdo_made_valid_too_early_takes_no_number_of_entries(bench):
    invalidated(bench, 0x1800)
    bench.write(0x1A00, 1, POSITION, 4)
    bench.write(0x1800, 1, NO_RTR | 0x180 + NODE, 4)
    assert bench.aborts(0x1A00, 0, 1, 1) == STATE


@pytest.mark.parametrize(
    ("parameters", "entry", "code"),
    [
        (0x1800, 0x6402_0010, NO_OBJECT),
        (0x1800, 0x6041_0110, NO_SUB_INDEX),
        (0x1800, 0x6075_0020, NOT_MAPPABLE),
        (0x1800, 0x2101_0010, NOT_MAPPABLE),
        (0x1400, 0x6064_0020, NOT_MAPPABLE),
        (0x1400, 0x6007_0010, NOT_MAPPABLE),
        (0x1800, 0x6064_0010, INCOMPATIBLE),
        (0x1400, 0x6040_0020, INCOMPATIBLE),
        (0x1800, 0x6064_0000, INCOMPATIBLE),
    ],
)
def test_what_cannot_be_mapped_is_refused_where_it_is_written(bench, parameters, entry, code):
    invalidated(bench, parameters)
    assert bench.aborts(parameters + 0x200, 1, entry, 4) == code


def test_more_than_eight_bytes_do_not_fit(bench):
    invalidated(bench, 0x1800)
    for sub, entry in enumerate((STATUSWORD, POSITION, TORQUE, MODE_DISPLAY), start=1):
        bench.write(0x1A00, sub, entry, 4)
    assert bench.aborts(0x1A00, 0, 4, 1) == TOO_MANY_BITS
    bench.write(0x1A00, 0, 3, 1)


def test_more_than_eight_entries_do_not_fit(bench):
    invalidated(bench, 0x1800)
    assert bench.aborts(0x1A00, 0, 9, 1) == TOO_MANY_BITS
    assert bench.aborts(0x1A00, 9, POSITION, 4) == NO_SUB_INDEX


def test_an_entry_that_was_not_written_cannot_be_counted(bench):
    invalidated(bench, 0x1800)
    bench.write(0x1A00, 1, POSITION, 4)
    bench.write(0x1A00, 2, 0, 4)
    assert bench.aborts(0x1A00, 0, 2, 1) == NOT_MAPPABLE


@pytest.mark.parametrize("type_", [241, 251, 252, 253])
def test_transmission_types_that_there_are_not_are_refused(bench, type_):
    assert bench.aborts(0x1800, 2, type_, 1) == RANGE


@pytest.mark.parametrize("type_", [0, 1, 240, 254, 255])
def test_transmission_types_that_there_are_are_taken(bench, type_):
    bench.write(0x1800, 2, type_, 1)
    assert bench.read(0x1800, 2) == type_


@pytest.mark.parametrize("cob_id", [0x000, 0x07F, 0x080, 0x180, 0x583, 0x603, 0x6E0, 0x703, 0x7FF])
def test_identifiers_of_other_services_are_refused(bench, cob_id):
    invalidated(bench, 0x1800, count=None)
    assert bench.aborts(0x1800, 1, NO_RTR | cob_id, 4) == RANGE


def test_extended_identifiers_are_refused(bench):
    invalidated(bench, 0x1800, count=None)
    assert bench.aborts(0x1800, 1, 0x2000_0000 | 0x181, 4) == RANGE
    assert bench.aborts(0x1800, 1, 0x0001_0181, 4) == RANGE


def test_the_identifier_does_not_change_while_the_pdo_is_valid(bench):
    assert bench.aborts(0x1800, 1, NO_RTR | 0x1A0, 4) == STATE
    invalidated(bench, 0x1800, count=None)
    bench.write(0x1800, 1, NO_RTR | 0x1A0, 4)
    bench.operational()
    bench.registers[key(0x6041)] = 1
    bench.node.ticked(0.001)
    assert [can_id for can_id, _ in bench.taken()] == [0x1A0]


def test_two_pdos_do_not_share_an_identifier(bench):
    assert bench.aborts(0x1801, 1, NO_RTR | 0x180 + NODE, 4) == INCOMPATIBLE


def test_the_inhibit_time_does_not_change_while_the_pdo_is_valid(bench):
    assert bench.aborts(0x1800, 3, 100, 2) == STATE
    invalidated(bench, 0x1800, count=None)
    bench.write(0x1800, 3, 100, 2)


@pytest.mark.parametrize(
    ("index", "sub", "value", "size"),
    [
        (0x1800, 1, NOT_VALID | NO_RTR | 0x183, 4), (0x1400, 2, 1, 1), (0x1801, 5, 10, 2),
        (0x1A01, 0, 0, 1), (0x1601, 1, TARGET, 4),
    ],
)  # fmt: skip
def test_nothing_of_it_changes_while_the_node_is_operational(bench, index, sub, value, size):
    invalidated(bench, 0x1401)
    bench.operational()
    assert bench.aborts(index, sub, value, size) == STATE
    bench.command(PRE_OPERATIONAL)
    bench.write(index, sub, value, size)


def test_a_pdo_that_is_not_valid_is_neither_sent_nor_heard(bench):
    invalidated(bench, 0x1800, count=None)
    invalidated(bench, 0x1400, count=None)
    bench.operational()
    bench.node.heard(0x200 + NODE, b"\x06\x00")
    bench.node.synced()
    bench.node.ticked(1.0)
    assert bench.taken() == []
    assert bench.registers[key(0x6040)] == 0


def test_a_pdo_without_entries_is_not_sent(bench):
    bench.map(1, [], transmit=True)
    bench.operational()
    bench.node.synced()
    assert bench.taken() == []


def test_vendor_objects_can_be_mapped(bench):
    bench.map(3, [TEMPERATURE], transmit=True)
    bench.operational()
    bench.registers[key(0x2110)] = -5
    bench.node.synced()
    assert bench.taken() == [(0x380 + NODE, b"\xfb\xff")]


def test_the_sync_identifier_is_the_predefined_one(bench):
    assert bench.read(0x1005) == SYNC


def test_a_dummy_is_passed_over_in_what_comes(bench):
    bench.map(2, [0x0005_0008, 0x0006_0010, TARGET], transmit=False)
    bench.operational()
    bench.node.heard(0x300 + NODE, bytes(3) + b"\x10\x00\x00\x00")
    bench.node.synced()
    assert bench.registers[key(0x607A)] == 0x10


def test_a_dummy_of_another_length_or_in_a_tpdo_cannot_be_mapped(bench):
    for index, entry in ((0x1401, 0x0005_0010), (0x1401, 0x0008_0020), (0x1801, 0x0005_0008)):
        invalidated(bench, index)
        assert bench.aborts(index + 0x200, 1, entry, 4) in (NO_OBJECT, INCOMPATIBLE)
