"""EMCY of the mock drive, its error register and its history of errors."""

from __future__ import annotations

import struct

import canopen
import pytest

from tests.support.can_node_parts import EMERGENCY, STOP, Bench

OVERCURRENT, OVERVOLTAGE, FOLLOWING = 0x2310, 0x3210, 0x8611
NO_DATA = 0x0800_0024


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.taken()
    return made


def emergencies(bench: Bench) -> list[tuple[int, int]]:
    return [struct.unpack_from("<HB", data) for can_id, data in bench.taken()
            if can_id == EMERGENCY]  # fmt: skip


def history(bench: Bench) -> list[int]:
    return [bench.read(0x1003, sub) for sub in range(1, bench.read(0x1003) + 1)]


@pytest.mark.parametrize(
    ("code", "register"),
    [
        (0x1000, 0x01), (OVERCURRENT, 0x03), (0x2320, 0x03), (OVERVOLTAGE, 0x05), (0x3220, 0x05),
        (0x4310, 0x09), (0x5000, 0x01), (0x6320, 0x01), (0x7305, 0x21), (0x8130, 0x11),
        (0x8210, 0x11), (0x8250, 0x11), (0x8700, 0x21), (FOLLOWING, 0x21), (0x8400, 0x21),
        (0x7121, 0x21), (0xFF01, 0x81),
    ],
)  # fmt: skip
def test_an_error_sets_the_bits_of_its_kind(bench, code, register):
    bench.node.emergency(code)
    assert emergencies(bench) == [(code, register)]
    assert bench.read(0x1001) == register
    assert bench.read(0x603F) == code


def test_the_message_has_eight_bytes_with_the_makers_own(bench):
    bench.node.emergency(OVERCURRENT, data=b"abc")
    assert bench.taken() == [(EMERGENCY, b"\x10\x23\x03abc\x00\x00")]


def test_who_reports_an_error_may_say_what_it_sets(bench):
    bench.node.emergency(OVERCURRENT, 0x20)
    assert emergencies(bench) == [(OVERCURRENT, 0x21)]


def test_an_error_that_is_there_is_not_told_again(bench):
    bench.node.emergency(OVERCURRENT)
    bench.node.emergency(OVERCURRENT)
    assert len(emergencies(bench)) == 1
    assert history(bench) == [OVERCURRENT]


def test_errors_add_up_in_the_register_and_go_one_by_one(bench):
    bench.node.emergency(OVERCURRENT)
    bench.node.emergency(OVERVOLTAGE)
    bench.node.recovered(OVERCURRENT)
    bench.node.recovered(OVERVOLTAGE)
    assert emergencies(bench) == [(OVERCURRENT, 3), (OVERVOLTAGE, 7), (0, 5), (0, 0)]


def test_code_0_says_that_nothing_is_wrong_any_more(bench):
    bench.node.emergency(OVERCURRENT)
    bench.node.emergency(OVERVOLTAGE)
    bench.taken()
    bench.node.emergency(0)
    assert emergencies(bench) == [(0, 0)]
    assert bench.read(0x1001) == 0


def test_nothing_is_told_when_nothing_was_wrong(bench):
    bench.node.emergency(0)
    bench.node.recovered(OVERCURRENT)
    assert emergencies(bench) == []


def test_an_error_may_come_again_once_it_was_gone(bench):
    for code in (FOLLOWING, 0, FOLLOWING):
        bench.node.emergency(code)
    assert emergencies(bench) == [(FOLLOWING, 0x21), (0, 0), (FOLLOWING, 0x21)]


def test_the_history_has_the_newest_first_and_eight_at_most(bench):
    codes = [0xFF00 + i for i in range(10)]
    for code in codes:
        bench.node.emergency(code)
    assert history(bench) == codes[:1:-1]


def test_writing_0_to_its_number_clears_the_history(bench):
    bench.node.emergency(OVERCURRENT)
    bench.write(0x1003, 0, 0, 1)
    assert bench.read(0x1003) == 0
    assert bench.read(0x1001) == 3
    bench.node.emergency(OVERVOLTAGE)
    assert history(bench) == [OVERVOLTAGE]


def test_the_history_has_no_data_beyond_its_number(bench):
    bench.node.emergency(OVERCURRENT)
    assert bench.read(0x1003, 1) == OVERCURRENT
    for sub in (2, 8):
        with pytest.raises(canopen.SdoAbortedError) as refused:
            bench.read(0x1003, sub)
        assert refused.value.code == NO_DATA


def test_a_stopped_node_sends_no_emergency_but_keeps_the_error(bench):
    bench.command(STOP)
    bench.node.emergency(OVERCURRENT)
    assert emergencies(bench) == []
    assert bench.node.errors.active == (OVERCURRENT,)


def test_1014h_switches_emergencies_off_and_gives_them_another_identifier(bench):
    bench.write(0x1014, 0, 0x8000_0000 | EMERGENCY, 4)
    bench.node.emergency(OVERCURRENT)
    assert bench.taken() == []
    bench.write(0x1014, 0, 0x0F0, 4)
    bench.node.emergency(OVERVOLTAGE)
    assert [can_id for can_id, _ in bench.taken()] == [0x0F0]


def test_a_simulated_error_is_told(bench):
    bench.write(0x2101, 0, FOLLOWING, 2)
    assert emergencies(bench) == [(FOLLOWING, 0x21)]
    assert bench.aborts(0x2101, 0, 0, 2) == 0x0609_0030


def test_a_lost_heartbeat_is_over_when_it_comes_back_unless_the_drive_is_in_fault(bench):
    bench.write(0x1016, 1, 127 << 16 | 100, 4)
    for statusword, ends in ((0x0640, True), (0x0618, False)):
        bench.registers[0x6041 << 8] = statusword
        at_s = 10.0 + statusword
        bench.node.ticked(at_s)
        bench.node.heard(0x77F, b"\x05")
        bench.node.ticked(at_s + 0.2)
        bench.node.heard(0x77F, b"\x05")
        assert emergencies(bench) == [(0x8130, 0x11)] + [(0, 0)] * ends


def test_canopens_own_consumer_follows_errors_and_their_end(bench):
    bench.node.emergency(FOLLOWING)
    assert [error.code for error in bench.remote.emcy.active] == [FOLLOWING]
    bench.node.emergency(0)
    assert bench.remote.emcy.active == []
