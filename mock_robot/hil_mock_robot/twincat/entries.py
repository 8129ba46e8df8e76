"""Symbol entries: what ADS tells of a variable."""

from __future__ import annotations

import struct

from hil_mock_robot.twincat.memory import DATA, Symbol

BIG_TYPE = 65
"""ADS data type of what is no elementary type."""

ELEMENTARY = {"UDINT": 19, "DINT": 3, "LREAL": 5, "ULINT": 21}


def entry_of(symbol: Symbol) -> bytes:
    """A symbol entry: sizes, place, name, type and an empty comment."""
    name, kind = symbol.name.encode(), symbol.type.encode()
    texts = name + b"\0" + kind + b"\0\0"
    head = struct.calcsize("<IIIIIIHHH")
    return (
        struct.pack(
            "<IIIIIIHHH",
            head + len(texts),
            DATA,
            symbol.offset,
            symbol.size,
            ELEMENTARY.get(symbol.type, BIG_TYPE),
            0,
            len(name),
            len(kind),
            0,
        )
        + texts
    )
