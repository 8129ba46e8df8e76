"""Listening: the dashboard on a port, until somebody ends it."""

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
from types import FrameType

from hil.core import OncePerMinute, RobotConnectionError
from hil.dashboard.app import create_app
from hil.dashboard.settings import DEFAULT_PORT, Settings, is_wildcard

PORTS_TRIED = 10
CLOSED_WITHIN_S = 1
ENDED_WITHIN_S = 4.0
ENDED_BY_A_SIGNAL = 130
"""As the command line says it of every command."""
MOST_FILES = 65_536

LOGGERS = (
    "uvicorn.error",
    "asyncio",
    "hil.dashboard.app",
    "hil.dashboard.protocol",
    "hil.dashboard.security",
)
"""Loggers that clients can trigger repeatedly; rate-limited."""


def listen(host: str, port: int | None) -> socket.socket:
    """A socket that listens.

    Args:
        host: Address or name of this computer.
        port: TCP port, 0 for any; None for 8350 or, where that is taken, one of the next nine.

    Raises:
        RobotConnectionError: Nobody can listen there.
    """
    ports = range(DEFAULT_PORT, DEFAULT_PORT + PORTS_TRIED) if port is None else [port]
    problem: OSError | None = None
    for one in ports:
        try:
            return socket.create_server((host, one), family=_family(host), backlog=128)
        except OSError as error:
            problem = error
    assert problem is not None
    where = f"{host}:{port}" if port is not None else f"{host}, ports {ports[0]} to {ports[-1]}"
    raise RobotConnectionError(
        # Python adds `(while attempting to bind on address …)`, which is said already.
        f"cannot listen on {where}: {str(problem.strerror or problem).partition(' (while ')[0]}",
        hint="give another port: hil serve --port 8400 (0 takes any)",
    ) from problem


def serve(settings: Settings, listening: socket.socket, tell: Callable[[str], object]) -> None:
    """Serve until SIGINT or SIGTERM; runs that were started go on.

    Args:
        settings: What is shown, and who may do what; its port is that of the socket.
        listening: Where, see `listen`.
        tell: Is given the address to open, with the token unless that was given to us.
    """
    import uvicorn

    from hil.dashboard.protocol import LimitedProtocol

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
    tell(address(settings))
    server = uvicorn.Server(config)
    noticed = server.handle_exit

    def end(sig: int, frame: FrameType | None) -> None:
        _end_in_time()
        noticed(sig, frame)

    server.handle_exit = end  # type: ignore[method-assign]
    server.run(sockets=[listening])


def _end_in_time() -> None:
    """Whatever a page still waits for, the process is gone then: it owns nothing."""
    last = threading.Timer(ENDED_WITHIN_S, os._exit, (ENDED_BY_A_SIGNAL,))
    last.daemon = True
    last.start()


def address(settings: Settings) -> str:
    """What to open in a browser."""
    host = settings.called[0] if is_wildcard(settings.host) else settings.host
    if ":" in host and not host.startswith("["):
        host = f"[{host}]"
    # What is printed is kept: by the journal of systemd, say, which others may read.
    token = f"?token={settings.token}" if settings.token and not settings.token_given else ""
    return f"http://{host}:{settings.port}/{token}"


def _allow_many_files() -> None:
    """Every connection takes one, and the usual limit is a small one."""
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_FILES if most == resource.RLIM_INFINITY else min(most, MOST_FILES)
    if now != resource.RLIM_INFINITY and now < wanted:
        with contextlib.suppress(ValueError, OSError):  # not allowed here: it stays as it is
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, most))


def _family(host: str) -> socket.AddressFamily:
    try:
        six = ipaddress.ip_address(host).version == 6
    except ValueError:
        six = False
    return socket.AF_INET6 if six else socket.AF_INET
