"""One participant of a bus between processes, as its hub sees it."""

from __future__ import annotations

import socket
import struct
from collections import deque
from itertools import islice

from hil.can.bursts import MOST, Burst, Catch
from hil.can.frame import FRAME

BATCH = 32
"""Frames taken from one participant before the others have their turn."""

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
        waiting: Frames for it that are not in its socket yet.
        full: Its socket had no room for all of them.
        dropped: Frames it wanted to send and its transmit queue had no room for.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.socket, self.fd = connection, connection.fileno()
        self.pid = _pid_of(connection)
        self.off = self.deaf = self.full = False
        self.waiting: deque[bytes] = deque()
        self.dropped = 0
        self._catch = Catch(BATCH)
        self._memory = bytearray(MOST * FRAME.size)
        view = memoryview(self._memory)
        self._burst = Burst([view[at : at + FRAME.size] for at in range(0, len(view), FRAME.size)])

    def batch(self) -> tuple[list[bytes], bool]:
        """The next frames it has sent, at most `BATCH`; or that it has gone, and sent no more."""
        try:
            return self._catch.take(self.socket), False
        except OSError:
            return [], True

    def flush(self) -> None:
        """Send what waits, as far as its socket has room; `full` says whether some is left.

        Raises:
            OSError: It has hung up.
        """
        waiting, burst, memory = self.waiting, self._burst, self._memory
        self.full = False
        while waiting and not self.full:
            frames = b"".join(islice(waiting, MOST))
            memory[: len(frames)] = frames
            wanted = len(frames) // FRAME.size
            sent = burst.send(self.socket, wanted)
            self.full = sent < wanted
            for _ in range(sent):
                waiting.popleft()


def _pid_of(connection: socket.socket) -> int:
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size)
    pid: int = _UCRED.unpack(raw)[0]
    return pid
