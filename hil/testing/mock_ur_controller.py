"""The mock UR controller for tests of any UR client: its own process, real sockets."""

from __future__ import annotations

import contextlib
import secrets
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hil.core import PluginError
from hil.testing.mock_process import MockProcess
from hil.testing.starting import own_folder, require_extras, running

DASHBOARD, SIDE = 29999, 30100
PORTS = (DASHBOARD, 30001, 30002, 30003, 30004, SIDE)
_CONNECT_S = 5.0
_TRIES = 100


class UrController(MockProcess):
    """A UR controller that runs; give `host` to your client, ports are those of every UR.

    Attributes:
        host: Its address, a loopback one.
        model: The arm it controls.
    """

    def __init__(
        self, host: str, model: str, process: subprocess.Popen[str], journal: Path
    ) -> None:
        super().__init__(process, journal)
        self.host, self.model = host, model

    def dashboard(self, command: str) -> str:
        """Send one line to the dashboard server, as from a shell; its answer."""
        with (
            socket.create_connection((self.host, DASHBOARD), _CONNECT_S) as line,
            line.makefile("rw", encoding="utf-8", newline="\n") as text,
        ):
            text.readline()  # it greets first
            text.write(command + "\n")
            text.flush()
            return text.readline().strip()

    def press(self, button: str) -> dict[str, Any]:
        """Press what the teach pendant has, such as `unlock`: how stops are released.

        Raises:
            CommandRefused: It does nothing as things are; the hint says what would.
        """
        return self.tell("pendant", press=button)

    def _line(self) -> socket.socket:
        return socket.create_connection((self.host, SIDE), _CONNECT_S)


@contextlib.contextmanager
def ur_controller(
    model: str = "ur5", seed: int = 0, *, address: str | None = None, **options: Any
) -> Iterator[UrController]:
    """Start a mock UR controller, wait until it is ready, end it.

    Args:
        model: `ur3`, `ur5`, `ur10` (CB3) or `ur3e`, `ur5e`, `ur10e` (e-Series).
        seed: Which individual.
        address: A loopback address; a free one without.
        **options: Further ones of `hil mock ur`, with `_` for `-`: `speed=10`,
            `start_q_deg=[0, -90, 90, 0, 90, 0]`, `faults=[{"kind": "cut", "at_s": 2}]`, …

    Raises:
        PluginError: An extra is missing, or it does not start with these options.
    """
    require_extras("the mock UR controller", "mock")
    host = address or free_address()
    given = {"model": model, "seed": seed, "address": host, **options}
    with own_folder() as folder, running("ur", given, folder) as (process, journal):
        controller = UrController(host, model, process, journal)
        try:
            yield controller
        finally:
            controller.end()


def free_address() -> str:
    """A loopback address on which all ports of a controller are free.

    Raises:
        PluginError: There is none.
    """
    for _ in range(_TRIES):
        numbers = (1 + secrets.randbelow(250) for _ in range(3))
        address = "127." + ".".join(map(str, numbers))
        if all(_free(address, port) for port in PORTS):
            return address
    raise PluginError(
        "no loopback address is free for a UR controller",
        hint="this needs Linux, where all of 127.0.0.0/8 is the computer itself; else address=",
    )


def _free(address: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True
