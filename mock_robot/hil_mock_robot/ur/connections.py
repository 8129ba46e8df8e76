"""Connections of clients to the mock controller, and interfaces of its services.

A `Service` listens on one port. For each client, the service accepts a `Link` and returns the
`Session` that answers the client. `TcpLink` is a link over a socket. The link of an RTDE client is
wrapped in a further link that injects faults (`rtde_wire.LineEnd`).
"""

from __future__ import annotations

import socket
import time
from typing import Protocol

from hil.core import PluginError


class Link(Protocol):
    """Controller side of one connection; its methods never block.

    Attributes:
        peer: Address of the client.
    """

    peer: str

    @property
    def closed(self) -> bool:
        """Whether the connection has ended."""

    @property
    def pending(self) -> int:
        """Number of bytes that wait for the client to read."""

    def send(self, data: bytes) -> None:
        """Send data; data that the client does not accept yet are buffered."""

    def close(self) -> None:
        """Send the data that can be sent at once, then close the connection."""


class Session(Protocol):
    """Communication with one client."""

    @property
    def lossless(self) -> bool:
        """Whether accelerated time waits until this client has received all data."""

    def received(self, data: bytes) -> None:
        """Handle received bytes; a message can arrive in several pieces."""

    def ticked(self) -> None:
        """Send the data that are due after a tick of the controller."""

    def hung_up(self) -> None:
        """Handle the end of the connection."""


class Service(Protocol):
    """Service of the mock controller on one TCP port.

    Attributes:
        port: TCP port that UR clients expect.
    """

    port: int

    def accept(self, link: Link) -> Session:
        """Begin the session of a client that has connected."""


MOST_PENDING = 4_000_000
"""Maximum number of bytes that wait for a client that does not read; beyond it the connection
is closed.
"""


class TcpLink:
    """Non-blocking socket with a send buffer; implements `Link`.

    Args:
        connection: Socket of the connection.
        peer: Address of the client.
        port: TCP port of the service.

    Attributes:
        blocked: Whether sending is blocked, so that all data are buffered.
    """

    def __init__(self, connection: socket.socket, peer: str, port: int = 0) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket, self.peer, self.port = connection, peer, port
        self.blocked = False
        self.closed = False
        self._waiting = bytearray()
        self._read_at = time.monotonic()

    @property
    def pending(self) -> int:
        """See `Link`."""
        return len(self._waiting)

    @property
    def deaf_s(self) -> float:
        """Wall time since the client last accepted waiting data [s]; 0 if no data wait."""
        return time.monotonic() - self._read_at if self._waiting else 0.0

    def send(self, data: bytes) -> None:
        """See `Link`."""
        if self.closed:
            return
        if not self._waiting:
            self._read_at = time.monotonic()
        self._waiting += data
        self.flush()
        if len(self._waiting) > MOST_PENDING:
            self.close()

    def flush(self) -> None:
        """Send as much of the waiting data as the client accepts."""
        if not self._waiting or self.closed or self.blocked:
            return
        try:
            sent = self.socket.send(self._waiting)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        del self._waiting[:sent]
        self._read_at = time.monotonic()

    def close(self) -> None:
        """See `Link`."""
        if not self.closed:
            self.closed = True
            self.socket.close()


RTDE_PORT = 30004
"""TCP port of RTDE, on which every mock UR controller listens."""


def listen(address: str, port: int) -> socket.socket:
    """Return a socket that listens on a port of an address.

    Raises:
        PluginError: The port is in use.
    """
    try:
        listening = _bound(address, port)
    except OSError as error:
        raise PluginError(
            f"cannot listen on {address}:{port}: {error.strerror}", hint=_elsewhere(port)
        ) from error
    listening.listen()
    listening.setblocking(False)
    return listening


def _bound(address: str, port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((address, port))
    except OSError:
        bound.close()
        raise
    return bound


def _elsewhere(port: int) -> str:
    for last in range(2, 255):
        try:
            for each in {port, RTDE_PORT}:
                _bound(f"127.0.0.{last}", each).close()
        except OSError:
            continue
        return (
            "another mock or simulator runs there: end it, or use an address that is free, "
            f"--address 127.0.0.{last}, also in the station"
        )
    return "another mock or simulator runs there: end it"
