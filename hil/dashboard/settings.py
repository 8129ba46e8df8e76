"""Settings of a dashboard: the folders it shows, the address it listens on, and who may do what."""

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
        runs: The folder of runs.
        registry: The folder of registered models.
        specs: Folder below which specs, stations and schedules are offered; None offers none.
        schedules: Where schedules keep their state, `schedules/NAME` by default.
        host: Address it listens on.
        port: Port it listens on; 0 until it is known.
        names: Host names besides `host` by which browsers may call it.
        token: Token that a visitor has to show; empty if all who reach it may look.
        token_given: Whether the user has chosen the token; then it is printed nowhere.
        read_only: Whether starting, stopping and answering are refused.
        csrf: Secret in every form of ours, which no other site can read.
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
        """Return whether only this computer reaches it."""
        return is_loopback(self.host)

    @property
    def called(self) -> tuple[str, ...]:
        """Names besides `host`: `names`, and for a wildcard that of this computer."""
        return (*self.names, socket.gethostname()) if is_wildcard(self.host) else self.names

    @property
    def cookie(self) -> str:
        """Name of the token's cookie: with the port, as a browser shares cookies between ports."""
        return f"hil_{self.port}"

    def knows(self, host: str) -> bool:
        """Return whether a `Host` header is a name of ours; a foreign name that leads here attacks.

        Args:
            host: As the browser sent it, with or without a port.
        """
        called = _HOST.fullmatch(host.lower())
        name = called[1] if called else ""
        if name and name in {"localhost", self.host.lower(), *map(str.lower, self.called)}:
            return True
        try:
            address = ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return False
        # An address is not looked up by DNS, so it cannot be made to lead elsewhere.
        return address.is_loopback or not self.loopback


def settings_of(request: Request) -> Settings:
    """Return the settings of the dashboard that a request has reached."""
    settings: Settings = request.app.state.settings
    return settings


SHORTEST_TOKEN = 16
"""Characters of a token that cannot be found by trying."""


def token_for(host: str, chosen: str) -> str:
    """Return the token that visitors have to show; empty if none is needed.

    Args:
        host: Address to listen on. On loopback no token is needed.
        chosen: The user's token; empty for none, in which case a new one is made.

    Raises:
        SpecError: A whole network could find the user's token by trying.
    """
    if is_loopback(host):
        return chosen
    if chosen and len(chosen) < SHORTEST_TOKEN:
        raise SpecError(
            f"$HIL_TOKEN has {len(chosen)} characters, and whoever reaches this computer may try",
            hint=f"give it {SHORTEST_TOKEN} or more: HIL_TOKEN=$(openssl rand -hex 16)",
        )
    return chosen or secrets.token_urlsafe(24)


def is_wildcard(host: str) -> bool:
    """Return whether it stands for every address of this computer; a browser cannot open it."""
    try:
        return not host or ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
