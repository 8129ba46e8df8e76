"""What one object of the dictionary is: type, access, range, unit, where it may be mapped."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace

from hil_mock_robot.cia402.contracts import key

Value = int | float | str

CODES = {"i8": "b", "u8": "B", "i16": "h", "u16": "H", "i32": "i", "u32": "I", "f32": "I"}
"""`struct` codes of what is kept in `Registers`: REAL32 as its 32 bits."""


@dataclass(frozen=True, slots=True)
class Object:
    """One variable of the object dictionary.

    Attributes:
        index, sub, name: Where it is, and what it is called.
        type: One of `CODES`, `text` or `domain`; the last two are not kept in `Registers`.
        access: `rw`, `ro`, `wo` or `const`.
        default: After a reset, unless the axis has a value of its own.
        mappable: Whether a PDO may carry it.
        low, high: Range of what may be written; the type's own without.
        choices: What may be written, where it is not a range.
        unit: As in the standard's texts; empty where there is none.
        locked: It cannot be written while the drive works.
        kept: A reset does not change it: it is a fact of the machine, not a setting.
        per_axis: The default stands for a value that depends on the axis.
        node_relative: The node's id is added to the default.
        note: What is not said by the name.
    """

    index: int
    sub: int
    name: str
    type: str
    access: str = "rw"
    default: Value = 0
    mappable: bool = False
    low: int | None = None
    high: int | None = None
    choices: tuple[int, ...] = ()
    unit: str = ""
    locked: bool = False
    kept: bool = False
    per_axis: bool = False
    node_relative: bool = False
    note: str = ""

    @property
    def key(self) -> int:
        """Where it is in `Registers`."""
        return key(self.index, self.sub)

    @property
    def readable(self) -> bool:
        """Whether an SDO client may read it, and a TPDO carry it."""
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        """Whether an SDO client may write it, and an RPDO carry it."""
        return self.access in ("rw", "wo")

    @property
    def packing(self) -> struct.Struct:
        """Packs what is kept in `Registers`."""
        return struct.Struct("<" + CODES[self.type])

    @property
    def bits(self) -> int:
        """Length in a PDO."""
        return 8 * self.packing.size

    def allows(self, value: float) -> bool:
        """Whether a client may write this (NaN never)."""
        if self.choices:
            return value in self.choices
        low, high = self.low, self.high
        if low is None and high is None:
            return value == value
        return (low is None or value >= low) and (high is None or value <= high)


@dataclass(frozen=True, slots=True)
class Group:
    """An object with sub-indices.

    Attributes:
        index, name: Where it is, and what it is called.
        members: In the order of their sub-indices; the first tells how many follow.
        array: All members but the first are of one kind.
    """

    index: int
    name: str
    members: tuple[Object, ...]
    array: bool = False


def group(
    index: int, name: str, members: Iterable[Object], *, array: bool = False, count: str = "const"
) -> Group:
    """A group of members that carry their sub-indices; sub-index 0 is put before them.

    Args:
        index: Of the group and, whatever they say, of its members.
        name: Of the group.
        members: In the order of their sub-indices.
        array: All members are of one kind.
        count: Access of sub-index 0.
    """
    placed = tuple(replace(member, index=index) for member in members)
    first = Object(index, 0, "Highest sub-index supported", "u8", count, placed[-1].sub)
    return Group(index, name, (first, *placed), array)


def real(raw: int) -> float:
    """The number that REAL32 keeps as 32 bits."""
    return float(struct.unpack("<f", struct.pack("<I", raw & 0xFFFF_FFFF))[0])


def raw_real(value: float) -> int:
    """The 32 bits of a REAL32."""
    return int(struct.unpack("<I", struct.pack("<f", value))[0])
