"""Rendering of responses: HTML from templates, JSON for programs, and error pages.

All text in templates is escaped. Every page, including the error page, shows the bar of live runs
with the Stop button. If the bar of live runs cannot be rendered, a minimal page explains the error.
"""

from __future__ import annotations

import getpass
from functools import cache
from html import escape
from http import HTTPStatus
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from hil import __version__
from hil.core import HilError, json_text, shell_word, utf8_text
from hil.dashboard.live_runs import live_headers, pending_starts
from hil.dashboard.security import Forbidden
from hil.dashboard.settings import settings_of

if TYPE_CHECKING:
    from jinja2 import Environment

OPERATOR_COOKIE = "hil_who"

NAVIGATION = (
    ("/", "Overview"),
    ("/runs", "Runs"),
    ("/models", "Models"),
    ("/schedules", "Schedules"),
    ("/fleets", "Fleets"),
    ("/start", "Start"),
)


def operator_of(request: Request) -> str:
    """Return the name of the operator at the browser, or the user of the dashboard process."""
    return unquote(request.cookies.get(OPERATOR_COOKIE, "")).strip()[:80] or _default_operator()


def _default_operator() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # the user has no name
        user = "somebody"
    return f"{user} (dashboard)"


def back(request: Request) -> str:
    """Return the address of the page that contains the form, never of a different site."""
    try:
        came = urlsplit(request.headers.get("referer", ""))
    except ValueError:  # an invalid address
        return "/"
    if came.netloc != request.headers.get("host", "") or not came.path.startswith("/"):
        return "/"
    # Two leading slashes would refer to a different host.
    return "/" + came.path.lstrip("/") + (f"?{came.query}" if came.query else "")


def page(request: Request, template: str, *, status: int = 200, **context: Any) -> Response:
    """Return a page.

    Args:
        request: HTTP request to which the page responds.
        template: Name of a template in `hil/dashboard/templates` that extends `base.html.j2`.
        status: HTTP status.
        **context: Values of the template; the base template needs `title`.
    """
    settings = settings_of(request)
    html = (
        _environment()
        .get_template(template)
        .render(
            version=__version__,
            navigation=NAVIGATION,
            here=request.url.path,
            settings=settings,
            csrf=settings.csrf,
            who=operator_of(request),
            live=live_headers(settings),
            planned=pending_starts(settings),
            **context,
        )
    )
    return HTMLResponse(utf8_text(html), status)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    folder = files("hil.dashboard").joinpath("templates")
    made = Environment(
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text("utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["quoted"] = lambda text: shell_word(str(text))  # for commands to copy
    return made


def as_json(document: Any, status: int = 200) -> Response:
    """Return a JSON answer for a program."""
    return Response(json_text(document), status, media_type="application/json")


def error_page(request: Request, error: Exception) -> Response:
    """Return an error as a page or, if the client is a program, as JSON."""
    status, message, hint = _explained(error)
    if "text/html" not in request.headers.get("accept", ""):
        return as_json({"error": message, "hint": hint}, status)
    title = HTTPStatus(status).phrase
    texts = {"title": title, "message": message, "hint": hint}
    try:
        return page(request, "error.html.j2", status=status, **texts)
    except Exception:  # the bar of live runs may be the cause
        return HTMLResponse(utf8_text(_bare(**texts)), status)


def _bare(title: str, message: str, hint: str) -> str:
    """Return a page that requires no data from the disk."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<h1>{escape(title)}</h1><p>{escape(message)}</p><p>{escape(hint)}</p>"
        "<p>Live runs cannot be listed here: stop one with <code>hil stop</code>.</p>"
        '<p><a href="/">Overview</a></p></html>'
    )


_HTTP = {404: ("this page does not exist", "use the navigation above")}
_STATUS = {"DataError": 404, "SpecError": 422, "RegistryError": 404}


def _explained(error: Exception) -> tuple[int, str, str]:
    if isinstance(error, HilError):
        return _STATUS.get(type(error).__name__, 409), error.message, error.hint or ""
    if isinstance(error, Forbidden):
        return 403, str(error), ""
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        message = f"cannot read or write {where}{error.strerror or error}"
        hint = "check that the file exists, is readable and writable, and that the disk has space"
        return 500, message, hint
    if isinstance(error, HTTPException):
        return error.status_code, *_HTTP.get(error.status_code, (error.detail, ""))
    # An unexpected error affects one page only: all others, and Stop, still work.
    message = f"this page could not be created: {type(error).__name__}: {error}"
    return 500, message, "details are in the terminal of `hil serve`"
