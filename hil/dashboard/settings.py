"""Settings of a dashboard: folders, listening address, and access rights."""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hil.core import SpecError
from hil.robot import is_loopback

if TYPE_CHECKING:
    from starlette.requests import Request

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8350
_HOST = re.compile(r"(\[[^\[\]]*\]|[^\[\]:]+)(:[0-9]*)?")


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of one dashboard.

    Attributes:
        runs: Path of the folder of runs.
        registry: Path of the folder of registered models.
        specs: Folder whose specs, stations and schedules are offered on pages; None if no files are
            offered.
        schedules: Folder with the states of schedules, by default one folder `schedules/NAME` for
            each schedule.
        host: Listening address.
        port: Number of the listening port; 0 until the port is known.
        names: Additional host names under which browsers may access the dashboard.
        token: Token that a visitor must present; empty if no token is required.
        token_given: Whether the user has chosen the token; a token chosen by the user is never
            printed.
        read_only: Whether requests to start, stop or answer a run are rejected.
        csrf: Secret that every form contains and that no other site can read.
    """

    runs: Path
    registry: Path
    specs: Path | None = None
    schedules: Path = Path("schedules")
    host: str = LOOPBACK
    port: int = 0
    names: tuple[str, ...] = ()
    token: str = field(default="", repr=False)
    token_given: bool = False
    read_only: bool = False
    csrf: str = field(default_factory=lambda: secrets.token_urlsafe(24), repr=False)

    @property
    def loopback(self) -> bool:
        """Whether only this computer can access the dashboard."""
        return is_loopback(self.host)

    @property
    def called(self) -> tuple[str, ...]:
        """Host names in addition to `host`: `names`, and this computer's name for a wildcard."""
        return (*self.names, socket.gethostname()) if is_wildcard(self.host) else self.names

    @property
    def cookie(self) -> str:
        """Name of the token's cookie; it contains the port, because ports share their cookies."""
        return f"hil_{self.port}"

    def knows(self, host: str) -> bool:
        """Return whether a `Host` header contains a known name; other names are possibly an attack.

        Args:
            host: Value of the `Host` header as sent by the browser, with or without a port.
        """
        called = _HOST.fullmatch(host.lower())
        name = called[1] if called else ""
        if name and name in {"localhost", self.host.lower(), *map(str.lower, self.called)}:
            return True
        try:
            address = ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return False
        # An IP address needs no DNS lookup, so it cannot be redirected.
        return address.is_loopback or not self.loopback


def settings_of(request: Request) -> Settings:
    """Return the settings of the dashboard that has received a request."""
    settings: Settings = request.app.state.settings
    return settings


SHORTEST_TOKEN = 16
"""Minimum number of characters of a token, to prevent brute-force attacks."""


def token_for(host: str, chosen: str) -> str:
    """Return the token that visitors must present; empty if no token is required.

    Args:
        host: Listening address. No token is required on the loopback interface.
        chosen: Token chosen by the user; if empty, a new token is created.

    Raises:
        SpecError: The token chosen by the user is too short to resist brute-force attacks from the
            network.
    """
    if is_loopback(host):
        return chosen
    if chosen and len(chosen) < SHORTEST_TOKEN:
        raise SpecError(
            f"$HIL_TOKEN has {len(chosen)} characters: it can be guessed over the network",
            hint=f"use at least {SHORTEST_TOKEN}: HIL_TOKEN=$(openssl rand -hex 16)",
        )
    return chosen or secrets.token_urlsafe(24)


def is_wildcard(host: str) -> bool:
    """Return whether a host means all addresses of the computer, which browsers cannot open."""
    try:
        return not host or ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
