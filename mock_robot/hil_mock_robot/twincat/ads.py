"""ADS over TCP: connections, and the answers of the server of a PLC.

`PlcHandler` answers requests and has the interface of a handler of the test server in pyads.
`Links` replaces the network part of that test server, which has three defects: it treats the result
of one `recv` of 4096 bytes as one request, stores all requests in memory, and ends the connection
at an unsupported request.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
from collections.abc import Callable
from typing import Any, Protocol

from pyads import constants
from pyads.testserver import AmsResponseData
from pyads.testserver.handler import AbstractHandler
from pyads.testserver.testserver import AdsClientConnection

from hil.core import PluginError
from hil_mock_robot.twincat.memory import DATA, Memory, Symbol, entry_of

RUN, CONFIG = constants.ADSSTATE_RUN, constants.ADSSTATE_CONFIG
NO_SERVICE, NO_GROUP, NO_OFFSET, WRONG_SIZE, NO_SYMBOL = 0x701, 0x702, 0x703, 0x705, 0x710

OTHER_VERSION = 0x711
"""ADS return code for a request with a handle from before an online change."""

NO_PORT = 6
"""AMS error code: the AMS port of a request is not open."""

SHORT = 256
"""Size that separates short writes (commands, beats) from long writes (set-points) [bytes]."""


class Refused(Exception):
    """Error of a request that is answered with an ADS return code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"ADS return code {code:#x}")
        self.code = code


_RESPONSE = 0x0001

_WITH_LENGTH = frozenset({constants.ADSCOMMAND_READ, constants.ADSCOMMAND_READWRITE})
"""Services whose answer contains a length after its return code."""


class PlcHandler(AbstractHandler):  # type: ignore[misc]
    """Handler of ADS requests to one PLC.

    Args:
        memory: Memory of the PLC.
        port: AMS port of the PLC runtime.

    Attributes:
        memory: Memory of the PLC.
        state: Reported ADS state; in any state but RUN, the runtime does not answer.
        spoils: Whether one bit of every long write is corrupted.
        loses_stops: Whether writes to `nStop` are acknowledged but not executed.
    """

    def __init__(self, memory: Memory, port: int) -> None:
        self.memory, self._port = memory, port
        self.spoils = self.loses_stops = False
        self._handles: dict[int, tuple[Symbol, int]] = {}
        self.state = RUN
        self._services: dict[int, Callable[[bytes], bytes]] = {
            constants.ADSCOMMAND_READDEVICEINFO: self._device,
            constants.ADSCOMMAND_READSTATE: self._state,
            constants.ADSCOMMAND_READ: self._read,
            constants.ADSCOMMAND_WRITE: self._write,
            constants.ADSCOMMAND_READWRITE: self._read_write,
        }

    def handle_request(self, request: Any) -> AmsResponseData:
        """Return the answer to one request; see `pyads.testserver.handler.AbstractHandler`."""
        header = request.ams_header
        (flags,) = struct.unpack("<H", header.state_flags)
        (command,) = struct.unpack("<H", header.command_id)
        (port,) = struct.unpack("<H", header.target_port)
        answered = struct.pack("<H", flags | _RESPONSE)
        running = self.state == RUN or command == constants.ADSCOMMAND_READSTATE
        if port != self._port or not running:
            return AmsResponseData(answered, struct.pack("<I", NO_PORT), b"")
        try:
            data = bytes(4) + self.serve(command, header.data)
        except Refused as refused:
            data = struct.pack("<I", refused.code) + bytes(8 * (command in _WITH_LENGTH))
        except (struct.error, UnicodeError):
            data = struct.pack("<I", WRONG_SIZE) + bytes(8 * (command in _WITH_LENGTH))
        return AmsResponseData(answered, bytes(4), data)

    def serve(self, command: int, data: bytes) -> bytes:
        """Return the answer of one service, without its return code.

        Raises:
            Refused: The service answers with an ADS return code.
        """
        service = self._services.get(command)
        if service is None:
            raise Refused(NO_SERVICE)
        return service(data)

    def _device(self, data: bytes) -> bytes:
        return struct.pack("<BBH16s", 3, 1, 4024, b"hil mock plc")

    def _state(self, data: bytes) -> bytes:
        return struct.pack("<HH", self.state, 0)

    def _read(self, data: bytes) -> bytes:
        group, offset, size = struct.unpack_from("<III", data)
        read = self._bytes(group, offset, size)
        return struct.pack("<I", len(read)) + read

    def _write(self, data: bytes) -> bytes:
        group, offset, size = struct.unpack_from("<III", data)
        self._put(group, offset, data[12 : 12 + size])
        return b""

    def _read_write(self, data: bytes) -> bytes:
        group, offset, _, size = struct.unpack_from("<IIII", data)
        given = data[16 : 16 + size]
        if group == constants.ADSIGRP_SYM_HNDBYNAME:
            read = struct.pack("<I", self._handle(given))
        elif group == constants.ADSIGRP_SYM_INFOBYNAMEEX:
            read = entry_of(self._symbol(given))
        elif group == constants.ADSIGRP_SUMUP_READ:
            read = self._sum_read(offset, given)
        elif group == constants.ADSIGRP_SUMUP_WRITE:
            read = self._sum_write(offset, given)
        else:
            raise Refused(NO_GROUP)
        return struct.pack("<I", len(read)) + read

    def _sum_read(self, count: int, given: bytes) -> bytes:
        codes, values = [], b""
        for group, offset, size in struct.iter_unpack("<III", given[: 12 * count]):
            code, value = 0, bytes(size)
            try:
                value = self._bytes(group, offset, size)
            except Refused as refused:
                code = refused.code
            codes.append(code)
            values += value
        return struct.pack(f"<{count}I", *codes) + values

    def _sum_write(self, count: int, given: bytes) -> bytes:
        codes, at = [], 12 * count
        for group, offset, size in struct.iter_unpack("<III", given[: 12 * count]):
            code = 0
            try:
                self._put(group, offset, given[at : at + size])
            except Refused as refused:
                code = refused.code
            codes.append(code)
            at += size
        return struct.pack(f"<{count}I", *codes)

    def _bytes(self, group: int, offset: int, size: int) -> bytes:
        if (group, offset, size) == (constants.ADSIGRP_SYM_VERSION, 0, 1):
            return bytes([self.memory.version])
        start = self._place(group, offset, size)
        return bytes(self.memory.bytes[start : start + size])

    def _put(self, group: int, offset: int, value: bytes) -> None:
        if group == constants.ADSIGRP_SYM_RELEASEHND:
            self._handles.pop(struct.unpack("<I", value)[0], None)
            return
        start = self._place(group, offset, len(value))
        if self.loses_stops and start == self.memory.offset("nStop"):
            return
        self.memory.bytes[start : start + len(value)] = value
        if self.spoils and len(value) > SHORT:
            self.memory.bytes[start + len(value) // 2] ^= 1

    def _place(self, group: int, offset: int, size: int) -> int:
        if group == constants.ADSIGRP_SYM_VALBYHND:
            offset = self._symbol_of(offset, size).offset
        elif group != DATA:
            raise Refused(NO_GROUP)
        start = self.memory.at(offset, size)
        if start is None:
            raise Refused(NO_OFFSET)
        return start

    def _symbol_of(self, handle: int, size: int) -> Symbol:
        if handle not in self._handles:
            raise Refused(NO_SYMBOL)
        symbol, version = self._handles[handle]
        if version != self.memory.version:
            raise Refused(OTHER_VERSION)
        if size > symbol.size:
            raise Refused(WRONG_SIZE)
        return symbol

    def _handle(self, name: bytes) -> int:
        handle = 1 + max(self._handles, default=0)
        self._handles[handle] = self._symbol(name), self.memory.version
        return handle

    def _symbol(self, name: bytes) -> Symbol:
        symbol = self.memory.symbols.get(name.rstrip(b"\0").decode().lower())
        if symbol is None:
            raise Refused(NO_SYMBOL)
        return symbol


ADS_PORT = 48898

LONGEST = 8_000_000
"""Maximum length of a request [bytes]; a longer request is invalid."""


class Answers(Protocol):
    """Handler of requests for `pyads.testserver`."""

    def handle_request(self, request: object) -> AmsResponseData:
        """Return the answer to one request."""


_HEAD = struct.Struct("<HI")
_SHORTEST = 32


class Links:
    """TCP connections of all clients of the PLC.

    Args:
        address: Loopback address to listen on.
        answers: Handler that answers requests.
        port: TCP port.

    Attributes:
        silent: Whether requests are not answered; they are stored until answers are enabled again.

    Raises:
        PluginError: The port is in use.
    """

    def __init__(self, address: str, answers: Answers, port: int = ADS_PORT) -> None:
        self._address, self._port, self._answers = address, port, answers
        self._received: dict[socket.socket, bytes] = {}
        self._listening: socket.socket | None = None
        self.silent = False
        self.listen()

    def listen(self) -> None:
        """Open the port, unless it is open."""
        if self._listening is not None:
            return
        try:
            self._listening = socket.create_server((self._address, self._port), backlog=16)
        except OSError as error:
            raise PluginError(
                f"{self._address}:{self._port} cannot be used: {error.strerror}",
                hint="end the other mock PLC, or give this one a different --address",
            ) from error

    def cut(self) -> None:
        """Close all connections and refuse new connections until `listen` is called."""
        for line in [*self._received, *([self._listening] if self._listening else [])]:
            line.close()
        self._received.clear()
        self._listening = None

    def serve(self, wait_s: float) -> None:
        """Answer received requests; wait at most `wait_s` of wall time for new requests [s]."""
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
            line.settimeout(1.0)  # limit for sending: a client that does not read is dropped
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
        """Answer every complete request of a connection."""
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
