"""Process data mappings, which determine the objects in each PDO.

A mapping lists the objects that all axes receive and send in every cycle. On CAN each PDO of an
axis is one frame of up to eight bytes; the layouts in this module are made for this size. On a bus
with larger frames, one datagram can contain all PDOs. The COB-IDs of the PDOs on CAN are defined in
`can_channel`.
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
"""Number of cycles from sending a set-point to the answer that shows the set-point reached.

At a SYNC, drives apply the set-point of the cycle before, and reach this set-point one period later
(60C2h).
"""


@dataclass(frozen=True)
class Pdo:
    """Process data object (PDO): list of the objects in one frame.

    Attributes:
        number: Number of the PDO, from 1.
        entries: Objects of the PDO in the order of transmission; at most eight bytes in total.
    """

    number: int
    entries: tuple[od.Entry, ...]

    @cached_property
    def packing(self) -> struct.Struct:
        """`struct` layout that packs the values of all entries."""
        return struct.Struct("<" + "".join(entry.code for entry in self.entries))

    @property
    def length(self) -> int:
        """Number of data bytes of the PDO."""
        return self.packing.size

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """NumPy dtype of eight bytes with the same entries, for views of raw data."""
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
    """PDOs of one axis; the PDOs of all axes have the same content.

    Attributes:
        name: Name of the mapping in the station file.
        rpdos: PDOs to the drive, applied at the next SYNC.
        tpdos: PDOs from the drive, sampled at the SYNC.
    """

    name: str
    rpdos: tuple[Pdo, ...]
    tpdos: tuple[Pdo, ...]

    @property
    def pdos(self) -> tuple[Pdo, ...]:
        """PDOs of both directions: to the drive and from the drive."""
        return self.rpdos + self.tpdos

    @cached_property
    def entries(self) -> tuple[od.Entry, ...]:
        """Objects of all PDOs, in the order of transmission."""
        return tuple(entry for pdo in self.pdos for entry in pdo.entries)

    @property
    def carries_mode(self) -> bool:
        """Whether every cycle contains the mode objects 6060h and 6061h."""
        return {od.MODE, od.MODE_DISPLAY} <= set(self.entries)


_NUMPY = {"b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4"}

_STATE = (
    Pdo(1, (od.STATUSWORD, od.POSITION, od.MODE_DISPLAY)),
    Pdo(2, (od.VELOCITY, od.TORQUE, od.CURRENT)),
)
_COMMAND = Pdo(1, (od.CONTROLWORD, od.MODE, od.TARGET_POSITION))

POSITION = Mapping("position", (_COMMAND,), _STATE)
"""Mapping for CSP: 19 frames per cycle with six axes, 49 to 59 % of 1 Mbit/s at 250 Hz."""

ALL_MODES = Mapping(
    "all-modes",
    (_COMMAND, Pdo(2, (od.TARGET_VELOCITY, od.TARGET_TORQUE, od.TORQUE_OFFSET))),
    _STATE,
)
"""Mapping for CSP with torque feed-forward, CSV, CST, and switching between these modes.

With the mapping `all-modes`, a cycle of six axes has 25 frames, which are 65 to 79 % of 1 Mbit/s at
250 Hz.
"""

MINIMAL = Mapping(
    "minimal",
    (Pdo(1, (od.CONTROLWORD, od.TARGET_POSITION)),),
    (Pdo(1, (od.STATUSWORD, od.POSITION)),),
)
"""Mapping without velocity and effort, for cycle rates of up to 500 Hz at 1 Mbit/s."""

MAPPINGS = {mapping.name: mapping for mapping in (POSITION, ALL_MODES, MINIMAL)}
