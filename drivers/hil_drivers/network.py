"""Functions for the network address of a controller: normalization, name resolution, waiting.

`host_of` normalizes the address in a station file, so that two stations with the same controller
have equal addresses. A host name is resolved only when the controller is connected
(`ip_address_of`), with a time limit, because later stops must not wait for a name server.
`once_listening` waits for a mock that is still starting on this computer. `once_listening` does not
wait for a controller across a network: if such a controller refuses a connection, the controller is
off or the interface is disabled.
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
"""Longest wait for the answer of a name server [s]."""

STARTING_S = 10.0
"""Time for which a connection is retried that this computer refuses [s].

On a busy computer the mock needs 6 s to start.
"""

AGAIN_S = 0.1

_HOST_NAME = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?(\.[a-z0-9]([a-z0-9-]*[a-z0-9])?)*")

T = TypeVar("T")


def host_of(text: str) -> str | None:
    """Return an IP address or host name in normalized form; None for any other text.

    Args:
        text: IP address or host name, without a port.
    """
    text = text.strip().lower()
    if is_ip(text):
        return str(ipaddress.ip_address(text))
    numeric = re.fullmatch(r"[0-9.]+", text)  # a misspelled IP address is not a host name
    return text if _HOST_NAME.fullmatch(text) and not numeric else None


def is_ip(text: str) -> bool:
    """Return whether a text is an IP address and not a host name."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def ip_address_of(host: str, within_s: float = NAME_SERVER_S) -> str:
    """Return the IP address of a controller, for a host name from the name server.

    Args:
        host: IP address or host name.
        within_s: Maximum wall time for the resolution [s].

    Raises:
        RobotConnectionError: The name is unknown, or no name server has answered in time.
    """
    if is_ip(host):
        return str(ipaddress.ip_address(host))
    answers: list[str | OSError] = []

    def ask() -> None:
        try:
            # UR controllers and `ur-rtde` use IPv4.
            found = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_STREAM)
            answers.append(str(found[0][4][0]))
        except OSError as error:
            answers.append(error)

    # A separate thread, because a request to a name server can block.
    asking = threading.Thread(target=ask, name=f"find {host}", daemon=True)
    asking.start()
    asking.join(within_s)
    answer = answers[0] if answers else f"no answer within {within_s:g} s"
    if answers and isinstance(answer, str):
        return answer
    why = (answer.strerror or answer) if isinstance(answer, OSError) else answer
    raise RobotConnectionError(
        f"the controller's host name {host!r} cannot be resolved: {why}",
        hint=f"correct the name in the station file (`ping {host}` shows whether it exists), or "
        "enter the IP address that the controller's network settings show",
    )


def once_listening(host: str, connect: Callable[[], T], within_s: float | None = None) -> T:
    """Call `connect` and return its result; retry while this computer refuses the connection.

    Args:
        host: IP address of the controller.
        connect: Function that raises `RobotConnectionError` because of a `ConnectionRefusedError`.
        within_s: Maximum wall time [s]; `STARTING_S` by default.

    Raises:
        RobotConnectionError: The last call of `connect` failed; raised without retries if the
            controller is not on this computer.
    """
    until = time.monotonic() + (STARTING_S if within_s is None else within_s)
    while True:
        try:
            return connect()
        except RobotConnectionError as error:
            # On a loopback address, `hil mock … &` is probably still starting.
            refused = isinstance(error.__cause__, ConnectionRefusedError)
            here = refused and ipaddress.ip_address(host).is_loopback
            if not here or time.monotonic() >= until:
                raise
        time.sleep(AGAIN_S)


def peer_of(host: str, port: int, within_s: float) -> str:
    """Return the IP address of a host that accepts a TCP connection, which is closed again.

    Raises:
        OSError: No address of the host accepted a connection in time.
    """
    with socket.create_connection((host, port), within_s) as line:
        return str(line.getpeername()[0])


def reason(error: OSError) -> str:
    """Return a text, never empty, that describes why a connection failed."""
    return error.strerror or str(error) or type(error).__name__


def mock_first(host: str, mock: str) -> str:
    """Return the first part of a hint for a missing answer, for this computer about the mock.

    Args:
        host: IP address or host name in the station file.
        mock: Name of the mock robot, such as `ur`.
    """
    start = f"start the mock first: hil mock {mock}; if a port is forwarded, "
    return start if is_loopback(host) else ""
