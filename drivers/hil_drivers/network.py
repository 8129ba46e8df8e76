"""Where a controller is: its address in a station file, its name, its ports.

Stations write an address as a person types it; `host_of` brings it into one form, so that two
stations that mean one controller say the same. A name is resolved once, when the controller is
connected to (`ip_address_of`), with a limit on the time: later stops must not wait for a name
server. A mock that is still starting on this computer is waited for (`once_listening`). A
controller across a network that refuses a connection is off or has the interface disabled: there
waiting is in vain.
"""

from __future__ import annotations

import ipaddress
import re
import socket
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from hil.core import RobotConnectionError
from hil.robot import is_loopback

NAME_SERVER_S = 5.0
"""How long a name server may take [s]."""

STARTING_S = 10.0
"""How long a refused loopback connection is tried again: a busy machine takes 6 s to start the
mock [s]."""

AGAIN_S = 0.1

_HOST_NAME = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?(\.[a-z0-9]([a-z0-9-]*[a-z0-9])?)*")

T = TypeVar("T")


def host_of(text: str) -> str | None:
    """Return an IP address or host name in the one form it is compared in; None if it is neither.

    Args:
        text: Without a port.
    """
    text = text.strip().lower()
    if is_ip(text):
        return str(ipaddress.ip_address(text))
    numeric = re.fullmatch(r"[0-9.]+", text)  # a misspelt IP address is no host name
    return text if _HOST_NAME.fullmatch(text) and not numeric else None


def is_ip(text: str) -> bool:
    """Return whether this is an IP address rather than a host name."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def ip_address_of(host: str, within_s: float = NAME_SERVER_S) -> str:
    """Return the IP address of a controller; no name server is asked for one written as such.

    Args:
        host: IP address or host name.
        within_s: Wall time this may take.

    Raises:
        RobotConnectionError: The name is unknown, or no name server has answered in time.
    """
    if is_ip(host):
        return str(ipaddress.ip_address(host))
    answers: list[str | OSError] = []

    def ask() -> None:
        try:
            # UR controllers and `ur-rtde` speak IPv4.
            found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)
            answers.append(str(found[0][4][0]))
        except OSError as error:
            answers.append(error)

    # A name server that hangs holds this thread only.
    asking = threading.Thread(target=ask, name=f"find {host}", daemon=True)
    asking.start()
    asking.join(within_s)
    answer = answers[0] if answers else f"no answer within {within_s:g} s"
    if answers and isinstance(answer, str):
        return answer
    why = (answer.strerror or answer) if isinstance(answer, OSError) else answer
    raise RobotConnectionError(
        f"the controller's host name {host!r} leads to no address: {why}",
        hint=f"mend the name in the station file (`ping {host}` shows whether it is one), or "
        "give the IP address there that the controller's network settings show",
    )


def once_listening(host: str, connect: Callable[[], T], within_s: float | None = None) -> T:
    """Return what `connect` returns, tried again while a port of this computer refuses it.

    Args:
        host: IP address of the controller.
        connect: Raises `RobotConnectionError` because of a `ConnectionRefusedError`.
        within_s: Wall time this may take, by default `STARTING_S`.

    Raises:
        RobotConnectionError: The last one that `connect` has raised; at once where waiting is in
            vain.
    """
    until = time.monotonic() + (STARTING_S if within_s is None else within_s)
    while True:
        try:
            return connect()
        except RobotConnectionError as error:
            # On a loopback address the likely reason is `hil mock … &` a moment ago.
            refused = isinstance(error.__cause__, ConnectionRefusedError)
            here = refused and ipaddress.ip_address(host).is_loopback
            if not here or time.monotonic() >= until:
                raise
        time.sleep(AGAIN_S)


def peer_of(host: str, port: int, within_s: float) -> str:
    """Return the IP address that accepts a connection at a TCP port, which is closed again.

    Raises:
        OSError: None does in time.
    """
    with socket.create_connection((host, port), within_s) as line:
        return str(line.getpeername()[0])


def reason(error: OSError) -> str:
    """Return why a connection failed, never empty."""
    return error.strerror or str(error) or type(error).__name__


def mock_first(host: str, mock: str) -> str:
    """Return the beginning of a hint where nothing answers: on loopback a mock is missing.

    Args:
        host: Address or name, as the station has it.
        mock: Name of the mock robot, such as `ur`.
    """
    return f"start it first: hil mock {mock}; if a port is forwarded, " if is_loopback(host) else ""
