"""What a dashboard shows, and who may do what with it."""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from pathlib import Path

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8350
_HOST = re.compile(r"(\[[^\[\]]*\]|[^\[\]:]+)(:[0-9]*)?")


@dataclass(frozen=True, slots=True)
class Settings:
    """One dashboard.

    Attributes:
        runs: The folder of runs.
        registry: The folder of registered models.
        specs: Folder below which specs, stations and schedules are offered; None offers none.
        schedules: Where schedules keep their state, `schedules/NAME` by default.
        host: Address it listens on.
        port: Port it listens on, 0 while nobody knows.
        names: Host names besides `host` under which it may be called.
        token: What a visitor has to show; empty where everybody who reaches it may look.
        token_given: The token is somebody's own, who knows it: it is printed nowhere.
        read_only: Nothing can be asked of a run, none be started.
        csrf: Shown by every form of ours, and known to no other site.
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
        """Whether only this computer reaches it."""
        return is_loopback(self.host)

    @property
    def called(self) -> tuple[str, ...]:
        """Names besides `host`: those given, and for a wildcard that of this computer."""
        return (*self.names, socket.gethostname()) if is_wildcard(self.host) else self.names

    @property
    def cookie(self) -> str:
        """Name of the cookie; browsers do not tell the ports of one host apart."""
        return f"hil_{self.port}"

    def knows(self, host: str) -> bool:
        """Whether a request's `Host` is one of ours: a foreign name that leads here is an attack.

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
        # No DNS is asked for an address, so nobody can lend it another meaning.
        return address.is_loopback or not self.loopback


def is_loopback(host: str) -> bool:
    """Whether an address or name is that of this computer for itself."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def is_wildcard(host: str) -> bool:
    """Whether it stands for every address of this computer, and is none to be opened."""
    try:
        return not host or ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
