"""One participant of a bus between processes, as its hub sees it."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections import deque

from hil.canbus.frame import FRAME

MOST_WAITING = 65_536
"""Frames that wait for one who does not read; it is hung up on beyond that."""

_UCRED = struct.Struct("3i")


class Peer:
    """A participant.

    Args:
        connection: To it.

    Attributes:
        socket, fd: To it.
        pid: Of its process.
        off: It is off the bus: nothing passes to or from it.
        deaf: It has gone, or was given up; what it has sent before still counts.
        waiting: Frames that its socket had no room for.
        dropped: Frames it wanted to send and its transmit queue had no room for.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.socket, self.fd = connection, connection.fileno()
        self.pid = _pid_of(connection)
        self.off = self.deaf = False
        self.waiting: deque[bytes] = deque()
        self.dropped = 0

    def batch(self, most: int) -> tuple[list[bytes], bool]:
        """The next frames it has sent, and whether that was all and it has gone."""
        frames: list[bytes] = []
        try:
            while len(frames) < most and (raw := self.read()) is not None:
                frames.append(raw)
        except OSError:
            return frames, True
        return frames, False

    def read(self) -> bytes | None:
        """The next frame it has sent, `None` when there is none yet.

        Raises:
            OSError: It has hung up, or does not speak in frames.
        """
        try:
            raw = self.socket.recv(FRAME.size + 1)
        except BlockingIOError:
            return None
        except ConnectionResetError:  # said once, and before the frames it has sent
            return self.read()
        if len(raw) != FRAME.size:
            raise ConnectionError("hung up" if not raw else f"sent {len(raw)} bytes, no frame")
        return raw

    def give(self, raw: bytes) -> bool:
        """Let it have a frame; whether its socket took all there was.

        Raises:
            OSError: It has hung up, or too much waits for it.
        """
        if not self.waiting:
            with contextlib.suppress(BlockingIOError):
                self.socket.send(raw)
                return True
        if len(self.waiting) >= MOST_WAITING:
            raise ConnectionError(f"does not read: {MOST_WAITING} frames wait for it")
        self.waiting.append(raw)
        return False

    def flush(self) -> bool:
        """Send what waits; whether all of it went. Raises `OSError` as `give`."""
        waiting = self.waiting
        with contextlib.suppress(BlockingIOError):
            while waiting:
                self.socket.send(waiting[0])
                waiting.popleft()
        return not waiting


def _pid_of(connection: socket.socket) -> int:
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size)
    pid: int = _UCRED.unpack(raw)[0]
    return pid
