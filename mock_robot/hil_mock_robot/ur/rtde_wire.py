"""RTDE wire format: packages, recipes, and a line on which packages get lost or corrupted.

`Framer` splits a byte stream into packages; `OutputRecipe` and `InputRecipe` pack and unpack data
packages. `Line` is the common part of all RTDE connections, and `LineEnd` is one connection; the
two classes inject faults.

The source is Universal Robots, "Real-Time Data Exchange (RTDE) Guide", descriptions of the
packages. All numbers in the packages are big-endian, without padding.
"""

from __future__ import annotations

import random
import struct
from collections import Counter, deque
from collections.abc import Sequence
from enum import IntEnum
from operator import itemgetter
from typing import Any

from hil_mock_robot.ur.connections import Link
from hil_mock_robot.ur.rtde_variables import Values, Variable

HEADER = struct.Struct(">HB")
"""Binary layout of a package header: length of the whole package and kind; the two bytes of the
length limit the size of the receive buffer."""

LONGEST_NAMES = 2048
"""Maximum length of a list of variable names [bytes]; limit of the guide."""

LONGEST_TEXT = 255


class Kind(IntEnum):
    """Kind of an RTDE package."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT = ord("M")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


class Level(IntEnum):
    """Severity of a text message."""

    EXCEPTION = 0
    ERROR = 1
    WARNING = 2
    INFO = 3


def package(kind: Kind, payload: bytes = b"") -> bytes:
    """Return the bytes of a package with its header."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def text_message(protocol: int, level: Level, source: str, text: str) -> bytes:
    """Return a text message in the layout of a protocol version (1 or 2)."""
    if protocol == 1:
        return package(Kind.TEXT, bytes([level]) + _cut(text))
    parts = [bytes([len(each)]) + each for each in (_cut(text), _cut(source))]
    return package(Kind.TEXT, b"".join(parts) + bytes([level]))


def _cut(text: str) -> bytes:
    return text.encode(errors="replace")[:LONGEST_TEXT]


def parsed_text(protocol: int, payload: bytes) -> tuple[Level, str, str] | None:
    """Return level, source and text of a text message; None if the message is invalid."""
    try:
        if protocol == 1:
            return Level(payload[0]), "", payload[1:].decode(errors="replace")
        text, rest = payload[1 : 1 + payload[0]], payload[1 + payload[0] :]
        source, end = rest[1 : 1 + rest[0]], rest[1 + rest[0] :]
        if len(end) != 1:
            return None
        return Level(end[0]), source.decode(errors="replace"), text.decode(errors="replace")
    except (IndexError, ValueError):
        return None


def names_in(payload: bytes) -> list[str]:
    """Return the names in a comma-separated list; a comma at the end is permitted."""
    return [name for name in payload.decode("ascii", errors="replace").split(",") if name]


class Framer:
    """Splitter of a byte stream into packages, independent of the sizes of its pieces.

    Attributes:
        lost: Whether an impossible length has arrived, so that the next package cannot be located.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self.lost = False

    @property
    def held(self) -> int:
        """Number of bytes of the incomplete package."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return kind and payload of every package that is now complete."""
        if self.lost:
            return []
        rest, at, found = self._rest, 0, []
        rest += data
        while len(rest) - at >= HEADER.size:
            size, kind = HEADER.unpack_from(rest, at)
            if size < HEADER.size:
                self.lost, at = True, len(rest)
                break
            if len(rest) - at < size:
                break
            found.append((kind, bytes(rest[at + HEADER.size : at + size])))
            at += size
        del rest[:at]
        return found


class OutputRecipe:
    """Outputs that a client receives, prepared for packing in every tick.

    Args:
        variables: Variables in the order of transmission.
        number: Recipe number, which protocol version 2 transmits; None for version 1.
    """

    def __init__(self, variables: Sequence[Variable], number: int | None) -> None:
        letters = "".join(each.format for each in variables)
        body = struct.Struct(f">HB{'' if number is None else 'B'}{letters}")
        self._head = (body.size, int(Kind.DATA), *(() if number is None else (number,)))
        self._pack = body.pack
        places = [place for each in variables for place in each.places]
        # itemgetter returns a bare number for one index; repeating the index makes it a tuple.
        self._single = len(places) == 1
        self._pick = itemgetter(*places, *(places if self._single else ()))

    def pack(self, values: Values) -> bytes:
        """Return a data package with the present values."""
        picked = self._pick(values.flat)
        return self._pack(*self._head, *(picked[:1] if self._single else picked))


class InputRecipe:
    """Inputs that a client has announced.

    Args:
        variables: Variables in the order of transmission.

    Attributes:
        names: Names of the variables.
    """

    def __init__(self, variables: Sequence[Variable]) -> None:
        self.names = tuple(each.name for each in variables)
        self._body = struct.Struct(">" + "".join(each.format for each in variables))
        self._parts: list[tuple[str, int, int]] = []
        at = 0
        for each in variables:
            self._parts.append((each.name, at, each.count))
            at += each.count

    def unpack(self, payload: bytes) -> list[tuple[str, Any]] | None:
        """Return names and values; None if the length is wrong, so that no value is reliable."""
        if len(payload) != self._body.size:
            return None
        numbers = self._body.unpack(payload)
        return [
            (name, numbers[at] if count == 1 else list(numbers[at : at + count]))
            for name, at, count in self._parts
        ]


class Line:
    """Common part of the connections of all RTDE clients.

    Args:
        tick_s: Device time of a tick [s].
        seed: Seed of the random generator for jitter and garbage.

    Attributes:
        sound: Whether no fault is active, so that packages pass unchanged.
        cut: Whether new connections are closed immediately.
    """

    def __init__(self, tick_s: float, seed: int = 0) -> None:
        self._tick_s = tick_s
        self.random = random.Random(seed)  # noqa: S311
        self.ticks = 0
        self.sound = True
        self.cut = False
        self._lasting: list[tuple[str, float]] = []
        self._ends: list[LineEnd] = []

    def over(self, link: Link) -> Link:
        """Return a link to a client that passes through this line."""
        self._ends = [end for end in self._ends if not end.closed]
        end = LineEnd(self, link)
        self._ends.append(end)
        if self.cut:
            end.close()
        return end

    def hang_up(self, *, stays: bool) -> None:
        """Close all connections; with `stays`, also close new connections immediately."""
        self.cut = stays
        for end in self._ends:
            end.close()

    def suffer(self, kind: str, by_s: float = 0.0) -> None:
        """Begin a fault with the next package.

        Args:
            kind: Kind of the fault: `silence`, `freeze`, `late` or `jitter`.
            by_s: Delay of `late` or maximum delay of `jitter` [s].
        """
        self._lasting.append((kind, by_s))
        self._look()

    def recover(self, kind: str, by_s: float = 0.0) -> None:
        """End a fault that `suffer` has begun."""
        self._lasting.remove((kind, by_s))
        self._look()

    def owe(self, kind: str, packages: int, by_bytes: int = 0) -> None:
        """Schedule a fault of the next data packages: drop, duplicate, garbage or wrong_length."""
        for end in self._ends:
            end.owed[kind] += packages
            if kind == "wrong_length":
                end.by_bytes = by_bytes
        self._look()

    def mend(self) -> None:
        """Cancel the scheduled faults of the next packages."""
        for end in self._ends:
            end.owed.clear()
        self._look()

    def tick(self) -> None:
        """Advance device time by one tick and send delayed packages that are due."""
        self.ticks += 1
        if not self.sound:
            for end in self._ends:
                end.release()
            self._look()

    def has(self, kind: str) -> bool:
        """Return whether a fault of this kind is active."""
        return any(kind == each for each, _ in self._lasting)

    def delay(self) -> int:
        """Return the number of ticks by which the next package is delayed."""
        ticks = 0
        for kind, by_s in self._lasting:
            most = round(by_s / self._tick_s)
            if kind == "late":
                ticks += most
            elif kind == "jitter":
                ticks += self.random.randint(0, most)
        return ticks

    def _look(self) -> None:
        self.sound = not self._lasting and not any(end.spoilt for end in self._ends)


class LineEnd:
    """Single connection with fault injection; implements `Link`.

    The data of each call of `send` are one package.

    Args:
        line: Line shared by all connections.
        link: Connection to the client.

    Attributes:
        owed: Map from kind of fault to the number of next data packages that are affected.
        by_bytes: Number of additional bytes in packages of wrong length.
    """

    def __init__(self, line: Line, link: Link) -> None:
        self._line, self._link = line, link
        self.peer = link.peer
        self.owed: Counter[str] = Counter()
        self.by_bytes = 0
        self._held: deque[tuple[int, bytes]] = deque()
        self._newest = b""

    @property
    def closed(self) -> bool:
        """See `Link`."""
        return self._link.closed

    @property
    def pending(self) -> int:
        """See `Link`."""
        return self._link.pending

    @property
    def spoilt(self) -> bool:
        """Whether a fault of this connection alone is still pending."""
        return not self.closed and (bool(self._held) or any(self.owed.values()))

    def close(self) -> None:
        """See `Link`."""
        self._held.clear()
        self._link.close()

    def send(self, data: bytes) -> None:
        """See `Link`."""
        if self._line.sound:
            self._newest = data
            self._link.send(data)
            return
        for each in self.carry(data):
            self._held.append((self._line.ticks + self._line.delay(), each))
        self.release()

    def carry(self, data: bytes) -> list[bytes]:
        """Apply the active faults to a package; a reply can only be lost."""
        line = self._line
        if line.has("silence"):
            return []
        if data[2] != Kind.DATA:
            return [data]
        if line.has("freeze"):
            data = self._newest if self._newest[2:3] == bytes([Kind.DATA]) else data
        self._newest = data
        if self._owes("drop"):
            return []
        if self._owes("garbage"):
            return [self._line.random.randbytes(len(data))]
        if self._owes("wrong_length"):
            return [_resized(data, self.by_bytes)]
        return [data, data] if self._owes("duplicate") else [data]

    def release(self) -> None:
        """Send the packages that are due, in order."""
        while self._held and self._held[0][0] <= self._line.ticks:
            self._link.send(self._held.popleft()[1])

    def _owes(self, kind: str) -> bool:
        owed = self.owed[kind] > 0
        self.owed[kind] -= owed
        return owed


def _resized(data: bytes, by_bytes: int) -> bytes:
    """Return a package with fewer or more bytes than its recipe has, and a matching header."""
    size, kind = HEADER.unpack_from(data)
    size = max(HEADER.size + 1, size + by_bytes)
    body = data[HEADER.size : size].ljust(size - HEADER.size, b"\x00")
    return HEADER.pack(size, kind) + body
