"""PDO mapping of the mock drive: the procedure of CiA 301, and each way to do it wrong."""

from __future__ import annotations

import pytest

from hil_mock_robot.cia402.keys import key
from tests.support.can_node_parts import NODE, PRE_OPERATIONAL, SYNC, Bench

NO_OBJECT, NO_SUB_INDEX, RANGE, STATE = 0x0602_0000, 0x0609_0011, 0x0609_0030, 0x0800_0022
NOT_MAPPABLE, TOO_LONG, INCOMPATIBLE = 0x0604_0041, 0x0604_0042, 0x0604_0043
NOT_VALID, NO_RTR = 0x8000_0000, 0x4000_0000

STATUSWORD, MODE_DISPLAY, POSITION, VELOCITY = 0x6041_0010, 0x6061_0008, 0x6064_0020, 0x606C_0020
TORQUE, CURRENT, TEMPERATURE = 0x6077_0010, 0x6078_0010, 0x2110_0010
CONTROLWORD, MODE, TARGET = 0x6040_0010, 0x6060_0008, 0x607A_0020


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
    assert bench.aborts(0x1A00, 0, 4, 1) == TOO_LONG
    bench.write(0x1A00, 0, 3, 1)


def test_more_than_eight_entries_do_not_fit(bench):
    invalidated(bench, 0x1800)
    assert bench.aborts(0x1A00, 0, 9, 1) == TOO_LONG
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
