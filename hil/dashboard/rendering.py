"""Pages from templates; every text of them is escaped."""

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
from hil.dashboard.going import being_planned, going_on
from hil.dashboard.security import Forbidden
from hil.dashboard.settings import Settings

if TYPE_CHECKING:
    from jinja2 import Environment

WHO = "hil_who"

NAVIGATION = (
    ("/", "Overview"),
    ("/runs", "Runs"),
    ("/models", "Models"),
    ("/schedules", "Schedules"),
    ("/fleets", "Fleets"),
    ("/start", "Start"),
)


def settings_of(request: Request) -> Settings:
    """The settings of the dashboard that is asked."""
    settings: Settings = request.app.state.settings
    return settings


def who_of(request: Request) -> str:
    """Who sits at the browser: the name they gave, else the user the dashboard runs for."""
    return unquote(request.cookies.get(WHO, "")).strip()[:80] or f"{_user()} (dashboard)"


def back(request: Request) -> str:
    """Where a form was sent from; only ever a page of ours."""
    try:
        came = urlsplit(request.headers.get("referer", ""))
    except ValueError:  # no address
        return "/"
    if came.netloc != request.headers.get("host", "") or not came.path.startswith("/"):
        return "/"
    # Two slashes at the beginning would name another host.
    return "/" + came.path.lstrip("/") + (f"?{came.query}" if came.query else "")


def page(request: Request, template: str, *, status: int = 200, **context: Any) -> Response:
    """A page for a person.

    Args:
        request: What is answered.
        template: Name of a template in `hil/dashboard/templates`; extends `base.html.j2`.
        status: HTTP status.
        **context: What the template shows; `title` is wanted by the base.
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
            who=who_of(request),
            live=going_on(settings),
            planned=being_planned(settings),
            **context,
        )
    )
    return HTMLResponse(utf8_text(html), status)


def as_json(document: Any, status: int = 200) -> Response:
    """Return an answer to a program."""
    return Response(json_text(document), status, media_type="application/json")


def refused(request: Request, error: Exception) -> Response:
    """What went wrong, as a page or, for programs, as JSON."""
    status, message, hint = _told(error)
    if "text/html" not in request.headers.get("accept", ""):
        return as_json({"error": message, "hint": hint}, status)
    title = HTTPStatus(status).phrase
    told = {"title": title, "message": message, "hint": hint}
    try:
        return page(request, "error.html.j2", status=status, **told)
    except Exception:  # what every page shows is itself what cannot be read
        return HTMLResponse(utf8_text(_bare(**told)), status)


def _bare(title: str, message: str, hint: str) -> str:
    """A page that needs nothing of the disk."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<h1>{escape(title)}</h1><p>{escape(message)}</p><p>{escape(hint)}</p>"
        "<p>Live runs cannot be listed here: stop one with <code>hil stop</code>.</p>"
        '<p><a href="/">Overview</a></p></html>'
    )


def _told(error: Exception) -> tuple[int, str, str]:
    if isinstance(error, HilError):
        return _STATUS.get(type(error).__name__, 409), error.message, error.hint or ""
    if isinstance(error, Forbidden):
        return 403, str(error), ""
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        told = f"cannot read or write {where}{error.strerror or error}"
        return 500, told, "see whether it exists, may be read and written, and the disk has room"
    if isinstance(error, HTTPException):
        return error.status_code, *_HTTP.get(error.status_code, (error.detail, ""))
    # A mistake of ours on one page: whoever watches a run still has all others, and Stop.
    told = f"this page could not be made: {type(error).__name__}: {error}"
    return 500, told, "the terminal of hil serve has the details"


_HTTP = {404: ("there is no such page", "the navigation above leads to all there are")}
_STATUS = {"DataError": 404, "SpecError": 422, "RegistryError": 404}


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
    made.filters["quoted"] = lambda told: shell_word(str(told))  # for commands to be copied
    return made


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        return "somebody"
