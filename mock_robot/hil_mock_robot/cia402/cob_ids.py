"""Which identifiers a client may give to PDOs and EMCY (CiA 301)."""

from __future__ import annotations

from hil_mock_robot.cia402.aborts import DEVICE_STATE, OUT_OF_RANGE, require
from hil_mock_robot.cia402.communication_objects import NOT_VALID

RESTRICTED = (
    (0x000, 0x080), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF),
)  # fmt: skip
"""First and last identifiers that belong to NMT, SYNC, SDO and heartbeat."""

CAN_ID = 0x7FF
EXTENDED_PART = 0x3FFF_F800
"""Bits of a 29-bit identifier and the bit that says that it is one."""


def valid(cob_id: int) -> bool:
    """Whether what has this COB-ID exists."""
    return not cob_id & NOT_VALID


def check(old: int, new: int, flags: int = 0) -> None:
    """A client changes a COB-ID.

    Args:
        old: With flags.
        new: With flags.
        flags: Bits 29 and 30 that may be set.

    Raises:
        Abort: It cannot have that one, or the identifier changes while it is in use.
    """
    require(not new & EXTENDED_PART & ~flags, OUT_OF_RANGE)
    number = new & CAN_ID
    require(not any(first <= number <= last for first, last in RESTRICTED), OUT_OF_RANGE)
    in_use = valid(old) and valid(new)
    require(not in_use or old & CAN_ID == number, DEVICE_STATE)
