"""The application: routes of all pages behind the guard."""

from __future__ import annotations

import logging
from importlib import import_module
from importlib.resources import files
from urllib.parse import quote

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from hil.core import HilError
from hil.dashboard.listeners import Listeners
from hil.dashboard.rendering import WHO, back, refused
from hil.dashboard.security import HEADERS, Forbidden, Guard, form_of
from hil.dashboard.settings import Settings

PAGES = (
    "hil.dashboard.overview",
    "hil.dashboard.catalogue_pages",
    "hil.dashboard.model_pages",
    "hil.dashboard.version_pages",
    "hil.dashboard.schedule_pages",
    "hil.dashboard.fleet_pages",
    "hil.dashboard.run_files",
    "hil.dashboard.resume_pages",
    "hil.dashboard.live_pages",
    "hil.dashboard.start_pages",
)
"""Modules with pages; each has `routes`. Of routes that match, the first answers."""

_LOG = logging.getLogger(__name__)

YEAR_S = 365 * 24 * 3600


def create_app(settings: Settings) -> Starlette:
    """The dashboard as an ASGI application.

    Args:
        settings: What it shows, and who may do what.
    """
    app = Starlette(
        routes=_routes(),
        middleware=[Middleware(Guard, settings=settings), Middleware(Listeners)],
        exception_handlers={
            HilError: _refused,
            Forbidden: _refused,
            OSError: _refused,
            404: _refused,
            ClientDisconnect: _left,
            Exception: _failed,
        },
    )
    app.state.settings = settings
    return app


def _routes() -> list[BaseRoute]:
    static = StaticFiles(directory=str(files("hil.dashboard").joinpath("static")))
    pages = [route for module in PAGES for route in import_module(module).routes]
    return [*pages, Route("/who", _who, methods=["POST"]), Mount("/static", static)]


async def _refused(request: Request, error: Exception) -> Response:
    return await run_in_threadpool(refused, request, error)


async def _left(request: Request, error: Exception) -> Response:
    """Answer a client that is not there any more: no mistake of ours, and no traceback."""
    _LOG.warning("a client left before its request was whole")
    return Response(status_code=499)


async def _failed(request: Request, error: Exception) -> Response:
    """Answered outside of the guard, which is why its headers are added here."""
    answer = await _refused(request, error)
    for name, value in HEADERS.items():
        answer.headers.setdefault(name, value)
    return answer


async def _who(request: Request) -> Response:
    """Keep who sits here; it is recorded with what they ask."""
    name = (await form_of(request)).get("who", "").strip()[:80]
    answer = RedirectResponse(back(request), 303)
    if name:
        answer.set_cookie(WHO, quote(name), max_age=YEAR_S, httponly=True, samesite="strict")
    else:
        answer.delete_cookie(WHO)
    return answer
