"""AMS over TCP: connections, and their byte streams cut into requests wherever they were split.

pyads' `AdsTestServer` takes whatever one `recv` of 4096 bytes gives for one request, keeps all
requests in memory, and a request it cannot serve ends the conversation.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from typing import Protocol

from pyads.testserver import AmsResponseData
from pyads.testserver.testserver import AdsClientConnection

from hil.core import PluginError

ADS_PORT = 48898
LONGEST = 8_000_000
"""A request that says to be longer is none [bytes]."""

_HEAD = struct.Struct("<HI")
_SHORTEST = 32


class Answers(Protocol):
    """What `pyads.testserver` calls a handler."""

    def handle_request(self, request: object) -> AmsResponseData:
        """The answer to one request."""


class Links:
    """Everybody who is connected to the PLC.

    Args:
        address: Loopback address to listen on.
        answers: Answers requests.
        port: TCP port.

    Attributes:
        silent: Whether requests are left unanswered: they are kept until they are.

    Raises:
        PluginError: The port is taken.
    """

    def __init__(self, address: str, answers: Answers, port: int = ADS_PORT) -> None:
        self._address, self._port, self._answers = address, port, answers
        self._received: dict[socket.socket, bytes] = {}
        self._listening: socket.socket | None = None
        self.silent = False
        self.listen()

    def listen(self) -> None:
        """Open the port, if it is not."""
        if self._listening is not None:
            return
        try:
            self._listening = socket.create_server((self._address, self._port), backlog=16)
        except OSError as error:
            raise PluginError(
                f"{self._address}:{self._port} cannot be used: {error.strerror}",
                hint="is another mock PLC running? give this one another --address",
            ) from error

    def cut(self) -> None:
        """Hang up on everybody and let nobody in, until `listen`."""
        for line in [*self._received, *([self._listening] if self._listening else [])]:
            line.close()
        self._received.clear()
        self._listening = None

    def serve(self, wait_s: float) -> None:
        """Answer what has come, or comes within that wall time [s]."""
        listening = [self._listening] if self._listening else []
        readable, _, _ = select.select([*listening, *self._received], [], [], max(0.0, wait_s))
        for line in readable:
            if line is self._listening:
                self._accept(line)
            else:
                self._receive(line)
        if not self.silent:
            for line in list(self._received):
                self._answer(line)

    def _accept(self, listening: socket.socket) -> None:
        with contextlib.suppress(OSError):
            line, _ = listening.accept()
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            line.settimeout(1.0)  # for sending: a client that does not take its answers is let go
            self._received[line] = b""

    def _receive(self, line: socket.socket) -> None:
        try:
            data = line.recv(1 << 20)
        except OSError:
            data = b""
        if data:
            self._received[line] += data
        else:
            self._hang_up(line)

    def _answer(self, line: socket.socket) -> None:
        """Every whole request that has come."""
        data, at = self._received[line], 0
        while len(data) - at >= _HEAD.size:
            _, length = _HEAD.unpack_from(data, at)
            if not _SHORTEST <= length <= LONGEST:
                self._hang_up(line)
                return
            end = at + _HEAD.size + length
            if len(data) < end:
                break
            request = AdsClientConnection.construct_request(data[at:end])
            response = self._answers.handle_request(request)
            answer = AdsClientConnection.construct_response(response, request)
            at = end
            try:
                line.sendall(answer)
            except OSError:
                self._hang_up(line)
                return
        if at:
            self._received[line] = data[at:]

    def _hang_up(self, line: socket.socket) -> None:
        self._received.pop(line, None)
        line.close()
