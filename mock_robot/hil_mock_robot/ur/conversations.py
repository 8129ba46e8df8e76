"""Everybody who is connected to the mock controller, and what is said."""

from __future__ import annotations

import contextlib
import socket

from hil_mock_robot.mishaps import Mishaps
from hil_mock_robot.ur.contracts import Service, Session
from hil_mock_robot.ur.sockets import TcpLink
from hil_mock_robot.ur.witness import Witness

READ_BYTES = 65_536
MOST_SESSIONS = 200


class Conversations:
    """Connections and their sessions; one that we cannot cope with is hung up on.

    Args:
        mishaps: Who hears of that.
        witness: Writes down who comes, goes and says what.

    Attributes:
        sessions: Socket → its link and session.
    """

    def __init__(self, mishaps: Mishaps, witness: Witness | None) -> None:
        self._mishaps, self._witness = mishaps, witness
        self.sessions: dict[socket.socket, tuple[TcpLink, Session]] = {}

    def accept(self, listening: socket.socket, service: Service) -> None:
        """Somebody has connected."""
        with contextlib.suppress(OSError):
            connection, (peer, *_) = listening.accept()
            if len(self.sessions) >= MOST_SESSIONS:
                connection.close()
                return
            self._welcome(service, TcpLink(connection, peer, service.port))

    def receive(self, connection: socket.socket) -> None:
        """Something has come, or the client has hung up."""
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
        """The controller has made a tick."""
        for link, session in list(self.sessions.values()):
            try:
                session.ticked()
            except Exception as error:
                self._give_up(link, error)

    def forget_closed(self) -> None:
        """Part with those who are not connected any more."""
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
        """A mistake of ours: this client has to do without us, the others do not."""
        link.close()
        self._mishaps.met(error, f"a connection to port {link.port}")
