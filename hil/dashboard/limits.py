"""Limits that keep Stop available, even if requests are slow or too numerous.

- `LimitedProtocol` limits the arrival time of a request and the number of pending requests. The
  server uvicorn has no such limits, and an attacker can cheaply keep a connection open by sending
  single bytes. Each pending request has a deadline, which is not extended by further bytes. If too
  many connections are pending, the oldest pending connection is closed. A long response, such as an
  event stream, has no deadline as long as the client reads the response.
- `StreamLimit` limits the number of open event streams, each of which occupies a connection and a
  file.
- `in_thread` limits the number of threads separately for each kind of work: runs, starts and
  streams. Because of the separate limits, even sixty slow starts leave a thread free for Stop.
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
"""Maximum number of unsent bytes of a response in the buffer of the kernel."""

_TOO_MANY = "a connection was closed: too many requests were arriving"
_TOO_SLOW = b"HTTP/1.1 408 Request Timeout\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a connection.

    Attributes:
        headers_s: Maximum time from the first byte of a request (or from the connection) to the end
            of the headers [s].
        body_s: Maximum time from the end of the headers to the end of the body of a request [s].
        unread_s: Maximum time for which a client may read nothing of a response [s].
        arriving: Maximum number of connections whose request is incomplete.
    """

    headers_s: float = 10.0
    body_s: float = 20.0
    unread_s: float = 30.0
    arriving: int = 128


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 protocol with the limits that `Limits` describes.

    Attributes:
        arriving: Part of the request that is incomplete, `headers` or `body`; empty if no request
            is incomplete.
        since: Time of the last change of `arriving` [s, monotonic].
    """

    limits = Limits()

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.arriving = ""
        self.since = 0.0
        self._deadline: asyncio.TimerHandle | None = None
        self._unread: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the deadline of the request; if necessary, close the oldest pending connection."""
        super().connection_made(transport)
        # Megabytes in the kernel's buffer would hide the progress of a slow reader.
        if (connection := transport.get_extra_info("socket")) is not None:
            with contextlib.suppress(OSError, AttributeError):  # not supported on every system
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        self._set_arriving("headers")
        others = [one for one in self.connections if isinstance(one, LimitedProtocol)]
        arriving = [one for one in others if one.arriving]
        if len(arriving) > self.limits.arriving:
            min(arriving, key=lambda one: one.since).drop(_TOO_MANY)

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the deadlines."""
        self._set_arriving("")
        self.resume_writing()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Process received data, and update which part of the request is incomplete."""
        super().data_received(data)
        self._update(begun=True)

    def on_response_complete(self) -> None:
        """Wait for the next request; uvicorn limits the time until its first byte."""
        super().on_response_complete()
        self._update(begun=bool(self.conn.trailing_data[0]))

    def pause_writing(self) -> None:
        """Wait for the client to read the response, as long as the client reads anything."""
        super().pause_writing()
        self._wait_for_reader()

    def _wait_for_reader(self, before: int | None = None) -> None:
        """Close the connection if the client has read nothing since `before` bytes were unsent."""
        left = self.transport.get_write_buffer_size()
        if before is not None and left >= before:
            limit_s = self.limits.unread_s
            self.drop(f"a connection was closed: an answer was not read for {limit_s:g} s")
            return
        self._unread = self.loop.call_later(self.limits.unread_s, self._wait_for_reader, left)

    def resume_writing(self) -> None:
        """Resume writing."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def _unsupported_upgrade_warning(self) -> None:
        """Suppress the warning: the guard rejects other protocols after its token check."""

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
        """Close the connection to the client and log the reason."""
        if self.transport.is_closing():
            return
        _LOG.warning(why)
        if self.arriving == "headers":  # no answer was started
            self.transport.write(_TOO_SLOW)
            self.transport.close()
        else:
            self.transport.abort()


MOST_STREAMS = 64
"""Maximum number of open event streams. A browser needs one event stream, and retries later if
its request for a stream is rejected.
"""


class StreamLimit:
    """ASGI middleware that rejects event streams above a maximum number, but no other requests.

    Args:
        app: ASGI application to which requests are passed.
        most: Maximum number of open event streams.
    """

    def __init__(self, app: ASGIApp, most: int = MOST_STREAMS) -> None:
        self._app, self._most, self._open = app, most, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or respond that too many streams are open."""
        if scope["type"] != "http" or not _is_stream(scope):
            await self._app(scope, receive, send)
            return
        full = self._open >= self._most
        if scope["method"] == "HEAD":  # browsers hide a stream's status from scripts
            await PlainTextResponse("", 503 if full else 204)(scope, receive, send)
            return
        if full:
            text = f"{self._most} pages receive events already: close some, or reload this page\n"
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
    """Send a final message if the stream was cut off by the end of the dashboard."""
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
"""Number of threads for each kind of work. Threads of the kind `control` possibly wait for a run
that has just begun. Pages are computed in the threads of the library anyio.
"""

_limiters: RunVar[dict[Kind, CapacityLimiter]] = RunVar("hil_limiters")


async def in_thread(kind: Kind, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function that blocks or reads the disk, on a thread of a kind.

    Args:
        kind: `control` for requests to a run, `start` for starting or resuming one, `stream` for
            event streams.
        function: Function to call.
        *args: Positional arguments of the function.
        **kwargs: Keyword arguments of the function.
    """
    try:
        limiters = _limiters.get()
    except LookupError:  # the first call in this event loop
        limiters = {each: CapacityLimiter(most) for each, most in THREADS.items()}
        _limiters.set(limiters)
    return await to_thread.run_sync(lambda: function(*args, **kwargs), limiter=limiters[kind])
