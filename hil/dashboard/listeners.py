"""How many may listen at a time: each holds a connection and a file, and Stop needs one of them."""

from __future__ import annotations

from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST = 64
"""Streams of events; a browser has one, and looks for another where it is refused."""


class Listeners:
    """ASGI middleware that refuses further streams of events; pages and forms always pass.

    Args:
        app: What answers.
        most: So many streams are open at most.
    """

    def __init__(self, app: ASGIApp, most: int = MOST) -> None:
        self._app, self._most, self._open = app, most, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or say that too many listen."""
        if scope["type"] != "http" or not _is_stream(scope):
            await self._app(scope, receive, send)
            return
        full = self._open >= self._most
        if scope["method"] == "HEAD":  # asked by a page that was refused, and cannot see why
            await PlainTextResponse("", 503 if full else 204)(scope, receive, send)
            return
        if full:
            told = f"{self._most} pages listen already: close some, or reload this one for news\n"
            await PlainTextResponse(told, 503, {"Retry-After": "10"})(scope, receive, send)
            return
        self._open += 1
        try:
            await _in_full(self._app, scope, receive, send)
        finally:
            self._open -= 1


async def _in_full(app: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer to the end: a stream that ends with the dashboard says no last word by itself."""
    open_yet = False

    async def noted(message: Message) -> None:
        nonlocal open_yet
        open_yet = message["type"] == "http.response.start" or message.get("more_body", False)
        await send(message)

    await app(scope, receive, noted)
    if open_yet:
        await send({"type": "http.response.body", "body": b"", "more_body": False})


def _is_stream(scope: Scope) -> bool:
    path = str(scope["path"])
    return scope["method"] in ("GET", "HEAD") and path.endswith("/events")
