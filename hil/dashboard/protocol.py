"""Limits that uvicorn lacks: how long a request may take to arrive, and how many may be arriving.

A connection that sends a byte now and then costs an attacker nothing. Each pending request has a
deadline, which further bytes do not extend. Beyond the limit the oldest pending connection is
closed, so that a Stop request is always accepted. A long answer, such as a stream of events, has
no deadline as long as the client reads it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from dataclasses import dataclass
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

UNSENT_BYTES = 128 * 1024
"""What the kernel takes of an answer beyond what it can send at once."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Limits:
    """What a connection may take.

    Attributes:
        headers_s: From the first byte of a request (or from connecting) to the end of its
            headers [s].
        body_s: From there to the end of its body [s].
        unread_s: Longest time in which a client reads nothing of an answer [s].
        arriving: Connections whose request is not whole, at the same time.
    """

    headers_s: float = 10.0
    body_s: float = 20.0
    unread_s: float = 30.0
    arriving: int = 128


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 with limits; see `Limits`.

    Attributes:
        arriving: `headers` or `body` while a request is not whole, else empty.
        since: Since when [s, monotonic].
    """

    limits = Limits()

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.arriving = ""
        self.since = 0.0
        self._deadline: asyncio.TimerHandle | None = None
        self._unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request, in the place of the oldest if there are too many."""
        super().connection_made(transport)
        # Bytes in the kernel's buffer, megabytes of them, would hide that a slow reader reads.
        if (connection := transport.get_extra_info("socket")) is not None:
            with contextlib.suppress(OSError, AttributeError):  # not everywhere
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        self._set_arriving("headers")
        others = [one for one in self.connections if isinstance(one, LimitedProtocol)]
        arriving = [one for one in others if one.arriving]
        if len(arriving) > self.limits.arriving:
            min(arriving, key=lambda one: one.since).drop(_TOO_MANY)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the deadlines."""
        self._set_arriving("")
        self.resume_writing()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what has arrived, and see what is missing."""
        super().data_received(data)
        self._look(begun=True)

    def on_response_complete(self) -> None:
        """Wait for the next request; for its first byte as long as uvicorn does."""
        super().on_response_complete()
        self._look(begun=bool(self.conn.trailing_data[0]))

    def pause_writing(self) -> None:
        """Wait for the reader as long as it reads at all."""
        super().pause_writing()
        self._wait_for_reader()

    def _wait_for_reader(self, before: int | None = None) -> None:
        """Close the connection if none of the answer was read since there were `before` bytes."""
        left = self.transport.get_write_buffer_size()
        if before is not None and left >= before:
            limit_s = self.limits.unread_s
            self.drop(f"a connection was closed: an answer was not read for {limit_s:g} s")
            return
        self._unread = self.loop.call_later(self.limits.unread_s, self._wait_for_reader, left)

    def resume_writing(self) -> None:
        """Go on writing."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _unsupported_upgrade_warning(self) -> None:
        """Say nothing: the guard refuses what is not HTTP, once it knows who asks."""

    def _look(self, *, begun: bool) -> None:
        state = self.conn.their_state
        waits = begun and state is h11.IDLE
        self._set_arriving("body" if state is h11.SEND_BODY else "headers" if waits else "")

    def _set_arriving(self, part: str) -> None:
        if part == self.arriving:
            return
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
        self.arriving, self.since = part, time.monotonic()
        if part:
            limit_s = self.limits.headers_s if part == "headers" else self.limits.body_s
            message = (
                f"a connection was closed: the {part} of a request took longer than {limit_s:g} s"
            )
            self._deadline = self.loop.call_later(limit_s, self.drop, message)

    def drop(self, why: str) -> None:
        """Close the connection, and log why."""
        if self.transport.is_closing():
            return
        _LOG.warning(why)
        if self.arriving == "headers":  # nothing has been answered yet
            self.transport.write(_TOO_SLOW)
            self.transport.close()
        else:
            self.transport.abort()


_TOO_MANY = "a connection was closed: too many requests were arriving"
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
