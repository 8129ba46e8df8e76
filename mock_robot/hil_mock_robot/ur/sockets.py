"""Non-blocking sockets: the controller's end of a connection, and its open ports."""

from __future__ import annotations

import socket
import time

from hil.core import PluginError

MOST_PENDING = 4_000_000
"""Bytes that wait for a client that does not read; the connection is closed beyond that."""

RTDE_PORT = 30004
"""Every mock has it, whatever else it listens on."""


class TcpLink:
    """A non-blocking socket with a buffer; implements `Link`.

    Args:
        connection: The socket.
        peer: Address of the client.
        port: On which it came in.

    Attributes:
        blocked: Whether nothing gets through; it is kept meanwhile.
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
        """Bytes that wait for the client to read."""
        return len(self._waiting)

    @property
    def deaf_s(self) -> float:
        """Wall time for which the client has taken nothing of what waits."""
        return time.monotonic() - self._read_at if self._waiting else 0.0

    def send(self, data: bytes) -> None:
        """Send, or keep what the client does not take yet."""
        if self.closed:
            return
        if not self._waiting:
            self._read_at = time.monotonic()
        self._waiting += data
        self.flush()
        if len(self._waiting) > MOST_PENDING:
            self.close()

    def flush(self) -> None:
        """Hand over what waits, as far as the client takes it."""
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
        """Hang up."""
        if not self.closed:
            self.closed = True
            self.socket.close()


def listen(address: str, port: int) -> socket.socket:
    """An open port.

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
