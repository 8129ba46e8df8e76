"""Ways to a bus: raw frames by a socket, and by any other python-can bus."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Iterator

import can
import pytest

from hil.can.frames import ERROR, pack_frame, unpack_frame
from hil.can.hub import hub_thread
from hil.core.errors import RobotConnectionError
from hil_drivers.cia402.can_channel import PythonCanPort, SocketPort, port_of
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
    assert port.wait(begin + 5.0)
    assert port.receive(begin + 5.0) == FRAME
    assert time.monotonic() - begin < 2.0


def test_full_transmit_queue_is_said_and_no_error(pair: tuple[SocketPort, socket.socket]) -> None:
    port, _ = pair
    assert not all(port.send(FRAME) for _ in range(100_000))


def test_bus_whose_host_has_ended_is_gone(pair: tuple[SocketPort, socket.socket]) -> None:
    port, theirs = pair
    theirs.close()
    with pytest.raises(RobotConnectionError, match=r"the CAN bus \(test\) is gone: its host"):
        port.receive(0.0)
    with pytest.raises(RobotConnectionError, match="is gone"):
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
