"""A plain RTDE client for tests: decodes by the types it is told, with none of the mock's code."""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from typing import Any

LAYOUT = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}


class Raw:
    """One connection to port 30004."""

    def __init__(self, where: str, timeout_s: float = 5.0, receive_buffer: int = 0) -> None:
        self.socket = socket.socket()
        if receive_buffer:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(timeout_s)
        self.socket.connect((where, 30004))
        self._rest = b""
        self.protocol = 1
        self.names: list[str] = []
        self.types: list[str] = []

    def __enter__(self) -> Raw:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.socket.close()

    def send(self, kind: str, payload: bytes = b"") -> None:
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def receive(self) -> tuple[str, bytes]:
        """Kind and payload of the next package, whatever it is."""
        head = self._exactly(3)
        size, kind = struct.unpack(">HB", head)
        return chr(kind), self._exactly(size - 3)

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Send, and return the payload of the next package, which must be of the same kind."""
        self.send(kind, payload)
        answered, reply = self.receive()
        assert answered == kind, (answered, kind)
        return reply

    def ask_among_data(self, kind: str, payload: bytes = b"") -> bytes:
        """The same while data comes in."""
        self.send(kind, payload)
        while True:
            answered, reply = self.receive()
            if answered == kind:
                return reply
            assert answered == "U"

    def negotiate(self, version: int = 2) -> bool:
        accepted = self.ask("V", struct.pack(">H", version)) == b"\x01"
        self.protocol = version if accepted else self.protocol
        return accepted

    def version(self) -> tuple[int, ...]:
        return struct.unpack(">4I", self.ask("v"))

    def outputs(self, names: Sequence[str], frequency: float = 125.0) -> tuple[int, list[str]]:
        self.names = list(names)
        reply = self.ask("O", struct.pack(">d", frequency) + ",".join(names).encode())
        self.types = reply[1:].decode().split(",")
        return reply[0], self.types

    def inputs(self, names: Sequence[str]) -> tuple[int, list[str]]:
        reply = self.ask("I", ",".join(names).encode())
        return reply[0], reply[1:].decode().split(",")

    def start(self) -> bool:
        return self.ask("S") == b"\x01"

    def pause(self) -> bool:
        return self.ask_among_data("P") == b"\x01"

    def write(self, recipe: int, layout: str, *values: Any) -> None:
        self.send("U", bytes([recipe]) + struct.pack(">" + layout, *values))

    def read(self) -> dict[str, Any]:
        """The next data package by name; other packages are skipped."""
        while True:
            kind, payload = self.receive()
            if kind == "U":
                return self.decoded(payload)

    def decoded(self, payload: bytes) -> dict[str, Any]:
        at, found = 0, {}
        if self.protocol > 1:
            assert payload[0] == 1
            at = 1
        for name, kind in zip(self.names, self.types, strict=True):
            layout = struct.Struct(">" + LAYOUT[kind])
            values = layout.unpack_from(payload, at)
            at += layout.size
            found[name] = values[0] if len(values) == 1 else list(values)
        assert at == len(payload)
        return found

    def _exactly(self, count: int) -> bytes:
        while len(self._rest) < count:
            more = self.socket.recv(65_536)
            if not more:
                raise ConnectionError("the mock hung up")
            self._rest += more
        data, self._rest = self._rest[:count], self._rest[count:]
        return data


def started(where: str, names: Sequence[str], frequency: float = 125.0) -> Raw:
    """A connection that gets these outputs."""
    raw = Raw(where)
    assert raw.negotiate()
    number, types = raw.outputs(names, frequency)
    assert number, types
    assert raw.start()
    return raw
