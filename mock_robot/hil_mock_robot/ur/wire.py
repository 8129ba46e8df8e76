"""RTDE on the wire: packages cut out of a byte stream, values packed and unpacked by recipe.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", descriptions of the packages.
All numbers are big-endian and lie next to each other without padding.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from operator import itemgetter
from typing import Any

from hil_mock_robot.ur.variables import Values, Variable

HEADER = struct.Struct(">HB")
"""Length of the whole package, and its kind. Two bytes of length bound what must be kept."""

LONGEST_NAMES = 2048
"""Bytes of a list of variables; the guide's limit."""

LONGEST_TEXT = 255


class Kind(IntEnum):
    """What a package is."""

    PROTOCOL_VERSION = ord("V")
    CONTROLLER_VERSION = ord("v")
    TEXT = ord("M")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


class Level(IntEnum):
    """How bad it is what a text message tells."""

    EXCEPTION = 0
    ERROR = 1
    WARNING = 2
    INFO = 3


def package(kind: Kind, payload: bytes = b"") -> bytes:
    """A package ready to be sent."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def text_message(protocol: int, level: Level, source: str, text: str) -> bytes:
    """A text message as this version of the protocol (1 or 2) lays it out."""
    if protocol == 1:
        return package(Kind.TEXT, bytes([level]) + _cut(text))
    parts = [bytes([len(each)]) + each for each in (_cut(text), _cut(source))]
    return package(Kind.TEXT, b"".join(parts) + bytes([level]))


def parsed_text(protocol: int, payload: bytes) -> tuple[Level, str, str] | None:
    """Level, source and text of a text message; None when it is none."""
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
    """Names between commas; some clients end their list with a comma, others do not."""
    return [name for name in payload.decode("ascii", errors="replace").split(",") if name]


class Framer:
    """Cuts a stream of bytes into packages, wherever it was cut before.

    Attributes:
        lost: A length came that cannot be: nothing tells where the next package begins.
    """

    def __init__(self) -> None:
        self._rest = bytearray()
        self.lost = False

    @property
    def held(self) -> int:
        """Bytes of a package that has not come to its end."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Kind and payload of every package that is whole now."""
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
    """What a client has asked for, ready to be packed every tick.

    Args:
        variables: In the order in which they are sent.
        number: Its id, which protocol version 2 sends along; None for version 1.
    """

    def __init__(self, variables: Sequence[Variable], number: int | None) -> None:
        letters = "".join(each.format for each in variables)
        body = struct.Struct(f">HB{'' if number is None else 'B'}{letters}")
        self._head = (body.size, int(Kind.DATA), *(() if number is None else (number,)))
        self._pack = body.pack
        places = [place for each in variables for place in each.places]
        # itemgetter returns a bare number for a single place; twice the same makes it a tuple.
        self._single = len(places) == 1
        self._pick = itemgetter(*places, *(places if self._single else ()))

    def pack(self, values: Values) -> bytes:
        """A data package of the present values."""
        picked = self._pick(values.flat)
        return self._pack(*self._head, *(picked[:1] if self._single else picked))


class InputRecipe:
    """What a client has announced to send.

    Args:
        variables: In the order in which they come.

    Attributes:
        names: Of these variables.
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
        """Names and values; None when the length is wrong, for then no value is where it should."""
        if len(payload) != self._body.size:
            return None
        numbers = self._body.unpack(payload)
        return [
            (name, numbers[at] if count == 1 else list(numbers[at : at + count]))
            for name, at, count in self._parts
        ]


def _cut(text: str) -> bytes:
    return text.encode(errors="replace")[:LONGEST_TEXT]
