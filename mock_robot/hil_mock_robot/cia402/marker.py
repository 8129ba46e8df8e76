"""What the master announces: a frame of its own, before the commands it belongs to."""

from __future__ import annotations

import struct

FRAME = struct.Struct("<iH")
"""Step of the plan and status."""

TPDO1 = 0x180
MOVING = 1
"""Bit of the status: the motion of the step is still running."""


class Marker:
    """Follows what the master announces.

    Args:
        master_id: Its node id.

    Attributes:
        can_id: Under which it announces.
        known: Whether it has announced anything yet.
        segment, status: What it said last.
    """

    def __init__(self, master_id: int) -> None:
        self.can_id = TPDO1 + master_id
        self.known = False
        self.segment, self.status = -1, 0

    @property
    def moving(self) -> bool:
        """Whether a motion is running."""
        return bool(self.status & MOVING)

    def heard(self, data: bytes) -> None:
        """A frame of that identifier; others of that length are nobody's."""
        if len(data) == FRAME.size:
            self.segment, self.status = FRAME.unpack(data)
            self.known = True
