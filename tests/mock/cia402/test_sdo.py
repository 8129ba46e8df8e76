"""Objects of the mock drive by SDO: every abort code, what a write does, when nothing answers."""

from __future__ import annotations

import random
import struct

import canopen
import pytest

from hil_mock_robot.cia402.keys import key
from tests.support.can_node_parts import NODE, STOP, Bench

NO_OBJECT, NO_SUB_INDEX = 0x0602_0000, 0x0609_0011
WRITE_ONLY, READ_ONLY = 0x0601_0001, 0x0601_0002
LENGTH, RANGE, STATE, INCOMPATIBLE = 0x0607_0010, 0x0609_0030, 0x0800_0022, 0x0604_0043
UNKNOWN_COMMAND = 0x0504_0001
ENABLED, SWITCHED_ON, QUICK_STOP = 0x0627, 0x0623, 0x0607


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(
    ("index", "sub", "code"),
    [
        (0x2000, 0, NO_OBJECT), (0x6402, 0, NO_OBJECT), (0x0005, 0, NO_OBJECT),
        (0x1018, 5, NO_SUB_INDEX), (0x1016, 3, NO_SUB_INDEX), (0x6041, 1, NO_SUB_INDEX),
        (0x607D, 200, NO_SUB_INDEX), (0x1800, 4, NO_SUB_INDEX), (0x2101, 0, WRITE_ONLY),
    ],
)  # fmt: skip
def test_what_cannot_be_read_says_why(bench, index, sub, code):
    with pytest.raises(canopen.SdoAbortedError) as caught:
        bench.remote.sdo.upload(index, sub)
    assert caught.value.code == code


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x2000, 0, 0, 4, NO_OBJECT),
        (0x6091, 3, 1, 4, NO_SUB_INDEX),
        (0x6041, 0, 0, 2, READ_ONLY),
        (0x6502, 0, 0, 4, READ_ONLY),
        (0x1018, 0, 4, 1, READ_ONLY),
        (0x1008, 0, 0x41, 1, READ_ONLY),
        (0x6040, 0, 6, 1, LENGTH),
        (0x6040, 0, 6, 4, LENGTH),
        (0x607A, 0, 1, 2, LENGTH),
        (0x607A, 0, 1, 8, LENGTH),
        (0x6060, 0, 3, 1, RANGE),
        (0x6060, 0, -1, 1, RANGE),
        (0x6007, 0, 4, 2, RANGE),
        (0x605A, 0, 9, 2, RANGE),
        (0x605E, 0, -1, 2, RANGE),
        (0x6072, 0, 2101, 2, RANGE),
        (0x60C2, 1, 0, 1, RANGE),
        (0x60C2, 2, 1, 1, RANGE),
        (0x60C2, 2, -7, 1, RANGE),
        (0x6091, 1, 0, 4, RANGE),
        (0x6065, 0, 0, 4, RANGE),
        (0x1005, 0, 0x4000_0080, 4, RANGE),
        (0x1003, 0, 1, 1, RANGE),
        (0x1029, 1, 3, 1, RANGE),
        (0x1014, 0, 0x581, 4, RANGE),
        (0x1014, 0, 0x2000_0083, 4, RANGE),
        (0x1014, 0, 0x181 + 0x100, 4, STATE),
        (0x1016, 1, 0x0100_0000, 4, RANGE),
        (0x2101, 0, 0, 2, RANGE),
    ],
)
def test_what_cannot_be_written_says_why_and_changes_nothing(
    bench, index, sub, value, size, code
):  # fmt: skip
    before = dict(bench.registers)
    assert bench.aborts(index, sub, value, size) == code
    assert bench.registers == before
    assert not bench.told


@pytest.mark.parametrize("value", [-0.5, 101.0, float("nan"), float("inf")])
def test_a_payload_that_cannot_be_is_refused(bench, value):
    with pytest.raises(canopen.SdoAbortedError) as caught:
        bench.remote.sdo.download(0x2100, 1, struct.pack("<f", value))
    assert caught.value.code == RANGE


def test_the_payload_is_kept_as_real_numbers(bench):
    for sub, value in enumerate((2.5, 0.01, -0.02, 0.125), start=1):
        bench.remote.sdo.download(0x2100, sub, struct.pack("<f", value))
    read = [struct.unpack("<f", bench.remote.sdo.upload(0x2100, sub))[0] for sub in (1, 2, 3, 4)]
    assert read == [2.5, pytest.approx(0.01), pytest.approx(-0.02), 0.125]


@pytest.mark.parametrize("statusword", [ENABLED, QUICK_STOP])
@pytest.mark.parametrize(
    ("index", "sub", "value", "size"),
    [
        (0x6091, 1, 100, 4), (0x608F, 1, 4096, 4), (0x607E, 0, 0x80, 1), (0x605A, 0, 2, 2),
        (0x6007, 0, 1, 2), (0x60C2, 1, 8, 1), (0x607D, 1, -1000, 4), (0x6076, 0, 1000, 4),
    ],
)  # fmt: skip
def test_what_must_not_change_while_the_drive_works_is_refused_until_it_rests(
    bench, statusword, index, sub, value, size
):
    bench.registers[key(0x6041)] = statusword
    assert bench.aborts(index, sub, value, size) == STATE
    bench.registers[key(0x6041)] = SWITCHED_ON
    bench.write(index, sub, value, size)
    assert bench.registers[key(index, sub)] == value


def test_set_points_and_torque_limits_can_be_written_while_the_drive_works(bench):
    bench.registers[key(0x6041)] = ENABLED
    bench.write(0x607A, 0, -12345, 4)
    bench.write(0x6072, 0, 500, 2)
    assert bench.registers[key(0x607A)] == -12345
    assert bench.registers[key(0x6072)] == 500


def test_the_drive_is_told_of_each_write_after_it_is_there(bench):
    seen = []
    bench.node.hooks.written = lambda where, value: seen.append(
        (where, value, bench.registers[where])
    )
    bench.write(0x6040, 0, 0x0F, 2)
    bench.write(0x60B2, 0, -7, 2)
    assert seen == [(key(0x6040), 15, 15), (key(0x60B2), -7, -7)]


def test_what_the_drive_measures_is_read_as_it_is_now(bench):
    bench.registers[key(0x6064)] = -987654
    assert bench.remote.sdo[0x6064].raw == -987654
    bench.registers[key(0x6064)] = 5
    assert bench.remote.sdo[0x6064].raw == 5


def test_long_objects_come_in_segments(bench):
    assert bench.remote.sdo[0x1008].raw == "HIL mock drive"


def test_an_abort_names_the_object_that_was_asked_for_last(bench):
    answers = []
    bench.network.subscribe(0x580 + NODE, lambda _, data, __: answers.append(bytes(data)))
    bench.read(0x1018, 1)
    bench.node.heard(0x600 + NODE, bytes.fromhex("2181600008000000"))
    assert answers[-1] == bytes.fromhex("80816000") + LENGTH.to_bytes(4, "little")


def test_a_block_upload_is_answered_by_an_ordinary_one(bench):
    request = struct.pack("<BHBBBH", 0xA4, 0x1000, 0, 127, 0, 0)
    answers = []
    bench.network.subscribe(0x580 + NODE, lambda _, data, __: answers.append(bytes(data)))
    bench.node.heard(0x600 + NODE, request)
    assert answers == [bytes.fromhex("43001000 92010200")]


def test_a_frame_that_is_no_sdo_request_is_passed_over(bench):
    answers = []
    bench.network.subscribe(0x580 + NODE, lambda _, data, __: answers.append(bytes(data)))
    bench.node.heard(0x600 + NODE, b"\x40\x00\x10")
    assert answers == []


@pytest.mark.parametrize("request_", ["e0", "60", "00"])
def test_a_request_out_of_place_is_aborted_and_the_next_one_served(bench, request_):
    answers = []
    bench.network.subscribe(0x580 + NODE, lambda _, data, __: answers.append(bytes(data)))
    bench.node.heard(0x600 + NODE, bytes.fromhex(request_).ljust(8, b"\x00"))
    assert answers[-1][0] == 0x80
    assert bench.read(0x1000) == 0x20192


def test_a_node_boots_before_it_answers_and_a_stopped_one_does_not(bench):
    bench.command(STOP)
    with pytest.raises(canopen.SdoCommunicationError):
        bench.read(0x1000)
    off = Bench(boot_s=0.2)
    with pytest.raises(canopen.SdoCommunicationError):
        off.read(0x1000)


def test_a_heartbeat_is_watched_by_one_entry_only(bench):
    bench.write(0x1016, 1, 127 << 16 | 250, 4)
    assert bench.aborts(0x1016, 2, 127 << 16 | 100, 4) == INCOMPATIBLE
    bench.write(0x1016, 2, 126 << 16 | 100, 4)
    bench.write(0x1016, 1, 127 << 16 | 300, 4)


def test_an_error_simulated_by_sdo_is_one(bench):
    bench.write(0x2101, 0, 0x2310, 2)
    assert bench.read(0x603F) == 0x2310


def test_no_frame_makes_the_node_stumble(bench, caplog):
    draw = random.Random(402)
    firsts = [0x40, 0x60, 0x70, 0x00, 0x01, 0x10, 0x21, 0x23, 0x2B, 0x2F, 0x22, 0x80, 0xA0, 0xC0]
    indices = [0x1000, 0x1008, 0x1021, 0x1600, 0x1A00, 0x6040, 0x607A, 0x2100, 0x5555]
    for _ in range(5000):
        index = draw.choice(indices)
        data = struct.pack("<BHB", draw.choice(firsts), index, draw.randrange(4)) + draw.randbytes(
            4
        )
        bench.node.heard(0x600 + NODE, data)
    assert [record.getMessage() for record in caplog.records if record.exc_info] == []
    assert bench.read(0x1000) == 0x20192


def answers_to(bench, *requests):
    answers = []
    bench.network.subscribe(0x580 + NODE, lambda _, data, __: answers.append(bytes(data)))
    for request in requests:
        bench.node.heard(0x600 + NODE, bytes.fromhex(request).ljust(8, b"\x00"))
    return answers


def code_of(answer):
    assert answer[0] == 0x80, answer.hex()
    return int.from_bytes(answer[4:], "little")


@pytest.mark.parametrize("segment", ["0101020304", "0701020304", "60", "70"])
def test_a_segment_without_a_transfer_is_an_unknown_command(bench, caplog, segment):
    assert code_of(answers_to(bench, segment)[-1]) == UNKNOWN_COMMAND
    assert not [record for record in caplog.records if record.exc_info]


def test_a_transfer_that_is_over_takes_no_further_segment(bench):
    answers = answers_to(bench, "217a600004", "0711020304")
    assert [answer[0] for answer in answers] == [0x60, 0x20]
    bench.registers[key(0x607A)] = 7
    assert code_of(answers_to(bench, "1f")[-1]) == UNKNOWN_COMMAND
    assert bench.registers[key(0x607A)] == 7


def test_an_upload_that_is_over_gives_no_further_segment(bench):
    answers = answers_to(bench, "40081000", "60", "70", "60")
    assert [answer[0] for answer in answers[:3]] == [0x41, 0x00, 0x11]
    assert code_of(answers[3]) == UNKNOWN_COMMAND


@pytest.mark.parametrize("announced", ["08", "03"])
def test_a_length_that_cannot_be_is_refused_when_it_is_announced(bench, announced):
    assert code_of(answers_to(bench, "217a6000" + announced)[-1]) == LENGTH


@pytest.mark.parametrize(
    ("value", "index"),
    [(4, -3), (255, -3), (40, -4), (1, 0), (100, -2), (200, -5)],
)
def test_a_period_of_whole_milliseconds_is_taken(bench, value, index):
    bench.write(0x60C2, 1, value, 1)
    bench.write(0x60C2, 2, index, 1)
    bench.write(0x1006, 0, 12_000, 4)


def test_a_period_that_is_no_whole_number_of_milliseconds_is_refused(bench):
    bench.write(0x60C2, 1, 25, 1)
    assert bench.aborts(0x60C2, 2, -4, 1) == RANGE
    bench.write(0x60C2, 1, 40, 1)
    bench.write(0x60C2, 2, -4, 1)
    assert bench.aborts(0x60C2, 1, 25, 1) == RANGE
    assert bench.aborts(0x1006, 0, 2500, 4) == RANGE


def test_a_period_of_more_than_a_second_is_refused(bench):
    bench.write(0x60C2, 1, 11, 1)
    assert bench.aborts(0x60C2, 2, -1, 1) == RANGE
    assert bench.aborts(0x1006, 0, 1_001_000, 4) == RANGE
