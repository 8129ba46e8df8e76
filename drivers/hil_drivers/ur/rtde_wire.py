"""RTDE packages as bytes: framing, type names, and data packages turned into rows all at once.

Every package is `size` (u16, all bytes of it), `kind` (u8) and content, in network byte order
(Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import groupby
from typing import Any

import numpy as np

from hil.core import StructArray

HEADER = struct.Struct(">HB")
SHORTEST, LONGEST = HEADER.size, 65535
"""Of a package, with its header [bytes]."""

DATA_HEAD = struct.Struct(">HBB")
"""A data package begins with its header and the number of its recipe."""

TYPES: Mapping[str, tuple[str, int]] = {
    "BOOL": ("|u1", 1),
    "UINT8": ("|u1", 1),
    "UINT32": ("<u4", 1),
    "UINT64": ("<u8", 1),
    "INT32": ("<i4", 1),
    "DOUBLE": ("<f8", 1),
    "VECTOR3D": ("<f8", 3),
    "VECTOR6D": ("<f8", 6),
    "VECTOR6INT32": ("<i4", 6),
    "VECTOR6UINT32": ("<u4", 6),
}
"""Type as RTDE names it → numpy type of one value in a row, and how many of them."""

_TIME = struct.Struct(">d")
_SWAPPED = {8: (">u8", "<u8"), 4: (">u4", "<u4"), 1: ("|u1", "|u1")}


class Kind(IntEnum):
    """What a package is."""

    VERSION = ord("V")
    CONTROLLER = ord("v")
    TEXT = ord("M")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")


KINDS = frozenset(map(int, Kind))


@dataclass(frozen=True, slots=True)
class TextMessage:
    """What a controller says in words.

    Attributes:
        text, source: As sent.
        level: 0 exception, 1 error, 2 warning, 3 information; −1 when it does not say.
        host_time: When it came, Unix time [s].
    """

    text: str
    source: str
    level: int
    host_time: float

    def __str__(self) -> str:
        return f"{self.source}: {self.text}" if self.source else self.text


def package(kind: Kind, content: bytes = b"") -> bytes:
    """A package, ready to be sent."""
    return HEADER.pack(HEADER.size + len(content), kind) + content


def text_message(content: bytes, host_time: float) -> TextMessage:
    """A text message, as far as it is whole: words are for people, and no reason to end."""
    text, rest = _counted(content)
    source, rest = _counted(rest)
    return TextMessage(text, source, rest[0] if rest else -1, host_time)


def _counted(content: bytes) -> tuple[str, bytes]:
    end = 1 + (content[0] if content else 0)
    return content[1:end].decode("utf-8", "replace"), content[end:]


class Layout:
    """Where the variables of an output recipe lie, in a package and in a row.

    Neighbours of one width are swapped to this machine's byte order in one go, so a recipe that
    is sorted by width costs a few copies, however many variables it has.

    Args:
        recipe: Number of the recipe, as the controller gave it.
        names: Variables in order; the first one is `timestamp`.
        types: Their types as RTDE names them, all of them in `TYPES`.

    Attributes:
        dtype: Of a row: `host_time` (float64, Unix time [s]) and the variables by name.
        size: Of a data package [bytes].
        head: The first four bytes of every data package, as one number.
    """

    def __init__(self, recipe: int, names: Sequence[str], types: Sequence[str]) -> None:
        kinds = [TYPES[one] for one in types]
        fields = [
            (name, code) if count == 1 else (name, code, (count,))
            for name, (code, count) in zip(names, kinds, strict=True)
        ]
        self.names, self.types = tuple(names), tuple(types)
        self.dtype: np.dtype[Any] = np.dtype([("host_time", "<f8"), *fields])
        blocks = _blocks(kinds)
        self._blocks = [f"block{i}" for i in range(len(blocks))]
        self._wire = np.dtype(
            [("head", ">u4")]
            + [(b, _SWAPPED[w][0], (n,)) for b, (w, n) in zip(self._blocks, blocks, strict=True)]
        )
        self._native = np.dtype(
            [("host_time", "<f8")]
            + [(b, _SWAPPED[w][1], (n,)) for b, (w, n) in zip(self._blocks, blocks, strict=True)]
        )
        self.size = self._wire.itemsize
        self.head = int.from_bytes(DATA_HEAD.pack(self.size, Kind.DATA, recipe), "big")
        self._times = np.dtype(
            {"names": ["t"], "formats": [">f8"], "offsets": [4], "itemsize": self.size}
        )

    def whole_packages(self, data: bytes, begin: int) -> int:
        """How many data packages of this recipe follow each other in `data` from `begin`."""
        count = (len(data) - begin) // self.size
        if count < 2:  # the usual case at a robot's own pace, without numpy's overhead
            return int(count == 1 and self.is_head(data, begin))
        good = np.frombuffer(data, self._wire, count, begin)["head"] == self.head
        return count if good.all() else int(np.argmin(good))

    def is_head(self, data: bytes, begin: int) -> bool:
        """Whether a data package of this recipe begins here."""
        return int.from_bytes(data[begin : begin + 4], "big") == self.head

    def time(self, package: bytes) -> float:
        """Timestamp of one whole data package [s]."""
        return float(_TIME.unpack_from(package, DATA_HEAD.size)[0])

    def times(self, packages: bytes) -> np.ndarray[Any, np.dtype[np.float64]]:
        """(N,) timestamps of whole data packages [s]."""
        return np.frombuffer(packages, self._times)["t"].astype(np.float64)

    def rows(self, packages: bytes, host_time: Any) -> StructArray:
        """Whole data packages as rows.

        Args:
            packages: One after the other.
            host_time: When they came, a number or (N,).
        """
        seen = np.frombuffer(packages, self._wire)
        out = np.empty(len(seen), self._native)
        out["host_time"] = host_time
        for block in self._blocks:
            out[block] = seen[block]
        return out.view(self.dtype)


def _blocks(kinds: Sequence[tuple[str, int]]) -> list[tuple[int, int]]:
    """(width, count) of the runs of values of one width."""
    widths = [(np.dtype(code).itemsize, count) for code, count in kinds]
    return [
        (width, sum(count for _, count in group))
        for width, group in groupby(widths, key=lambda one: one[0])
    ]
