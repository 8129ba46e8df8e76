"""Connections of clients to the mock controller, and the services that they talk to.

A `Service` listens on one port; it accepts a `Link` to each client and returns the `Session` that
answers it. `TcpLink` is a link over a socket; that of RTDE is wrapped once more, so that faults may
act on it (`rtde_wire.LineEnd`).
"""

from __future__ import annotations

import socket
import time
from typing import Protocol

from hil.core import PluginError


class Link(Protocol):
    """The controller's end of one connection; never blocks.

    Attributes:
        peer: Address of the client.
    """

    peer: str

    @property
    def closed(self) -> bool:
        """Whether the connection has ended."""

    @property
    def pending(self) -> int:
        """Bytes that wait for the client to read."""

    def send(self, data: bytes) -> None:
        """Send; data that the client does not take yet are kept."""

    def close(self) -> None:
        """Send the data that can be sent at once, then close the connection."""


class Session(Protocol):
    """The conversation with one client."""

    @property
    def lossless(self) -> bool:
        """Whether accelerated time waits until this client has taken all data."""

    def received(self, data: bytes) -> None:
        """Handle bytes from the client; a message may arrive in pieces."""

    def ticked(self) -> None:
        """Send the data that are due after a tick of the controller."""

    def hung_up(self) -> None:
        """Handle the end of the connection."""


class Service(Protocol):
    """The service on one port.

    Attributes:
        port: TCP port, as UR clients expect it.
    """

    port: int

    def accept(self, link: Link) -> Session:
        """Begin the conversation with a client that has connected."""


MOST_PENDING = 4_000_000
"""Bytes that wait for a client that does not read; the connection is closed beyond that."""


class TcpLink:
    """A non-blocking socket with a buffer; implements `Link`.

    Args:
        connection: The socket.
        peer: Address of the client.
        port: On which it came in.

    Attributes:
        blocked: Whether nothing gets through; data are kept meanwhile.
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
        """Wall time since the client last took waiting data [s]; 0 if none wait."""
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
        """Send waiting data, as far as the client takes them."""
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
"""Port of RTDE, on which every mock listens."""


def listen(address: str, port: int) -> socket.socket:
    """Open a port.

    Raises:
        PluginError: It is taken.
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
