"""Who may look and who may act: host names, a token, the origin of a request, and forms of our own.

`Guard` judges every request before anything else does: the name it was sent to, the token, whether
the dashboard is read-only, the site it comes from. `form_of` reads the fields of a form that one of
our pages has made.

A page of another site can make a browser post anything to any address, also on loopback; it can
neither read our pages nor show what only they know (`Settings.csrf`). A site whose name is made to
lead here (DNS rebinding) could: a request under a name that is not ours is refused.
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
    """A request that may not be sent so; not a file that may not be read (OSError)."""


class Guard:
    """ASGI middleware before everything else.

    Args:
        app: The application behind it.
        settings: Host names, token and whether the dashboard is read-only.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})  # before it is accepted: 403
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # Names are bytes of any kind, and the server has put U+FFFD for what is not UTF-8.
        if raw := scope.get("raw_path"):
            scope["path"] = os.fsdecode(unquote_to_bytes(raw))
        try:
            refusal = self._refusal(scope)
        except Exception:  # an error page would show runs to a visitor without the token
            _LOG.exception("the guard could not judge a request")
            refusal = _text(400, "this request cannot be understood")
        await (refusal or self._app)(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if not self._settings.knows(headers.get("host", "")):
            return _text(421, "this dashboard is not called by that name; see hil serve --name")
        if (answer := self._token_refusal(scope, headers)) is not None:
            return answer
        if headers.get("upgrade", "").strip().lower() == "websocket":
            return _text(400, "this dashboard has no WebSockets: its events are at /events")
        if scope["method"] in SAFE:
            return None
        if self._settings.read_only:
            return _text(403, "this dashboard is read-only: nothing can be asked of a run here")
        if not _same_origin(headers):
            return _text(403, "asked by another site: use the pages of the dashboard itself")
        return None

    def _token_refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the answer to a visitor who has not shown the token; None for one who has."""
        token, cookie = self._settings.token, self._settings.cookie
        if not token or _equal(_cookies(headers).get(cookie, ""), token):
            return None
        if _equal(headers.get("authorization", "").removeprefix("Bearer "), token):
            return None
        query = dict(parse_qsl(scope["query_string"].decode("latin-1")))
        if scope["method"] in SAFE and _equal(query.pop("token", ""), token):
            # Lax: a link in a report, shown in its sandbox, counts as another site's.
            # Out of the address, so that it stays neither in the history nor in bookmarks.
            left = f"?{urlencode(query)}" if query else ""
            answer = RedirectResponse(f"{quoted(scope['path'])}{left}", 303)
            answer.set_cookie(
                cookie, token, max_age=MONTH_S, httponly=True, samesite="lax",
                secure=scope["scheme"] == "https",
            )  # fmt: skip
            return answer
        return _text(401, "open the address that hil serve has printed: it carries the token")


async def form_of(request: Request, *, old: bool = False) -> dict[str, str]:
    """Return the fields of one of our own forms.

    Args:
        request: The request with the form.
        old: Accept it also from a page that an earlier dashboard process made, if the browser sends
            the origin: an operator who presses Stop must not have to reload first.

    Raises:
        Forbidden: It is not of a page of ours, or is too long.
    """
    raw = b""
    async for chunk in request.stream():
        raw += chunk
        if len(raw) > MOST_BYTES:
            raise Forbidden(f"a form has at most {MOST_BYTES} bytes")
    fields = dict(parse_qsl(raw.decode("utf-8", "replace"), keep_blank_values=True))
    settings: Settings = request.app.state.settings
    shown = fields.pop("csrf", "") or request.headers.get("x-csrf-token", "")
    ours = old and request.headers.get("origin") is not None  # the guard has compared it
    if not (ours or _equal(shown, settings.csrf)):
        raise Forbidden(
            "the page is older than this dashboard (it was restarted): reload it and ask again"
        )
    return fields


def _equal(shown: str, secret: str) -> bool:
    return hmac.compare_digest(shown.encode(), secret.encode())


def _same_origin(headers: Headers) -> bool:
    """Return whether a page of ours sent a request; programs, unlike browsers, send no origin."""
    if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    return origin is None or _host_of(origin) == headers.get("host", "")


def _host_of(origin: str) -> str:
    """Return host and port of an origin; an empty string if it is not a valid origin."""
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
