"""Frames of a cycle with one call of the kernel: what is on the bus is the same as one by one."""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from hil.can.frames import pack_frame
from hil.core.errors import RobotConnectionError
from hil_drivers.cia402.can_channel import MOST, SocketPort, receiving, sending

FRAMES = [pack_frame(0x80, b"")] + [pack_frame(0x200 + n, bytes([n] * n)) for n in range(1, 7)]


class OneByOne:
    """A port that is no socket."""

    def __init__(self, port: SocketPort) -> None:
        self._port = port

    def send(self, frame: bytes | memoryview) -> bool:
        return self._port.send(frame)

    def receive(self, until_s: float) -> bytes | None:
        return self._port.receive(until_s)

    def wait(self, until_s: float) -> bool:
        return self._port.wait(until_s)


Ends = tuple[socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield ours, theirs


@pytest.fixture(params=["socket", "other"])
def port(request: pytest.FixtureRequest, ends: Ends) -> SocketPort | OneByOne:
    by_socket = SocketPort(ends[0], "test")
    return by_socket if request.param == "socket" else OneByOne(by_socket)


def test_all_frames_of_a_burst_go_out_in_order(port: SocketPort, ends: Ends) -> None:
    assert sending(port, [bytearray(frame) for frame in FRAMES])(0.0)
    assert [ends[1].recv(17) for _ in FRAMES] == FRAMES


def test_a_burst_sends_what_its_memory_holds_then(port: SocketPort, ends: Ends) -> None:
    memory = bytearray(32)
    send = sending(port, [memoryview(memory)[:16], memoryview(memory)[16:]])
    memory[:] = FRAMES[1] + FRAMES[2]
    assert send(0.0)
    assert [ends[1].recv(17), ends[1].recv(17)] == FRAMES[1:3]


def test_a_burst_for_which_there_is_no_room_says_so(port: SocketPort, ends: Ends) -> None:
    send = sending(port, [bytearray(frame) for frame in FRAMES])
    went = [send(0.0) for _ in range(1000)]
    assert went[0]
    assert not went[-1]


def test_room_that_is_made_again_is_used(port: SocketPort, ends: Ends) -> None:
    send = sending(port, [bytearray(frame) for frame in FRAMES])
    while send(0.0):
        pass
    drain = receiving(SocketPort(ends[1], "other end"))
    while drain():
        pass
    assert send(0.0)


def test_a_burst_to_a_bus_that_is_gone_says_so(port: SocketPort, ends: Ends) -> None:
    ends[1].close()
    with pytest.raises(RobotConnectionError, match="is gone"):
        sending(port, [bytearray(FRAMES[0])])(0.0)


def test_all_frames_that_have_come_are_taken_in_order(port: SocketPort, ends: Ends) -> None:
    for frame in FRAMES:
        ends[1].send(frame)
    assert list(receiving(port)()) == FRAMES


def test_nothing_is_taken_while_nothing_has_come(port: SocketPort) -> None:
    assert not receiving(port)()


def test_frames_taken_are_not_changed_by_those_that_follow(port: SocketPort, ends: Ends) -> None:
    take = receiving(port)
    ends[1].send(FRAMES[1])
    first = take()
    ends[1].send(FRAMES[2])
    take()
    assert list(first) == [FRAMES[1]]


def test_more_than_are_taken_at_once_are_taken_next(port: SocketPort, ends: Ends) -> None:
    ends[1].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    take, sent = receiving(port), [pack_frame(0x181, bytes([n])) for n in range(MOST + 5)]
    for frame in sent:
        ends[1].send(frame)
    assert [*take(), *take()] == sent


def test_what_came_before_the_end_of_the_bus_is_taken(ends: Ends) -> None:
    take = receiving(SocketPort(ends[0], "test"))
    for frame in FRAMES:
        ends[1].send(frame)
    ends[1].close()
    assert list(take()) == FRAMES
    with pytest.raises(RobotConnectionError, match="its host has ended"):
        take()


class NarrowLine:
    """A socket as SocketCAN's: ENOBUFS where its queue is full, room again as time passes."""

    def __init__(self, room: int, again_s: float) -> None:
        self.sent: list[bytes] = []
        self._room, self._again_s, self._since = room, again_s, time.monotonic()

    def send(self, frame: bytes, flags: int) -> int:
        passed = int((time.monotonic() - self._since) / self._again_s)
        if len(self.sent) >= self._room + passed:
            raise OSError(errno.ENOBUFS, "No buffer space available")
        self.sent.append(bytes(frame))
        return 16

    def recv(self, size: int, flags: int) -> bytes:
        raise BlockingIOError


@pytest.mark.parametrize("kind", ["socket", "other"])
def test_what_finds_no_room_goes_out_in_order_when_there_is_room_again(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.can.bursts._send_many", None)
    line = NarrowLine(room=3, again_s=0.001)
    port = SocketPort(line, "test")  # type: ignore[arg-type]
    frames = [bytearray(frame) for frame in FRAMES]
    send = sending(port if kind == "socket" else OneByOne(port), frames)
    assert send(time.monotonic() + 5.0)
    assert line.sent == FRAMES


@pytest.mark.parametrize("kind", ["socket", "other"])
def test_room_is_not_waited_for_longer_than_told(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.can.bursts._send_many", None)
    line = NarrowLine(room=3, again_s=1e9)
    port = SocketPort(line, "test")  # type: ignore[arg-type]
    frames = [bytearray(frame) for frame in FRAMES]
    begin = time.monotonic()
    went = sending(port if kind == "socket" else OneByOne(port), frames)(begin + 0.01)
    assert not went
    assert 0.01 <= time.monotonic() - begin < 1.0
    assert line.sent == FRAMES[:3]


def test_rest_of_a_burst_follows_by_one_call_of_the_kernel(ends: Ends) -> None:
    number = 2000
    frames = [bytearray(pack_frame(0x201, k.to_bytes(4, "little"))) for k in range(number)]
    send = sending(SocketPort(ends[0], "test"), frames)
    got: list[bytes] = []

    def take() -> None:
        while len(got) < number:
            got.append(ends[1].recv(17))

    thread = threading.Thread(target=take)
    threading.Timer(0.02, thread.start).start()
    assert send(time.monotonic() + 20.0)
    time.sleep(0.05)
    thread.join(20.0)
    assert got == [bytes(frame) for frame in frames]
