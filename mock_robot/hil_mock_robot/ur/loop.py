"""Main loop of the mock controller: one thread serves sockets between ticks, without locks.

`Loop` contains the ports, `Conversations` the connections and their sessions (`connections`). A
pacer decides when the next tick is due (`pacing`).
"""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Iterable

from hil_mock_robot.server import loop
from hil_mock_robot.server.loop import Mishaps
from hil_mock_robot.ur.connections import Service, Session, TcpLink, listen
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.journal import Witness
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.pacing import Pacer
from hil_mock_robot.ur.side import SideService

LONGEST_WAIT_S = 0.5

DEAF_S = 10.0
"""Wall time after which a lossless client that does not read is disconnected [s]."""


class Loop(loop.Loop):
    """Server of the ports of a machine; the server also advances the device time of the machine.

    Args:
        machine: Simulated controller.
        services: Services of the controller's ports.
        pacer: Pacer that decides when ticks are due.
        address: Loopback address to listen on.
        faults: Fault schedule of the mock.
        witness: Writer of the journal.
        side: Side channel, which is not part of the controller and is served during any fault.

    Raises:
        PluginError: A port is in use.
    """

    def __init__(
        self,
        machine: Machine,
        services: Iterable[Service],
        pacer: Pacer,
        address: str,
        *,
        faults: UrFaults | None = None,
        witness: Witness | None = None,
        side: SideService | None = None,
    ) -> None:
        super().__init__()
        self._machine, self._pacer, self._address = machine, pacer, address
        self._services, self._side = list(services), side
        self._faults, self._witness = faults or UrFaults(machine), witness
        self._listening: dict[socket.socket, Service] = {}
        self._talks = Conversations(machine.mishaps, witness)
        self.sessions = self._talks.sessions
        self._dark = False
        self._suffered: tuple[bool, frozenset[int], bool] = (False, frozenset(), False)
        self._open([*([side] if side is not None else []), *self._services])

    def leave(self) -> None:
        """Close all connections and the journal."""
        for each in [*self._listening, *self.sessions]:
            each.close()
        if self._witness is not None:
            self._witness.close(set_points=self._witness.sent)

    def turn(self) -> None:
        """Serve the clients, and execute a tick if a tick is due."""
        self._suffer()
        waiting = self._waits_for_client()
        wait = None if waiting else self._pacer.wait_s()
        self._serve(LONGEST_WAIT_S if wait is None else min(wait, LONGEST_WAIT_S))
        wait = self._pacer.wait_s()
        if not waiting and wait is not None and wait <= 0:
            self._tick()

    def _tick(self) -> None:
        self._faults.tick()
        self._suffer()
        if not self._dark:
            self._machine.tick()
        self._pacer.ticked()
        self._talks.ticked()
        if self._witness is not None:
            self._witness.ticked()
        if self._side is not None:
            self._side.ticked()

    def _suffer(self) -> None:
        """Apply the present faults to the ports."""
        struck = self._faults.mock
        now = (struck.unplugged, struck.mute, struck.dark)
        if now == self._suffered:
            return
        self._suffered = now
        for link, _ in self.sessions.values():
            link.blocked = self._unheard(link.port)
        if struck.dark and not self._dark:
            self._shut()
        elif self._dark and not struck.dark:
            self._open(self._services)
        self._dark = struck.dark

    def _unheard(self, port: int) -> bool:
        if self._side is not None and port == self._side.port:
            return False
        return self._faults.mock.unplugged or port in self._faults.mock.mute

    def _open(self, services: Iterable[Service]) -> None:
        # Open RTDE last: a client that can connect to RTDE can then also connect to the other
        # ports.
        for service in reversed(list(services)):
            self._listening[listen(self._address, service.port)] = service

    def _shut(self) -> None:
        """Close every port of the controller and all connections to the ports."""
        for each in [s for s, service in self._listening.items() if service is not self._side]:
            del self._listening[each]
            each.close()
        for link, _ in self.sessions.values():
            if self._side is None or link.port != self._side.port:
                link.close()
        self._talks.forget_closed()

    def _waits_for_client(self) -> bool:
        """Return whether device time waits for a client; disconnect a client that does not read."""
        waiting = False
        for link, session in self.sessions.values():
            if not session.lossless or not link.pending:
                continue
            if link.deaf_s > DEAF_S:
                link.close()
            waiting = waiting or not link.blocked
        return waiting and self._pacer.patient

    def _serve(self, wait_s: float) -> None:
        self._talks.forget_closed()
        heard = [s for s, (link, _) in self.sessions.items() if not link.blocked]
        ports = [s for s, service in self._listening.items() if not self._unheard(service.port)]
        waiting = [s for s in heard if self.sessions[s][0].pending]
        readers = [*ports, *heard, self.woken]
        readable, writable, _ = select.select(readers, waiting, [], max(0.0, wait_s))
        for each in writable:
            self.sessions[each][0].flush()
        for each in readable:
            if each in self._listening:
                self._talks.accept(each, self._listening[each])
            elif each in self.sessions:
                self._talks.receive(each)
        self._talks.forget_closed()


MOST_SESSIONS = 200
READ_BYTES = 65_536


class Conversations:
    """Connections of clients and their sessions.

    If the mock fails on a connection, only the affected connection is closed.

    Args:
        mishaps: Recorder of internal errors of the mock.
        witness: Writer of the journal; None for no journal.

    Attributes:
        sessions: Map from the socket of a client to its link and session.
    """

    def __init__(self, mishaps: Mishaps, witness: Witness | None) -> None:
        self._mishaps, self._witness = mishaps, witness
        self.sessions: dict[socket.socket, tuple[TcpLink, Session]] = {}

    def accept(self, listening: socket.socket, service: Service) -> None:
        """Accept a client."""
        with contextlib.suppress(OSError):
            connection, (peer, *_) = listening.accept()
            if len(self.sessions) >= MOST_SESSIONS:
                connection.close()
                return
            self._welcome(service, TcpLink(connection, peer, service.port))

    def receive(self, connection: socket.socket) -> None:
        """Read data from a client, which has possibly closed the connection."""
        link, session = self.sessions[connection]
        try:
            data = connection.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            link.close()
            return
        try:
            if self._witness is not None:
                self._witness.received(link, data)
            session.received(data)
        except Exception as error:
            self._give_up(link, error)

    def ticked(self) -> None:
        """Let all sessions send the data that are due after a tick."""
        for link, session in list(self.sessions.values()):
            try:
                session.ticked()
            except Exception as error:
                self._give_up(link, error)

    def forget_closed(self) -> None:
        """Remove closed connections."""
        for connection in [s for s, (link, _) in self.sessions.items() if link.closed]:
            link, session = self.sessions.pop(connection)
            try:
                session.hung_up()
            except Exception as error:
                self._give_up(link, error)
            if self._witness is not None:
                self._witness.disconnected(link)

    def _welcome(self, service: Service, link: TcpLink) -> None:
        if self._witness is not None:
            self._witness.connected(link)
        try:
            self.sessions[link.socket] = (link, service.accept(link))
        except Exception as error:
            self._give_up(link, error)
            if self._witness is not None:
                self._witness.disconnected(link)

    def _give_up(self, link: TcpLink, error: Exception) -> None:
        """Close one connection after an internal error of the mock; keep the other connections."""
        link.close()
        self._mishaps.met(error, f"a connection to port {link.port}")
