"""Pages from templates; every text of them is escaped."""

from __future__ import annotations

import getpass
from functools import cache
from http import HTTPStatus
from importlib.resources import files
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from hil import __version__
from hil.errors import HilError
from hil.web.live_facts import header_of
from hil.web.places import live_runs
from hil.web.settings import Settings

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
    came = urlsplit(request.headers.get("referer", ""))
    if came.netloc != request.headers.get("host", "") or not came.path.startswith("/"):
        return "/"
    # Two slashes at the beginning would name another host.
    return "/" + came.path.lstrip("/") + (f"?{came.query}" if came.query else "")


def page(request: Request, template: str, *, status: int = 200, **context: Any) -> Response:
    """A page for a person.

    Args:
        request: What is answered.
        template: Name of a template in `hil/web/templates`; extends `base.html.j2`.
        status: HTTP status.
        **context: What the template shows; `title` is wanted by the base.
    """
    settings = settings_of(request)
    live = [header_of(run, settings) for run in live_runs(settings)]
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
            live=live,
            **context,
        )
    )
    return HTMLResponse(html, status)


def refused(request: Request, error: Exception) -> Response:
    """What went wrong, as a page or, for programs, as JSON."""
    status, message, hint = _told(error)
    if "text/html" not in request.headers.get("accept", ""):
        return JSONResponse({"error": message, "hint": hint}, status)
    title = HTTPStatus(status).phrase
    return page(request, "error.html.j2", status=status, title=title, message=message, hint=hint)


def _told(error: Exception) -> tuple[int, str, str]:
    if isinstance(error, HilError):
        return _STATUS.get(type(error).__name__, 409), error.message, error.hint or ""
    if isinstance(error, PermissionError):
        return 403, str(error), ""
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

    folder = files("hil.web").joinpath("templates")
    return Environment(
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text("utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name
        return "somebody"
