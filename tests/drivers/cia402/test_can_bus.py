"""The CAN bus of the driver: ports, frames with one call of the kernel, load."""

from __future__ import annotations

import errno
import itertools
import socket
import threading
import time
from collections.abc import Iterator

import can
import pytest

from hil.can.frames import ERROR, pack_frame, unpack_frame
from hil.can.hub import hub_thread
from hil.core.errors import RobotConnectionError, SpecError
from hil_drivers.cia402.can_channel import (
    MOST,
    PythonCanPort,
    SocketPort,
    cycle_lengths,
    load_of,
    most_rate_hz,
    port_of,
    receiving,
    require_room,
    sending,
)
from hil_drivers.cia402.mapping import ALL_MODES, MAPPINGS, MINIMAL, POSITION
from tests.support.in_time import InTime, measured_again

FRAME = pack_frame(0x181, b"\x01\x02\x03")
_numbers = itertools.count(1)


@pytest.fixture
def pair() -> Iterator[tuple[SocketPort, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    yield SocketPort(ours, "test"), theirs
    ours.close()
    theirs.close()


@pytest.fixture
def virtual() -> Iterator[tuple[PythonCanPort, can.BusABC]]:
    channel = f"cia402-ports-{next(_numbers)}"
    one, other = (can.Bus(interface="virtual", channel=channel) for _ in range(2))
    with one as ours, other as theirs:
        yield PythonCanPort(ours), theirs


def test_frames_pass_as_sixteen_bytes(pair: tuple[SocketPort, socket.socket]) -> None:
    port, theirs = pair
    assert port.send(memoryview(FRAME))
    assert theirs.recv(64) == FRAME
    theirs.send(FRAME)
    assert port.receive(0.0) == FRAME
    assert port.receive(0.0) is None


@measured_again
def test_receiving_waits_until_its_time_to_the_millisecond(
    pair: tuple[SocketPort, socket.socket],
) -> None:
    port, _ = pair
    asked = InTime()
    assert port.receive(asked.at + 0.0205) is None
    assert time.monotonic() - asked.at >= 0.0205
    asked.require(0.1)


def test_receiving_returns_when_a_frame_comes(pair: tuple[SocketPort, socket.socket]) -> None:
    port, theirs = pair
    threading.Timer(0.02, lambda: theirs.send(FRAME)).start()
    begin = time.monotonic()
    assert port.wait(begin + 200.0)
    assert port.receive(begin + 200.0) == FRAME
    assert time.monotonic() - begin < 100.0


def test_full_transmit_queue_is_said_and_no_error(pair: tuple[SocketPort, socket.socket]) -> None:
    port, _ = pair
    assert not all(port.send(FRAME) for _ in range(100_000))


def test_bus_whose_host_has_ended_is_gone(pair: tuple[SocketPort, socket.socket]) -> None:
    port, theirs = pair
    theirs.close()
    with pytest.raises(RobotConnectionError, match=r"the CAN bus \(test\) is lost: its host"):
        port.receive(0.0)
    with pytest.raises(RobotConnectionError, match="is lost"):
        port.send(FRAME)


def test_unix_bus_is_used_by_its_socket(tmp_path: object) -> None:
    channel = f"{tmp_path}/bus.sock"
    with hub_thread(channel), can.Bus(interface="hil_unix", channel=channel) as bus:
        assert isinstance(port_of(bus), SocketPort)


def test_other_buses_are_used_by_python_can(virtual: tuple[PythonCanPort, can.BusABC]) -> None:
    port, theirs = virtual
    assert isinstance(port_of(theirs), PythonCanPort)
    assert port.send(FRAME)
    message = theirs.recv(1.0)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (0x181, b"\x01\x02\x03")


def test_python_can_messages_come_as_sixteen_bytes(
    virtual: tuple[PythonCanPort, can.BusABC],
) -> None:
    port, theirs = virtual
    theirs.send(can.Message(arbitration_id=0x283, data=b"\x09\x08", is_extended_id=False))
    assert port.wait(time.monotonic() + 1.0)
    assert port.receive(0.0) == pack_frame(0x283, b"\x09\x08")
    assert port.receive(0.0) is None


def test_error_frames_of_python_can_are_error_frames(
    virtual: tuple[PythonCanPort, can.BusABC],
) -> None:
    port, theirs = virtual
    theirs.send(can.Message(is_error_frame=True, arbitration_id=0x40, is_extended_id=False))
    raw = port.receive(time.monotonic() + 1.0)
    assert raw is not None
    assert unpack_frame(raw).id == ERROR | 0x40


class Full:
    """A bus whose adapter has no room."""

    channel_info = "full"

    def send(self, message: can.Message, timeout: float) -> None:
        raise can.CanOperationError("Transmit buffer full")

    def recv(self, timeout: float) -> None:
        raise can.CanOperationError("unplugged")


def test_full_adapter_is_no_lost_bus_but_an_unplugged_one_is() -> None:
    port = PythonCanPort(Full())
    assert not port.send(FRAME)
    with pytest.raises(RobotConnectionError, match="unplugged"):
        port.receive(0.0)


# How full the bus is, against a table worked out beforehand: 47 + 8n bits, and stuffing.


MBIT = 1e6

# Six axes: frames of a cycle, bits without and with the worst stuffing, percent of 250 Hz, 1 Mbit.
TABLE = [
    (MINIMAL, 13, 1187, 1435, 30, 36),
    (POSITION, 19, 1949, 2365, 49, 59),
]


@pytest.mark.parametrize(("mapping", "frames", "nominal", "worst", "low", "high"), TABLE)
def test_six_axes_load_the_bus_as_worked_out(mapping, frames, nominal, worst, low, high):
    assert len(cycle_lengths(mapping, 6)) == frames
    cyclic = load_of(mapping, 6, 250.0, MBIT).cyclic
    assert cyclic.nominal * MBIT / 250 == pytest.approx(nominal)
    assert cyclic.worst * MBIT / 250 == pytest.approx(worst)
    assert (round(100 * cyclic.nominal), round(100 * cyclic.worst)) == (low, high)


def test_all_modes_are_25_frames_of_which_six_have_eight_bytes_more():
    # 47 + 6 × (103 + 111 + 103 + 111), 55 + 6 × (125 + 135 + 125 + 135)
    cyclic = load_of(ALL_MODES, 6, 1.0, 1.0).cyclic
    assert (cyclic.nominal, cyclic.worst) == (47 + 6 * 428, 55 + 6 * 520)


def test_beside_the_cycles_there_are_heartbeats_the_marker_and_sdo():
    beside = load_of(POSITION, 6, 250.0, MBIT).beside
    # 80 heartbeats of 55 to 65 bits, 10 markers of 95 to 115, 20 SDO frames of 111 to 135
    assert beside.nominal == pytest.approx((80 * 55 + 10 * 95 + 20 * 111) / MBIT)
    assert beside.worst == pytest.approx((80 * 65 + 10 * 115 + 20 * 135) / MBIT)


@pytest.mark.parametrize(
    ("mapping", "bitrate", "rate"),
    [
        (MINIMAL, 1e6, 500.0),
        (POSITION, 1e6, 1000 / 3),
        (ALL_MODES, 1e6, 250.0),
        (POSITION, 5e5, 1000 / 6),
        (ALL_MODES, 5e5, 125.0),
        (POSITION, 2e4, 0.0),
    ],
)
def test_the_largest_rate_that_fits(mapping, bitrate, rate):
    assert most_rate_hz(mapping, 6, bitrate) == pytest.approx(rate)
    if rate:
        assert load_of(mapping, 6, rate, bitrate).fits
        faster = 1000 / (1000 / rate - 1)
        assert not load_of(mapping, 6, faster, bitrate).fits


def test_what_does_not_fit_is_refused_with_the_rate_and_the_mapping_that_do():
    with pytest.raises(SpecError, match="500 Hz with mapping position do not fit") as caught:
        require_room("position", 6, 500.0, MBIT, MAPPINGS)
    assert "97% of the bus, 118% with worst-case" in caught.value.message
    assert "rate_hz 333.333 is the largest" in caught.value.hint
    assert "500 Hz fit with mapping minimal" in caught.value.hint


def test_a_kilohertz_fits_with_no_mapping():
    for name in MAPPINGS:
        with pytest.raises(SpecError) as caught:
            require_room(name, 6, 1000.0, MBIT, MAPPINGS)
        assert "with mapping" not in caught.value.hint


def test_on_a_slow_bus_heartbeats_count_too():
    # At 20 kbit/s they alone take 45 % at worst.
    slow = load_of(MINIMAL, 1, 20.0, 2e4)
    assert slow.cyclic.worst <= 0.8
    assert slow.total.worst > slow.cyclic.worst + 0.25
    busy = load_of(MINIMAL, 1, 50.0, 2e4)
    assert busy.cyclic.worst <= 0.8
    assert not busy.fits


# Frames of a cycle with one call of the kernel: what is on the bus is the same as one by one.


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
    with pytest.raises(RobotConnectionError, match="is lost"):
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
@measured_again
def test_room_is_not_waited_for_longer_than_told(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.can.bursts._send_many", None)
    line = NarrowLine(room=3, again_s=1e9)
    port = SocketPort(line, "test")  # type: ignore[arg-type]
    frames = [bytearray(frame) for frame in FRAMES]
    asked = InTime()
    went = sending(port if kind == "socket" else OneByOne(port), frames)(asked.at + 0.01)
    assert not went
    assert time.monotonic() - asked.at >= 0.01
    asked.require(1.0)
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
