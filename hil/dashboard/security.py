"""Access control: host names, token, origin of requests, and protection of forms.

`Guard` checks every request first: the host name, the token, whether the dashboard is read-only,
and the site from which the request comes. `form_of` reads the fields of a form that was sent from a
page of this dashboard.

A page of a different site can make a browser send POST requests to any address, including loopback.
A page of a different site cannot read the pages of this dashboard, and therefore does not know the
secret in the forms of the dashboard (`Settings.csrf`). A site whose name resolves to this computer
(DNS rebinding) could read the pages of the dashboard; therefore, a request with an unknown host
name is rejected.
"""

from __future__ import annotations

import hmac
import logging
import os
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, unquote_to_bytes, urlencode, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from hil.core import quoted
from hil.dashboard.settings import Settings

_LOG = logging.getLogger(__name__)

SAFE = ("GET", "HEAD")
MOST_BYTES = 64 * 1024
MONTH_S = 30 * 24 * 3600

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; font-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Forbidden(Exception):
    """Error for a request that is not allowed in this form.

    A file without read permission raises OSError instead.
    """


class Guard:
    """ASGI middleware that checks every request before the application.

    Args:
        app: ASGI application to which accepted requests are passed.
        settings: Settings of the dashboard, of which the host names, the token and `read_only` are
            used.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or reject it."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})  # sent as 403
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # Names are arbitrary bytes, but the server replaces invalid UTF-8 by U+FFFD.
        if raw := scope.get("raw_path"):
            scope["path"] = os.fsdecode(unquote_to_bytes(raw))
        try:
            refusal = self._refusal(scope)
        except Exception:  # an error page would show runs without a token
            _LOG.exception("the guard could not check a request")
            refusal = _text(400, "this request is invalid")
        await (refusal or self._app)(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if not self._settings.knows(headers.get("host", "")):
            return _text(421, "this host name is not allowed; see hil serve --name")
        if (answer := self._token_refusal(scope, headers)) is not None:
            return answer
        if headers.get("upgrade", "").strip().lower() == "websocket":
            return _text(400, "this dashboard has no WebSockets: its events are at /events")
        if scope["method"] in SAFE:
            return None
        if self._settings.read_only:
            return _text(403, "this dashboard is read-only: it sends no requests to runs")
        if not _same_origin(headers):
            return _text(403, "request from a different site: use the pages of the dashboard")
        return None

    def _token_refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the response to a visitor without a valid token; None if the token is valid."""
        token, cookie = self._settings.token, self._settings.cookie
        if not token or _equal(_cookies(headers).get(cookie, ""), token):
            return None
        if _equal(headers.get("authorization", "").removeprefix("Bearer "), token):
            return None
        query = dict(parse_qsl(scope["query_string"].decode("latin-1")))
        if scope["method"] in SAFE and _equal(query.pop("token", ""), token):
            # SameSite is lax because a link in a sandboxed report counts as a different site.
            # The token is removed from the address to keep it out of history and bookmarks.
            left = f"?{urlencode(query)}" if query else ""
            answer = RedirectResponse(f"{quoted(scope['path'])}{left}", 303)
            answer.set_cookie(
                cookie, token, max_age=MONTH_S, httponly=True, samesite="lax",
                secure=scope["scheme"] == "https",
            )  # fmt: skip
            return answer
        return _text(401, "open the address that hil serve has printed: it contains the token")


async def form_of(request: Request, *, old: bool = False) -> dict[str, str]:
    """Return the fields of a form on a page of this dashboard.

    Args:
        request: Request with the form.
        old: Whether to accept a form of an earlier dashboard process if the browser sends the
            origin, so that an operator can use Stop without a reload.

    Raises:
        Forbidden: The form is not from a page of this dashboard, or it is too long.
    """
    raw = b""
    async for chunk in request.stream():
        raw += chunk
        if len(raw) > MOST_BYTES:
            raise Forbidden(f"a form has at most {MOST_BYTES} bytes")
    fields = dict(parse_qsl(raw.decode("utf-8", "replace"), keep_blank_values=True))
    settings: Settings = request.app.state.settings
    shown = fields.pop("csrf", "") or request.headers.get("x-csrf-token", "")
    ours = old and request.headers.get("origin") is not None  # compared by the guard
    if not (ours or _equal(shown, settings.csrf)):
        raise Forbidden(
            "the page is older than this dashboard (it was restarted): reload it and try again"
        )
    return fields


def _equal(shown: str, secret: str) -> bool:
    return hmac.compare_digest(shown.encode(), secret.encode())


def _same_origin(headers: Headers) -> bool:
    """Return whether a request was sent by a page of this dashboard, or without an origin."""
    if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    return origin is None or _host_of(origin) == headers.get("host", "")


def _host_of(origin: str) -> str:
    """Return the host and the port of an origin; an empty string if the origin is invalid."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return ""


def _cookies(headers: Headers) -> dict[str, str]:
    try:
        found = SimpleCookie(headers.get("cookie", ""))
    except CookieError:
        return {}
    return {name: morsel.value for name, morsel in found.items()}


def _text(status: int, text: str) -> PlainTextResponse:
    return PlainTextResponse(text + "\n", status)


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
