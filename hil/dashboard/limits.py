"""Limits that keep Stop reachable, whatever else clients ask or fail to send.

- `LimitedProtocol`: how long a request may take to arrive, and how many may be arriving. uvicorn
  has no such limit, and a connection that sends a byte now and then costs an attacker nothing. Each
  pending request has a deadline, which further bytes do not extend; beyond the limit the oldest
  pending connection is closed. A long answer, such as a stream of events, has no deadline as long
  as the client reads it.
- `StreamLimit`: how many streams of events are open. Each holds a connection and a file.
- `in_thread`: how many threads wait for runs, starts and streams. Each kind has its own, so that
  sixty slow starts leave a thread for Stop.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, ParamSpec, TypeVar

import h11
from anyio import CapacityLimiter, to_thread
from anyio.lowlevel import RunVar
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

_LOG = logging.getLogger(__name__)

UNSENT_BYTES = 128 * 1024
"""What the kernel takes of an answer beyond what it can send at once."""

_TOO_MANY = "a connection was closed: too many requests were arriving"
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a connection.

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
        """Take what has arrived, and note which part of the request is missing."""
        super().data_received(data)
        self._update(begun=True)

    def on_response_complete(self) -> None:
        """Wait for the next request; for its first byte as long as uvicorn does."""
        super().on_response_complete()
        self._update(begun=bool(self.conn.trailing_data[0]))

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

    def _update(self, *, begun: bool) -> None:
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


MOST_STREAMS = 64
"""Open at the same time. A browser has one, and asks again later if it is refused."""


class StreamLimit:
    """ASGI middleware that refuses further streams of events; pages and forms always pass.

    Args:
        app: The application behind it.
        most: Streams that may be open at the same time.
    """

    def __init__(self, app: ASGIApp, most: int = MOST_STREAMS) -> None:
        self._app, self._most, self._open = app, most, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer that too many streams are open."""
        if scope["type"] != "http" or not _is_stream(scope):
            await self._app(scope, receive, send)
            return
        full = self._open >= self._most
        if scope["method"] == "HEAD":  # a page asks why: a browser hides it from scripts
            await PlainTextResponse("", 503 if full else 204)(scope, receive, send)
            return
        if full:
            text = f"{self._most} pages listen already: close some, or reload this one for news\n"
            await PlainTextResponse(text, 503, {"Retry-After": "10"})(scope, receive, send)
            return
        self._open += 1
        try:
            await _complete(self._app, scope, receive, send)
        finally:
            self._open -= 1


def _is_stream(scope: Scope) -> bool:
    path = str(scope["path"])
    return scope["method"] in ("GET", "HEAD") and path.endswith("/events")


async def _complete(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer to the end: a stream that the dashboard's end cuts off has no last message."""
    unfinished = False

    async def noting(message: Message) -> None:
        nonlocal unfinished
        unfinished = message["type"] == "http.response.start" or message.get("more_body", False)
        await send(message)

    await app(scope, receive, noting)
    if unfinished:
        await send({"type": "http.response.body", "body": b"", "more_body": False})


P = ParamSpec("P")
T = TypeVar("T")

Kind = Literal["control", "start", "stream"]

THREADS: dict[Kind, int] = {"control": 16, "start": 8, "stream": 8}
"""Threads of a kind. Control may wait for a run that has just begun; pages have those of anyio."""

_limiters: RunVar[dict[Kind, CapacityLimiter]] = RunVar("hil_limiters")


async def in_thread(kind: Kind, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function that reads the disk or waits, on a thread of a kind.

    Args:
        kind: `control` for what is asked of a run, `start` for what starts or resumes one,
            `stream` for streams of events.
        function: What is called.
        *args: Its arguments.
        **kwargs: Its arguments by name.
    """
    try:
        limiters = _limiters.get()
    except LookupError:  # the first call in this event loop
        limiters = {each: CapacityLimiter(most) for each, most in THREADS.items()}
        _limiters.set(limiters)
    return await to_thread.run_sync(lambda: function(*args, **kwargs), limiter=limiters[kind])
