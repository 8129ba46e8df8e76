"""Server of the dashboard: the ASGI application with all pages, and the listening socket.

The function `create_app` combines the routes of the pages with two middlewares: the guard
(`security`) and the limit of event streams (`limits`). The function `serve` runs this application
in the server uvicorn. The server process has no state to save: pages show data from the disk, and
runs are separate processes, which continue after the end of the server.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import resource
import socket
import threading
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from types import FrameType
from urllib.parse import quote

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from hil.core import HilError, OncePerMinute, RobotConnectionError
from hil.dashboard import (
    catalogue,
    fleets,
    live_runs,
    models,
    overview,
    run_files,
    run_page,
    schedules,
    start_page,
)
from hil.dashboard.limits import LimitedProtocol, StreamLimit
from hil.dashboard.rendering import OPERATOR_COOKIE, back, error_page
from hil.dashboard.security import HEADERS, Forbidden, Guard, form_of
from hil.dashboard.settings import DEFAULT_PORT, Settings, is_wildcard

YEAR_S = 365 * 24 * 3600

_LOG = logging.getLogger(__name__)


def create_app(settings: Settings) -> Starlette:
    """Return the dashboard as an ASGI application.

    Args:
        settings: Settings of the dashboard.
    """
    # The first matching route answers. The routes of a run's files must precede the page of a run,
    # whose address may be any text.
    pages = (
        overview,
        catalogue,
        models,
        schedules,
        fleets,
        run_files,
        live_runs,
        run_page,
        start_page,
    )
    static = StaticFiles(directory=str(files("hil.dashboard").joinpath("static")))
    app = Starlette(
        routes=[
            *(route for page in pages for route in page.routes),
            Route("/who", _set_operator, methods=["POST"]),
            Mount("/static", static),
        ],
        middleware=[Middleware(Guard, settings=settings), Middleware(StreamLimit)],
        exception_handlers={
            HilError: _refuse,
            Forbidden: _refuse,
            OSError: _refuse,
            404: _refuse,
            ClientDisconnect: _disconnected,
            Exception: _failed,
        },
    )
    app.state.settings = settings
    return app


async def _set_operator(request: Request) -> Response:
    """Store the operator's name in a cookie; it is recorded with each request to a run."""
    name = (await form_of(request)).get("who", "").strip()[:80]
    answer = RedirectResponse(back(request), 303)
    if name:
        answer.set_cookie(
            OPERATOR_COOKIE, quote(name), max_age=YEAR_S, httponly=True, samesite="strict"
        )
    else:
        answer.delete_cookie(OPERATOR_COOKIE)
    return answer


async def _refuse(request: Request, error: Exception) -> Response:
    # The error page lists live runs, which needs the disk.
    return await run_in_threadpool(error_page, request, error)


async def _disconnected(request: Request, error: Exception) -> Response:
    """Answer a client that has disconnected, without a traceback."""
    _LOG.warning("a client disconnected before its request was complete")
    return Response(status_code=499)


async def _failed(request: Request, error: Exception) -> Response:
    """Answer an unexpected error outside of the guard, hence with the guard's headers."""
    answer = await _refuse(request, error)
    for name, value in HEADERS.items():
        answer.headers.setdefault(name, value)
    return answer


PORTS_TRIED = 10
CLOSED_WITHIN_S = 1
ENDED_WITHIN_S = 4.0
MOST_FILES = 65_536

ENDED_BY_A_SIGNAL = 130
"""Exit code of every hil command that ends because of a signal."""

LOGGERS = (
    "uvicorn.error",
    "asyncio",
    "hil.dashboard.server",
    "hil.dashboard.limits",
    "hil.dashboard.security",
)
"""Names of loggers whose messages clients can trigger repeatedly and which are therefore
rate-limited.
"""


def listen(host: str, port: int | None) -> socket.socket:
    """Return a listening socket.

    Args:
        host: Address or host name of this computer.
        port: TCP port; 0 for any free port; None for port 8350 or, if it is in use, one of the next
            nine ports.

    Raises:
        RobotConnectionError: The server cannot listen on the address.
    """
    ports = range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED) if port is None else [port]
    try:
        six = ipaddress.ip_address(host).version == 6
    except ValueError:  # host is a name
        six = False
    family = socket.AF_INET6 if six else socket.AF_INET
    problem: OSError | None = None
    for one in ports:
        try:
            return socket.create_server((host, one), family=family, backlog=128)
        except OSError as error:
            problem = error
    assert problem is not None
    where = f"{host}:{port}" if port is not None else f"{host}, ports {ports[0]} to {ports[-1]}"
    raise RobotConnectionError(
        # Remove Python's `(while attempting to bind on address …)`.
        f"cannot listen on {where}: {str(problem.strerror or problem).partition(' (while ')[0]}",
        hint="use another port: hil serve --port 8400 (0 takes any)",
    ) from problem


def serve(settings: Settings, listening: socket.socket, announce: Callable[[str], object]) -> None:
    """Serve pages until SIGINT or SIGTERM; runs that were started continue.

    Args:
        settings: Settings of the dashboard; the port is replaced by the port of the socket.
        listening: Listening socket, as returned by `listen`.
        announce: Callback that receives the address for the browser (see `browser_address`).
    """
    settings = replace(settings, port=listening.getsockname()[1])
    config = uvicorn.Config(
        create_app(settings),
        lifespan="off",
        log_level="warning",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=CLOSED_WITHIN_S,
        http=LimitedProtocol,
        ws="none",  # the guard handles upgrade requests like any other
    )
    for name in LOGGERS:  # after uvicorn has configured its loggers
        logging.getLogger(name).addFilter(OncePerMinute())
    _allow_many_files()
    announce(browser_address(settings))
    server = uvicorn.Server(config)
    close = server.handle_exit

    def end(sig: int, frame: FrameType | None) -> None:
        # A page that never answers must not delay the exit, as there is no state to save.
        last = threading.Timer(ENDED_WITHIN_S, os._exit, (ENDED_BY_A_SIGNAL,))
        last.daemon = True
        last.start()
        close(sig, frame)

    server.handle_exit = end  # type: ignore[method-assign]
    server.run(sockets=[listening])


def browser_address(settings: Settings) -> str:
    """Return the address for a browser, with the token, unless the user has chosen the token."""
    host = settings.called[0] if is_wildcard(settings.host) else settings.host
    if ":" in host and not host.startswith("["):
        host = f"[{host}]"
    # Printed text may be stored, for example by the journal of systemd, and read by others.
    token = f"?token={settings.token}" if settings.token and not settings.token_given else ""
    return f"http://{host}:{settings.port}/{token}"


def _allow_many_files() -> None:
    """Raise the limit of open files, because the default limit is too low for many connections."""
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = MOST_FILES if most == resource.RLIM_INFINITY else min(most, MOST_FILES)
    if now != resource.RLIM_INFINITY and now < needed:
        with contextlib.suppress(ValueError, OSError):  # not allowed: keep the limit
            resource.setrlimit(resource.RLIMIT_NOFILE, (needed, most))
