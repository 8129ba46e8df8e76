"""An RTDE server for tests, written from the protocol's description: one client, one script."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise

FORMATS = {
    "DOUBLE": "d", "VECTOR3D": "3d", "VECTOR6D": "6d", "UINT64": "Q", "UINT32": "I",
    "INT32": "i", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I", "UINT8": "B", "BOOL": "?",
}  # fmt: skip
CB3 = (3, 15, 8, 106339)
E_SERIES = (5, 12, 2, 1101534)

NOT_IN_CB3_3_15 = {
    "actual_current_as_torque", "actual_current_window", "tcp_offset", "ft_raw_wrench",
    "joint_position_deviation_ratio", "collision_detection_ratio", "time_scale_source",
    "script_control_line",
}  # fmt: skip


def package(kind: str, content: bytes = b"") -> bytes:
    return struct.pack(">HB", 3 + len(content), ord(kind)) + content


def text(message: str, source: str = "test", level: int = 3) -> bytes:
    m, s = message.encode(), source.encode()
    return package("M", bytes([len(m)]) + m + bytes([len(s)]) + s + bytes([level]))


def types_of_hil() -> dict[str, str]:
    """Every output the reader may ask for, with its true type."""
    from hil_drivers.ur.rtde import FIELDS

    return {field.name: field.type for field in FIELDS}


class Conversation:
    """The server's side of one connection."""

    def __init__(self, line: socket.socket, types: Mapping[str, str], version=CB3) -> None:
        self.line, self.types, self.version = line, types, version
        self.names: list[str] = []
        self.frequency = 0.0
        self.asked: list[list[str]] = []
        self.recipe = 1

    def receive(self) -> tuple[str, bytes]:
        head = self._exactly(3)
        size, kind = struct.unpack(">HB", head)
        return chr(kind), self._exactly(size - 3)

    def send(self, data: bytes) -> None:
        self.line.sendall(data)

    def answer(self, kind: str, content: bytes) -> bytes:
        """What a controller answers to one question."""
        if kind == "V":
            return package("V", b"\x01")
        if kind == "v":
            return package("v", struct.pack(">IIII", *self.version))
        if kind == "O":
            self.frequency = struct.unpack_from(">d", content)[0]
            self.names = content[8:].decode().split(",")
            self.asked.append(self.names)
            types = [self.types.get(name, "NOT_FOUND") for name in self.names]
            bad = set(types) & {"NOT_FOUND", "IN_USE"}
            return package("O", bytes([0 if bad else self.recipe]) + ",".join(types).encode())
        if kind == "S":
            return package("S", b"\x01")
        raise AssertionError(f"asked {kind!r}")

    def handshake(self, before: Callable[[str], bytes] = lambda kind: b"") -> None:
        """Answer until started; `before` says what is sent before an answer."""
        kind = ""
        while kind != "S":
            kind, content = self.receive()
            self.send(before(kind) + self.answer(kind, content))

    def data(self, t: float, **values: object) -> bytes:
        """A data package: zeros but for what is given."""
        content = b""
        for name in self.names:
            fmt = FORMATS[self.types[name]]
            value = t if name == "timestamp" else values.get(name)
            count = int(fmt[:-1] or 1)
            numbers = [0] * count if value is None else ([value] if count == 1 else list(value))
            content += struct.pack(f">{fmt}", *numbers)
        return package("U", bytes([self.recipe]) + content)

    def _exactly(self, count: int) -> bytes:
        got = b""
        while len(got) < count:
            more = self.line.recv(count - len(got))
            if not more:
                raise ConnectionError
            got += more
        return got


class Peer:
    """Listens on a port of its own and plays a script for every client.

    The connection is closed when the script ends.
    """

    def __init__(
        self,
        script: Callable[[Conversation], object],
        types: Mapping[str, str] | None = None,
        version=CB3,
    ) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._script, self._version = script, version
        self._types = types_of_hil() if types is None else types
        self.talks: list[Conversation] = []
        self.errors: list[BaseException] = []
        threading.Thread(target=self._run, daemon=True).start()

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *error: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)  # or a waiting accept() would keep it open
        self._listener.close()
        assert self.errors == []

    def _run(self) -> None:
        while True:
            try:
                line, _ = self._listener.accept()
            except OSError:
                return
            with line:
                talk = Conversation(line, self._types, self._version)
                self.talks.append(talk)
                try:
                    self._script(talk)
                except OSError:
                    pass  # the client went away
                except BaseException as error:
                    self.errors.append(error)


def stream(
    count: int, frequency: float = 125.0, *, then: Callable[[Conversation], object] | None = None
) -> Callable[[Conversation], None]:
    """A script: shake hands, send so many states at once, then do `then` or wait to be left."""

    def script(talk: Conversation) -> None:
        talk.handshake()
        talk.send(b"".join(talk.data(i / frequency, actual_q=[i] * 6) for i in range(count)))
        if then is None:
            until_gone(talk)
        else:
            then(talk)

    return script


def until_gone(talk: Conversation) -> None:
    talk.line.settimeout(20)
    while talk.line.recv(4096):
        pass


def hold(seconds: float) -> Callable[[Conversation], None]:
    return lambda talk: time.sleep(seconds)


def pieces(data: bytes, cuts: Iterable[int]) -> list[bytes]:
    """`data` cut at these places."""
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in pairwise(edges)]
