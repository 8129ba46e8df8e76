"""Another master on the bus, two nodes with one id: found before and while the arm is driven."""

from __future__ import annotations

import itertools
import threading
import time

import can
import pytest

from hil.can.frames import pack_frame
from hil.core.errors import RobotConnectionError
from hil_drivers.cia402.can_bus import CanBus
from hil_drivers.cia402.can_channel import PythonCanPort
from hil_drivers.cia402.can_cycle import quick_stop_frames, require_no_master, stop_directly
from hil_drivers.cia402.options import Options, options_of
from tests.drivers.cia402.test_can_cyclic import Cycles, all_answers, tpdo1

NODES, MASTER = (3, 7), 127
ENABLE = b"\x0f\x00\x08\x00\x00\x00\x00"
_numbers = itertools.count(1)


class Heard:
    """A port on which these frames have come; nothing may be sent."""

    def __init__(self, *frames: bytes) -> None:
        self._frames = list(frames)

    def send(self, frame: bytes | memoryview) -> bool:
        raise AssertionError("somebody sent")

    def receive(self, until_s: float) -> bytes | None:
        if self._frames:
            return self._frames.pop(0)
        time.sleep(max(until_s - time.monotonic(), 0.0))
        return None

    def wait(self, until_s: float) -> bool:
        return bool(self._frames)


@pytest.mark.parametrize(
    ("frame", "called"),
    [
        (pack_frame(0x080, b""), r"SYNC \(080h\)"),
        (pack_frame(0x77F, b"\x05"), r"heartbeat of node 127, our own \(77Fh\)"),
        (pack_frame(0x203, bytes(7)), r"RPDO1 of node 3 \(203h\)"),
        (pack_frame(0x307, bytes(8)), r"RPDO2 of node 7 \(307h\)"),
        (pack_frame(0x403, bytes(8)), r"RPDO3 of node 3"),
        (pack_frame(0x507, bytes(8)), r"RPDO4 of node 7"),
    ],
)
def test_what_another_master_sends_is_named_and_refused(frame: bytes, called: str) -> None:
    with pytest.raises(RobotConnectionError, match=f"another master is on the bus: 2 × .*{called}"):
        require_no_master(Heard(frame, frame), NODES, MASTER, 0.01)


def test_drives_that_are_alone_and_other_nodes_are_no_master() -> None:
    frames = [pack_frame(0x703, b"\x7f"), pack_frame(0x183, bytes(7)), pack_frame(0x083, bytes(8))]
    foreign = [pack_frame(0x204, bytes(7)), pack_frame(0x77E, b"\x05"), pack_frame(0x583, bytes(8))]
    require_no_master(Heard(*frames, *foreign), NODES, MASTER, 0.01)


def station(channel: str) -> Options:
    return options_of({"bus": {"interface": "virtual", "channel": channel}}, "lab6")


def test_joining_a_bus_with_another_master_sends_nothing_and_says_so() -> None:
    channel, over = f"cia402-masters-{next(_numbers)}", threading.Event()
    sync = can.Message(arbitration_id=0x080, is_extended_id=False)
    with can.Bus(interface="virtual", channel=channel) as other:

        def another() -> None:
            while not over.wait(0.004):
                other.send(sync)

        thread = threading.Thread(target=another)
        thread.start()
        try:
            with pytest.raises(RobotConnectionError, match=r"another master.*SYNC \(080h\)"):
                CanBus(station(channel), [f"axis {n}" for n in range(6)])
        finally:
            over.set()
            thread.join()
        assert other.recv(0.0) is None


def test_own_frames_are_not_heard() -> None:
    channel = f"cia402-masters-{next(_numbers)}"
    with can.Bus(interface="virtual", channel=channel) as bus:
        port = PythonCanPort(bus)
        port.send(pack_frame(0x080, b""))
        require_no_master(port, NODES, MASTER, 0.01)


def driven(**options: object) -> Cycles:
    cycles = Cycles(**options)
    cycles.cycle(all_answers(0))
    cycles.cyclic.watch(True)
    return cycles


@pytest.mark.parametrize("can_id", [0x080, 0x203, 0x307])
def test_command_that_we_did_not_send_is_told_while_the_arm_is_driven(can_id: int) -> None:
    cycles = driven()
    cycles.idle(pack_frame(can_id, b"\x0f\x00"))
    assert "another master is on the bus" in cycles.news().bus_error


def test_quick_stop_from_outside_is_no_other_master() -> None:
    cycles = driven()
    for frame in quick_stop_frames(station("any")):
        cycles.idle(bytes(frame))
    assert not cycles.news().any
    cycles.idle(pack_frame(0x203, ENABLE))
    assert "another master" in cycles.news().bus_error


def doubled(cycles: Cycles, count: int) -> str:
    for k in range(count):
        cycles.cycle([*all_answers(k), tpdo1(3, k + 9)])
        cycles.idle()
    return cycles.news().bus_error


def test_answers_that_are_doubled_for_many_cycles_are_two_nodes_with_one_id() -> None:
    cycles = driven(late_cycles=10)
    assert doubled(cycles, 10) == ""
    assert doubled(cycles, 1) == "two nodes answer as node 3"


def test_answers_that_are_doubled_now_and_then_are_only_counted() -> None:
    cycles = driven(late_cycles=3)
    for k in range(20):
        assert doubled(cycles, 3) == ""
        cycles.cycle(all_answers(k))
    assert cycles.cyclic.counts.doubled == 60


def test_full_queue_is_an_error_after_late_cycles() -> None:
    cycles = driven(late_cycles=5)
    for k in range(6):
        assert cycles.news().bus_error == ""
        cycles.port.room = 1
        cycles.cycle(all_answers(k))
    assert "no room for our frames in more than 5 cycles" in cycles.news().bus_error


def test_quick_stop_from_outside_is_sent_three_times_with_a_pause() -> None:
    told = station(f"cia402-masters-{next(_numbers)}")
    with can.Bus(interface="virtual", channel=told.bus.channel) as drives:
        assert stop_directly(told)
        heard = [drives.recv(0.0) for _ in range(3 * 7)]
        assert drives.recv(0.0) is None
    syncs = [each for each in heard if each is not None and each.arbitration_id == 0x080]
    assert [heard.index(sync) for sync in syncs] == [6, 13, 20]
    assert all(b.timestamp - a.timestamp >= 0.002 for a, b in itertools.pairwise(syncs))
