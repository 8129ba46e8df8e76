"""One thread for everything: sockets are served between ticks, so nothing needs a lock."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Iterable
from typing import Protocol

from hil.errors import PluginError
from hil_mock_robot.ur.contracts import Service, Session
from hil_mock_robot.ur.machine import Machine

READ_BYTES = 65_536
MOST_PENDING = 4_000_000
"""Bytes that wait for a client that does not read; the connection is closed beyond that."""

MOST_SESSIONS = 200
DEAF_S = 10.0
"""Wall time a client that is sent everything may leave it unread; it is hung up on then."""

LONGEST_WAIT_S = 0.5


class Pacer(Protocol):
    """Says when the next tick is due."""

    @property
    def patient(self) -> bool:
        """Whether time waits for clients that must not lose anything; the wall clock does not."""

    def wait_s(self) -> float | None:
        """Wall time until the next tick: 0 when it is due, None as long as nothing permits it."""

    def ticked(self) -> None:
        """A tick was made."""


class TcpLink:
    """A non-blocking socket with a buffer; implements `Link`."""

    def __init__(self, connection: socket.socket, peer: str) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket, self.peer = connection, peer
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
        if not self._waiting or self.closed:
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


class Loop:
    """Serves a machine's ports and lets its time pass.

    Args:
        machine: The controller.
        services: What listens.
        pacer: When ticks are due.
        address: Loopback address to listen on.

    Raises:
        PluginError: A port is taken.
    """

    def __init__(
        self, machine: Machine, services: Iterable[Service], pacer: Pacer, address: str
    ) -> None:
        self._machine, self._pacer = machine, pacer
        self._listening: dict[socket.socket, Service] = {}
        self.sessions: dict[socket.socket, tuple[TcpLink, Session]] = {}
        self._ending = False
        self._woken, self._waker = socket.socketpair()
        for service in services:
            self._listening[_listen(address, service.port)] = service

    def run(self) -> None:
        """Until `end`."""
        try:
            while not self._ending:
                self.turn()
        finally:
            self.close()

    def end(self) -> None:
        """Let `run` return; may be called by a signal handler."""
        self._ending = True
        with contextlib.suppress(OSError):
            self._waker.send(b"x")

    def close(self) -> None:
        """Hang up on everybody."""
        for each in [*self._listening, *self.sessions, self._woken, self._waker]:
            each.close()

    def turn(self) -> None:
        """Serve what has come, and tick when that is due."""
        held = self._held()
        wait = None if held else self._pacer.wait_s()
        self._serve(LONGEST_WAIT_S if wait is None else min(wait, LONGEST_WAIT_S))
        wait = self._pacer.wait_s()
        if held or wait is None or wait > 0:
            return
        self._machine.tick()
        self._pacer.ticked()
        for _, session in list(self.sessions.values()):
            session.ticked()

    def _held(self) -> bool:
        """Whether time waits for a client; one that does not read at all is hung up on."""
        held = False
        for link, session in self.sessions.values():
            if not session.lossless or not link.pending:
                continue
            if link.deaf_s > DEAF_S:
                link.close()
            held = True
        return held and self._pacer.patient

    def _serve(self, wait_s: float) -> None:
        self._forget_closed()
        waiting = [s for s, (link, _) in self.sessions.items() if link.pending]
        everybody = [*self._listening, *self.sessions, self._woken]
        readable, writable, _ = select.select(everybody, waiting, [], max(0.0, wait_s))
        for each in writable:
            self.sessions[each][0].flush()
        for each in readable:
            if each in self._listening:
                self._accept(each)
            elif each in self.sessions:
                self._receive(each)
        self._forget_closed()

    def _accept(self, listening: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection, (peer, *_) = listening.accept()
            if len(self.sessions) >= MOST_SESSIONS:
                connection.close()
                return
            link = TcpLink(connection, peer)
            self.sessions[connection] = (link, self._listening[listening].accept(link))

    def _receive(self, connection: socket.socket) -> None:
        link, session = self.sessions[connection]
        try:
            data = connection.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            session.received(data)
        else:
            link.close()

    def _forget_closed(self) -> None:
        for connection in [s for s, (link, _) in self.sessions.items() if link.closed]:
            _, session = self.sessions.pop(connection)
            session.hung_up()


def _listen(address: str, port: int) -> socket.socket:
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((address, port))
    except OSError as error:
        listening.close()
        raise PluginError(
            f"cannot listen on {address}:{port}: {error.strerror}",
            hint="another mock or simulator runs there: use another address, --address 127.0.0.2",
        ) from error
    listening.listen()
    listening.setblocking(False)
    return listening
