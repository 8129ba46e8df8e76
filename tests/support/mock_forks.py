"""A process that forks mock servers: what takes them seconds to import, it has imported once.

Tests start it by `Forks`; it reads requests from the socket that is its standard input, and ends
with it, and so do its mocks. How `python -m hil_mock_robot` itself starts is tested in
tests/mock/server/test_servers.py.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import select
import signal
import socket
import sys
import traceback
from importlib import import_module
from typing import Any, NoReturn

from hil_mock_robot.__main__ import MOCKS

LONGEST_REQUEST = 200_000


def main() -> None:
    """Fork a mock for each request until the socket is closed."""
    line = socket.socket(fileno=0)
    woken, waker = os.pipe()
    for end in (woken, waker):
        os.set_blocking(end, False)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    status_of: dict[int, int] = {}
    while True:
        ready, _, _ = select.select([line, woken], [], [])
        if woken in ready:
            os.read(woken, 1024)
            reap(status_of)
        if line in ready:
            data, fds, _, _ = socket.recv_fds(line, LONGEST_REQUEST, 3)
            if not data:
                break
            out, err, status = fds
            request = json.loads(data)
            warm(request["name"])
            pid = os.fork()
            if not pid:
                signal.set_wakeup_fd(-1)
                for end in (line.detach(), woken, waker, status, *status_of.values()):
                    os.close(end)
                be_mock(request, out, err)
            for end in (out, err):
                os.close(end)
            status_of[pid] = status
            line.sendall(f"{pid}\n".encode())
    for pid in status_of:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)


def reap(status_of: dict[int, int]) -> None:
    """Write the exit codes of mocks that have ended to those that wait for them."""
    for pid in list(status_of):
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            with contextlib.suppress(OSError):
                os.write(status_of[pid], f"{os.waitstatus_to_exitcode(status)}".encode())
            os.close(status_of.pop(pid))


def be_mock(request: dict[str, Any], out: int, err: int) -> NoReturn:
    """Run as the mock that was asked for, as its command line does."""
    code = 70
    try:
        os.dup2(out, 1)
        os.dup2(err, 2)
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.environ.clear()
        os.environ.update(request["environment"])
        os.chdir(request["folder"])
        code = int(module_of(request["name"]).main(request["arguments"]))
    except SystemExit as ending:
        code = ending.code if isinstance(ending.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.flush()
        os._exit(code)


def module_of(name: str) -> Any:
    """Return the module of a mock, by its name or its own."""
    return import_module(MOCKS.get(name, name))


_warm: set[str] = set()


def warm(name: str) -> None:
    """Compile the physics of an arm, once."""
    if name in _warm:
        return
    _warm.add(name)
    module = module_of(name)
    if name == "ur":
        given = module.parser_of().parse_args([])
        series = module.series_of(given.model)
        module.machine_of(given, series).tick()
    elif name == "can":
        from hil_mock_robot.cia402.body import Body
        from hil_mock_robot.plant.truth import draw_truth

        Body(draw_truth("lab6", 1, "full"), [0.0] * 6)
    elif name == "plc":
        module.arm_of(module.parser_of().parse_args([]))
    gc.freeze()  # so that forks share it


if __name__ == "__main__":
    main()
