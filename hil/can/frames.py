"""Classic CAN frames: 16 bytes in memory the way SocketCAN lays them out, and bits on the wire.

A raw AF_CAN socket and our own bus carry the same bytes, so the cycle of a driver packs them once.
What frames cost on the wire is counted with the interframe space, as ISO 11898-1 lays them out.
Bits are stuffed from the start of the frame to the end of its check sum: one more at most after
every fourth of them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
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
        time_s: Unix time at which it was seen, 0 where that is unknown.
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


class FrameBits(NamedTuple):
    """Bits of one frame.

    Attributes:
        nominal: Without stuff bits.
        worst: With as many as there can be.
    """

    nominal: int
    worst: int


class BusLoad(NamedTuple):
    """Share of a bus that is taken: 1.0 is a full one, more does not fit.

    Attributes:
        nominal: Without stuff bits.
        worst: With as many as there can be.
    """

    nominal: float
    worst: float


_STUFFED, _STUFFED_EXTENDED = 34, 54
"""Bits open to stuffing, without data: 11- and 29-bit identifiers."""

_PLAIN = 13
"""The others: delimiters, acknowledgement, end of frame and interframe space."""


def frame_bits(n_bytes: int, *, extended: bool = False) -> FrameBits:
    """Bits of a data frame of 0 to 8 bytes, with an identifier of 11 bits or, extended, of 29.

    Raises:
        ValueError: No classic frame has so many bytes.
    """
    if not 0 <= n_bytes <= 8:
        raise ValueError(f"a classic CAN frame has 0 to 8 data bytes, not {n_bytes}")
    stuffed = (_STUFFED_EXTENDED if extended else _STUFFED) + 8 * n_bytes
    nominal = stuffed + _PLAIN
    return FrameBits(nominal, nominal + (stuffed - 1) // 4)


def bits_of(lengths: Iterable[int]) -> FrameBits:
    """Bits of frames with these numbers of data bytes, one after the other."""
    each = [frame_bits(n_bytes) for n_bytes in lengths]
    return FrameBits(sum(bits.nominal for bits in each), sum(bits.worst for bits in each))


def bus_load(lengths: Iterable[int], rate_hz: float, bitrate: float) -> BusLoad:
    """How full a bus is when the frames come `rate_hz` times a second.

    Args:
        lengths: Data bytes of the frames of one cycle, all with 11-bit identifiers.
        rate_hz: Cycles per second.
        bitrate: Of the bus [bit/s].
    """
    bits = bits_of(lengths)
    return BusLoad(bits.nominal * rate_hz / bitrate, bits.worst * rate_hz / bitrate)
