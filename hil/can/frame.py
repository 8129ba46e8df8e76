"""One classic CAN data frame as 16 bytes, the way SocketCAN lays it out.

A raw AF_CAN socket and our own bus carry the same bytes, so the cyclic core packs them once.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

FRAME = struct.Struct("<IB3x8s")
"""Identifier with flags, data length, data padded to eight bytes."""

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Flags in the identifier; CANopen uses neither of the first two."""

ID_MASK = 0x1FFF_FFFF
ERROR_BUS_OFF = 0x40
"""In the identifier of an error frame: the controller of this end is off the bus."""
ERROR_CONTROLLER = 0x04
"""In the identifier of an error frame: the second data byte says what the controller met."""
TX_OVERFLOW = 0x02
"""That byte: its transmit queue was full, a frame was dropped."""
ERROR_RESTARTED = 0x100
"""In the identifier of an error frame: the controller of this end is back on the bus."""


class Frame(NamedTuple):
    """A data frame.

    Attributes:
        id: 11-bit identifier, COB-ID in CANopen.
        data: 0 to 8 bytes.
        time_s: Unix time at which it was seen, 0 where nobody looked.
    """

    id: int
    data: bytes
    time_s: float = 0.0


def pack_frame(can_id: int, data: bytes) -> bytes:
    """The 16 bytes of a data frame."""
    return FRAME.pack(can_id, len(data), data)


def unpack_frame(raw: bytes, time_s: float = 0.0) -> Frame:
    """The frame in 16 bytes; flags stay in `id`."""
    can_id, length, data = FRAME.unpack(raw)
    return Frame(can_id, data[:length], time_s)
