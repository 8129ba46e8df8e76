"""A load declared to drives that have an object for it: mock drives mount it, real ones have none.

Vendor object of the first node: sub-indices 1 to 4 are mass [kg] and centre of mass x, y, z in the
flange frame [m], REAL32 each.
"""

from __future__ import annotations

import struct
from dataclasses import replace

from hil.arms import Payload
from hil_drivers.cia402.contracts import Acyclic
from hil_drivers.cia402.objects import Entry

NAMES = ("payload_mass", "payload_x", "payload_y", "payload_z")


def declare(acyclic: Acyclic, index: int, payload: Payload) -> Payload:
    """Write a load, and read back what the drive has: its inertia is not told.

    Args:
        acyclic: The drives.
        index: The object.
        payload: What is mounted.

    Raises:
        CommandRefused: The drive does not take it.
        RobotTimeout: It does not answer.
    """
    entries = [Entry(name, index, sub, "I") for sub, name in enumerate(NAMES, 1)]
    for entry, value in zip(entries, (payload.mass, *payload.com), strict=True):
        acyclic.download(0, entry, _bits(value))
    mass, *com = (_value(acyclic.upload(0, entry)) for entry in entries)
    return replace(payload, mass=mass, com=(com[0], com[1], com[2]))


def _bits(value: float) -> int:
    """REAL32 as the integer that SDO carries."""
    return int.from_bytes(struct.pack("<f", value), "little")


def _value(bits: int) -> float:
    (value,) = struct.unpack("<f", bits.to_bytes(4, "little"))
    return float(value)
