"""Objects of many drives asked for at once, and what is done when some do not answer."""

from __future__ import annotations

import time

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.commissioning import faults_left, part, unwatch
from hil_drivers.cia402.objects import Entry
from hil_drivers.cia402.session import Thermometer
from hil_mock_robot.cia402.keys import key
from tests.support.cia402_drives import drives
from tests.support.in_time import InTime, measured_again

WATCHED = 127 << 16 | 250
LONG_S = 5.0


def silence(line, *axes: int) -> None:
    """These drives take what they are told; nobody hears their SDO answers."""
    gone = {0x581 + axis for axis in axes}
    line.lost = lambda can_id, _: can_id in gone


def requests(line, index: int) -> list[tuple[int, bytes]]:
    head = index.to_bytes(2, "little")
    return [(i, d) for i, d in line.sent if i >> 7 == 0x600 >> 7 and d[1:3] == head]


def test_all_drives_are_asked_at_once_and_those_who_answer_are_told() -> None:
    with drives(3) as line:
        line.nodes[0].registers[key(0x6064)] = -5
        silence(line, 1)
        began = time.monotonic()
        assert line.master.upload_each(od.POSITION, range(3), 0.1).keys() == {0, 2}
        assert line.master.upload_each(od.POSITION, [0], LONG_S) == {0: -5}
        assert time.monotonic() - began < LONG_S / 2


def test_what_a_drive_refuses_is_neither_read_nor_written() -> None:
    with drives(2) as line:
        master = line.master
        assert master.upload_each(Entry("no_such", 0x5FFF, 3, "B"), [0], LONG_S) == {}
        assert master.download_each(od.STATUSWORD, 5, [0, 1], LONG_S) == []
        assert master.download_each(od.QUICK_STOP_OPTION, 6, [0, 1], LONG_S) == [0, 1]
        assert line.nodes[1].registers[key(0x605A)] == 6


def test_an_answer_that_nobody_waited_for_does_not_disturb_who_asks_next() -> None:
    with drives(1) as line:
        late: list[tuple[int, bytes]] = []
        line.lost = lambda *frame: not late.append(frame)
        line.master.upload_each(od.POSITION, [0])
        line.lost = lambda *_: False

        def first_the_late_one(can_id: int, data: bytes) -> bool:
            if late and can_id == 0x581:
                line.master.heard(*late.pop())
            return False

        line.lost = first_the_late_one
        line.sent.clear()
        assert line.master.upload(0, od.DEVICE_TYPE) == 0x0002_0192
        assert len(line.sent) == 1


@measured_again
def test_a_silent_drive_is_asked_for_its_temperature_without_waiting() -> None:
    with drives(2) as line:
        silence(line, 0, 1)
        thermometer = Thermometer(line.master, 0x2110)
        own = InTime()
        thermometer.look()
        own.require(0.05)
        assert [i for i, _ in requests(line, 0x2110)] == [0x601]


def test_drives_that_are_left_at_rest_watch_us_no_more() -> None:
    with drives(2) as line:
        for node in line.nodes:
            node.registers[key(0x1016, 1)] = WATCHED
        part(line.master)
        assert [node.registers[key(0x1016, 1)] for node in line.nodes] == [0, 0]
        assert requests(line, 0x6040) == []


def test_a_drive_that_may_still_move_is_told_to_stop_and_goes_on_watching_us() -> None:
    with drives(3) as line:
        for node in line.nodes:
            node.registers[key(0x1016, 1)] = WATCHED
        line.nodes[1].registers[key(0x6041)] = 0x1237
        silence(line, 2)
        part(line.master)
        assert requests(line, 0x6040) == [
            (0x602, b"\x2b\x40\x60\0\x02\0\0\0"),
            (0x603, b"\x2b\x40\x60\0\x02\0\0\0"),
        ]
        assert [n.registers[key(0x1016, 1)] for n in line.nodes] == [0, WATCHED, WATCHED]


def test_a_fault_is_judged_by_all_errors_that_were_not_seen_yet() -> None:
    with drives(1) as line:
        node = line.nodes[0]
        node.emergency(0x2310)
        node.emergency(0x8130)
        node.registers[key(0x6041)] = 0x0218
        (fault,) = faults_left(line.master)
        assert fault.codes == (0x8130, 0x2310)
        assert not fault.is_monitoring
        unwatch(line.master)
