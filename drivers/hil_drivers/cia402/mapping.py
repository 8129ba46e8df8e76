"""Process data: which objects travel in which PDO, and the record that one cycle leaves behind.

A mapping says what all axes get and answer in every cycle. On CAN a PDO is one frame of up to eight
bytes per axis, which is why the layouts below look the way they do; a bus with room for more
carries the same PDOs in one datagram. Where they go on CAN (COB-IDs) is said in `can_channel`.
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

LATE = 1 << 30
"""Flag of a cycle: its SYNC was late. Flag 1 << axis: not all answers of that axis came, its bytes
are of an earlier cycle."""
STALLED = 1 << 29
"""Flag of a cycle: its SYNC came more than 1.5 periods after the one before, at the wall's pace."""
INCOMPLETE = STALLED - 1
"""Any of the latter."""


@dataclass(frozen=True)
class Pdo:
    """One process data object.

    Attributes:
        number: From 1.
        entries: What it carries, in order; at most eight bytes.
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
        """The same as a packed record of eight bytes, so that raw data can be viewed as it."""
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


def cycle_dtype(mapping: Mapping, n: int) -> np.dtype[Any]:
    """What one cycle leaves behind, as it went over the wire.

    Fields: `cycle` (its number, from 0), `host_time` (Unix time at which its SYNC was
    sent), `segment` and `status` (what the master announced with it), `fault_code` (of the
    EMCY that the first faulty axis sent, 0 without a fault), `flags` (`INCOMPLETE`, `STALLED`,
    `LATE`), then the eight bytes of each PDO, `rpdo` (R, n, 8) as sent after this SYNC and `tpdo`
    (T, n, 8) as answered to it, and `temperature` (n,) [°C], the newest known at the SYNC, NaN
    before.
    """
    return np.dtype(
        [
            ("cycle", "<i8"),
            ("host_time", "<f8"),
            ("temperature", "<f8", (n,)),
            ("segment", "<i4"),
            ("status", "<i4"),
            ("fault_code", "<i4"),
            ("flags", "<i4"),
            ("rpdo", "u1", (len(mapping.rpdos), n, MOST_BYTES)),
            ("tpdo", "u1", (len(mapping.tpdos), n, MOST_BYTES)),
        ]
    )
