"""The dashboard's server: the ASGI application of all pages, and the socket that it listens on.

`create_app` puts the pages' routes behind two middlewares: the guard (`security`) and the limit of
event streams (`limits`). `serve` runs that application in uvicorn. The process owns nothing that
has to be saved: pages are views of the disk, and runs are processes of their own, which go on when
the server ends.
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
        settings: What it shows, and who may do what.
    """
    # Of routes that match, the first answers: the files of a run come before the page of a run,
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
    """Keep the operator's name in a cookie; it is recorded with everything they ask of a run."""
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
    # The error page lists live runs, for which the disk is read.
    return await run_in_threadpool(error_page, request, error)


async def _disconnected(request: Request, error: Exception) -> Response:
    """Answer a client that has left: no mistake of ours, and no traceback."""
    _LOG.warning("a client left before its request was whole")
    return Response(status_code=499)


async def _failed(request: Request, error: Exception) -> Response:
    """Answer outside of the guard, which is why its headers are added here."""
    answer = await _refuse(request, error)
    for name, value in HEADERS.items():
        answer.headers.setdefault(name, value)
    return answer


PORTS_TRIED = 10
CLOSED_WITHIN_S = 1
ENDED_WITHIN_S = 4.0
MOST_FILES = 65_536

ENDED_BY_A_SIGNAL = 130
"""Exit code, as of every command of hil that a signal ends."""

LOGGERS = (
    "uvicorn.error",
    "asyncio",
    "hil.dashboard.server",
    "hil.dashboard.limits",
    "hil.dashboard.security",
)
"""Loggers that clients can trigger repeatedly; rate-limited."""


def listen(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens.

    Args:
        host: Address or name of this computer.
        port: TCP port, 0 for any; None for 8350 or, where that is taken, one of the next nine.

    Raises:
        RobotConnectionError: The address cannot be listened on.
    """
    ports = range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED) if port is None else [port]
    try:
        six = ipaddress.ip_address(host).version == 6
    except ValueError:  # a name
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
        # Python adds `(while attempting to bind on address …)`, which is said already.
        f"cannot listen on {where}: {str(problem.strerror or problem).partition(' (while ')[0]}",
        hint="give another port: hil serve --port 8400 (0 takes any)",
    ) from problem


def serve(settings: Settings, listening: socket.socket, announce: Callable[[str], object]) -> None:
    """Serve until SIGINT or SIGTERM; runs that were started go on.

    Args:
        settings: What is shown, and who may do what; its port is that of the socket.
        listening: The socket, see `listen`.
        announce: Called with the address to open, see `browser_address`.
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
        ws="none",  # a request to upgrade is one more request, and meets the guard
    )
    for name in LOGGERS:  # after uvicorn has set up its own
        logging.getLogger(name).addFilter(OncePerMinute())
    _allow_many_files()
    announce(browser_address(settings))
    server = uvicorn.Server(config)
    close = server.handle_exit

    def end(sig: int, frame: FrameType | None) -> None:
        # A page that never answers must not keep the process: it owns nothing.
        last = threading.Timer(ENDED_WITHIN_S, os._exit, (ENDED_BY_A_SIGNAL,))
        last.daemon = True
        last.start()
        close(sig, frame)

    server.handle_exit = end  # type: ignore[method-assign]
    server.run(sockets=[listening])


def browser_address(settings: Settings) -> str:
    """Return the address to open in a browser, with the token unless the user has given it."""
    host = settings.called[0] if is_wildcard(settings.host) else settings.host
    if ":" in host and not host.startswith("["):
        host = f"[{host}]"
    # What is printed is kept: by the journal of systemd, say, which others may read.
    token = f"?token={settings.token}" if settings.token and not settings.token_given else ""
    return f"http://{host}:{settings.port}/{token}"


def _allow_many_files() -> None:
    """Raise the limit of open files: every connection takes one, and the usual limit is small."""
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = MOST_FILES if most == resource.RLIM_INFINITY else min(most, MOST_FILES)
    if now != resource.RLIM_INFINITY and now < needed:
        with contextlib.suppress(ValueError, OSError):  # not allowed here: it stays as it is
            resource.setrlimit(resource.RLIMIT_NOFILE, (needed, most))
