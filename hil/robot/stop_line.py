"""Asking a driver's process to stop the arm: from any thread, and from a signal handler."""

from __future__ import annotations

import contextlib
import itertools
import select
import socket
import time

_LOOK_EVERY_S = 0.005
_TOKEN_BYTES = 8
_PACKET_BYTES = 1 << 16


class StopLine:
    """One end of a line of packets. Nothing in here waits for a lock.

    A handler runs in the middle of what the main thread does, which may be a stop: a lock that it
    holds would never be freed. Instead, every stop has a token of its own, packets are whole or
    not there, and whoever receives the answer to another's stop puts it where the other looks.

    Args:
        end: Connected packet socket; the line owns it.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end = end
        self._tokens = itertools.count()
        self._answers: dict[bytes, bytes] = {}

    def ask(self, within_s: float) -> bytes | None:
        """Ask for a stop; returns what was answered, None when nothing was in time.

        Raises:
            OSError: Nobody is there.
        """
        token = next(self._tokens).to_bytes(_TOKEN_BYTES, "little")
        until = time.monotonic() + within_s
        # A full line means that stops wait there already.
        with contextlib.suppress(BlockingIOError):
            self._end.send(token)
        poll = select.poll()
        poll.register(self._end, select.POLLIN)
        while token not in self._answers:
            if time.monotonic() > until:
                return None
            if poll.poll(_LOOK_EVERY_S * 1000):
                self._receive()
        return self._answers.pop(token)

    def close(self) -> None:
        """The other side sees the end, and stops the arm."""
        self._end.close()

    def _receive(self) -> None:
        with contextlib.suppress(BlockingIOError):
            packet = self._end.recv(_PACKET_BYTES)
            if not packet:
                raise BrokenPipeError("the line has ended")
            self._answers[packet[:_TOKEN_BYTES]] = packet[_TOKEN_BYTES:]
