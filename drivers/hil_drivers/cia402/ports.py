"""Ways to a CAN bus for the cyclic core: raw 16-byte frames in and out (`hil.can.frame`)."""

from __future__ import annotations

import select
import socket
import time
from typing import Any, Protocol

from hil.can import ERROR, EXTENDED, FRAME, FULL, ID_MASK, REMOTE
from hil.core import RobotConnectionError

AGAIN_S = 1e-4
"""From one try to the next where the transmit queue is full [s]."""

_NOW = socket.MSG_DONTWAIT


class FramePort(Protocol):
    """One end of a bus."""

    def send(self, frame: bytes | memoryview) -> bool:
        """Put a frame on the bus; False when there is no room for it.

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def receive(self, until_s: float) -> bytes | None:
        """The next frame; None when there is none until that `time.monotonic` (0: right now).

        Raises:
            RobotConnectionError: The bus is gone.
        """

    def wait(self, until_s: float) -> bool:
        """Whether there is something to receive, at the latest at that `time.monotonic`."""


def send_within(port: FramePort, frame: bytes | memoryview, until_s: float) -> bool:
    """Put a frame on the bus, again and again where there is no room, until that `monotonic`.

    SocketCAN's queue has room for ten frames where nobody has made it longer: a cycle has more,
    and each takes 0.13 ms on the wire at 1 Mbit/s.
    """
    while not port.send(frame):
        if time.monotonic() >= until_s:
            return False
        time.sleep(AGAIN_S)
    return True


class SocketPort:
    """A socket whose packets are frames: `UnixBus` and SocketCAN.

    Nothing of it is changed: whoever else uses it may go on.

    Args:
        line: The socket.
        name: Of the bus, for messages.

    Attributes:
        line: As given.
    """

    def __init__(self, line: socket.socket, name: str) -> None:
        self.line = line
        self._send, self._recv = line.send, line.recv
        self._lines, self._name = [line], name

    def send(self, frame: bytes | memoryview) -> bool:
        """See `FramePort`."""
        try:
            self._send(frame, _NOW)
        except OSError as error:
            if error.errno in FULL:
                return False
            raise self.gone(error.strerror or str(error)) from error
        return True

    def receive(self, until_s: float) -> bytes | None:
        """See `FramePort`."""
        try:
            raw = self._recv(FRAME.size, _NOW)
        except BlockingIOError:
            return self.receive(0.0) if until_s and self.wait(until_s) else None
        except OSError as error:
            raise self.gone(error.strerror or str(error)) from error
        if not raw:
            raise self.gone("its host has ended, or frames were not taken fast enough")
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        # select() counts in microseconds; poll and socket time-outs in milliseconds.
        wait_s = until_s - time.monotonic()
        return bool(select.select(self._lines, (), (), wait_s if wait_s > 0.0 else 0.0)[0])

    def gone(self, why: str) -> RobotConnectionError:
        """What to raise when the bus is not there any more."""
        return _gone(self._name, why)


class PythonCanPort:
    """Any other `python-can` bus.

    Args:
        bus: Of `python-can`; nobody else receives from it.
    """

    def __init__(self, bus: Any) -> None:
        import can

        self._bus, self._error, self._message = bus, can.CanError, can.Message
        self._next: bytes | None = None

    def send(self, frame: bytes | memoryview) -> bool:
        """See `FramePort`."""
        can_id, length, data = FRAME.unpack(frame)
        message = self._message(
            arbitration_id=can_id & ID_MASK, is_extended_id=False, data=data[:length]
        )
        try:
            self._bus.send(message, timeout=0)
        except (self._error, OSError) as error:
            if _is_full(error):
                return False
            raise self._gone(error) from error
        return True

    def receive(self, until_s: float) -> bytes | None:
        """See `FramePort`."""
        if self._next is None:
            self.wait(until_s)
        raw, self._next = self._next, None
        return raw

    def wait(self, until_s: float) -> bool:
        """See `FramePort`."""
        if self._next is None:
            try:
                message = self._bus.recv(max(until_s - time.monotonic(), 0.0))
            except (self._error, OSError) as error:
                raise self._gone(error) from error
            self._next = None if message is None else _raw(message)
        return self._next is not None

    def _gone(self, error: Exception) -> RobotConnectionError:
        return _gone(str(self._bus.channel_info), str(error))


def port_of(bus: Any) -> FramePort:
    """The port of a `python-can` bus: its own socket where it has one that carries raw frames."""
    line = getattr(bus, "socket", None)
    if isinstance(line, socket.socket) and _carries_frames(line):
        return SocketPort(line, str(bus.channel_info))
    return PythonCanPort(bus)


def _carries_frames(line: socket.socket) -> bool:
    if line.family == getattr(socket, "AF_CAN", None):
        return line.type == socket.SOCK_RAW
    return line.family == socket.AF_UNIX and line.type == socket.SOCK_SEQPACKET


def _raw(message: Any) -> bytes:
    flags = EXTENDED * message.is_extended_id | REMOTE * message.is_remote_frame
    flags |= ERROR * message.is_error_frame
    data = bytes(message.data or b"")[:8]
    return FRAME.pack(message.arbitration_id | flags, min(message.dlc, 8), data)


def _is_full(error: Exception) -> bool:
    code = getattr(error, "error_code", None) or getattr(error, "errno", None)
    return code in FULL or "full" in str(error).lower()


def _gone(name: str, why: str) -> RobotConnectionError:
    return RobotConnectionError(
        f"the CAN bus ({name}) is gone: {why}",
        hint="see to adapter, cable and power (mock drives: is `hil mock can` running?), "
        "then connect again",
    )
