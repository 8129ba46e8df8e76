"""Process data: which objects are in which PDO.

A mapping has the objects that all axes get and answer in every cycle. On CAN a PDO is one frame of
up to eight bytes per axis, hence the layouts below; a bus with room for more carries the same PDOs
in one datagram. Their COB-IDs on CAN are in `can_channel`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hil_drivers.cia402 import objects as od

MOST_BYTES = 8

LATENCY = 2
"""Cycles from sending a set-point to the answer in which it is reached: drives apply at a SYNC what
was sent in the cycle before, and are there one period later (60C2h)."""


@dataclass(frozen=True)
class Pdo:
    """One process data object.

    Attributes:
        number: From 1.
        entries: Its objects, in order; at most eight bytes.
    """

    number: int
    entries: tuple[od.Entry, ...]

    @cached_property
    def packing(self) -> struct.Struct:
        """Packs the values of all entries."""
        return struct.Struct("<" + "".join(entry.code for entry in self.entries))

    @property
    def length(self) -> int:
        """Bytes of data."""
        return self.packing.size

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The same as a packed record of eight bytes, for views of raw data."""
        offsets, at = [], 0
        for entry in self.entries:
            offsets.append(at)
            at += entry.size
        return np.dtype(
            {
                "names": [entry.name for entry in self.entries],
                "formats": ["<" + _NUMPY[entry.code] for entry in self.entries],
                "offsets": offsets,
                "itemsize": MOST_BYTES,
            }
        )


@dataclass(frozen=True)
class Mapping:
    """All PDOs of one axis; every axis has the same.

    Attributes:
        name: As in the station file.
        rpdos: To the drive, applied at the next SYNC.
        tpdos: From the drive, sampled at the SYNC.
    """

    name: str
    rpdos: tuple[Pdo, ...]
    tpdos: tuple[Pdo, ...]

    @property
    def pdos(self) -> tuple[Pdo, ...]:
        """To and from the drive."""
        return self.rpdos + self.tpdos

    @cached_property
    def entries(self) -> tuple[od.Entry, ...]:
        """All objects that travel, in the order in which they do."""
        return tuple(entry for pdo in self.pdos for entry in pdo.entries)

    @property
    def carries_mode(self) -> bool:
        """Whether 6060h and 6061h travel with every cycle."""
        return {od.MODE, od.MODE_DISPLAY} <= set(self.entries)


_NUMPY = {"b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4"}

_STATE = (
    Pdo(1, (od.STATUSWORD, od.POSITION, od.MODE_DISPLAY)),
    Pdo(2, (od.VELOCITY, od.TORQUE, od.CURRENT)),
)
_COMMAND = Pdo(1, (od.CONTROLWORD, od.MODE, od.TARGET_POSITION))

POSITION = Mapping("position", (_COMMAND,), _STATE)
"""CSP alone: 19 frames a cycle with six axes, 49 to 59 % of 1 Mbit/s at 250 Hz."""

ALL_MODES = Mapping(
    "all-modes",
    (_COMMAND, Pdo(2, (od.TARGET_VELOCITY, od.TARGET_TORQUE, od.TORQUE_OFFSET))),
    _STATE,
)
"""CSP with torque feed-forward, CSV, CST, and switching between them: 25 frames, 65 to 79 %."""

MINIMAL = Mapping(
    "minimal",
    (Pdo(1, (od.CONTROLWORD, od.TARGET_POSITION)),),
    (Pdo(1, (od.STATUSWORD, od.POSITION)),),
)
"""Position only: 500 Hz fit into 1 Mbit/s; neither velocity nor effort is measured."""

MAPPINGS = {mapping.name: mapping for mapping in (POSITION, ALL_MODES, MINIMAL)}
