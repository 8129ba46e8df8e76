"""Classic CAN frames: memory layout of SocketCAN (16 bytes), and number of bits on the wire.

A raw AF_CAN socket and the bus between processes use the same bytes, so a driver needs only one
format of frames. The number of bits on the wire includes the interframe space, according to ISO
11898-1. Stuff bits are inserted from the start of the frame to the end of its check sum: at most
one stuff bit after every four bits.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import NamedTuple

FRAME = struct.Struct("<IB3x8s")
"""`struct` layout of a frame: identifier with flags, data length, data padded to eight bytes."""

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Flags in the identifier of a frame; CANopen uses neither extended nor remote frames."""

ID_MASK = 0x1FFF_FFFF

ERROR_BUS_OFF = 0x40
"""Bit in the identifier of an error frame: the controller of this computer is off the bus."""

ERROR_CONTROLLER = 0x04
"""Bit in the identifier of an error frame: the second data byte contains the problem."""

TX_OVERFLOW = 0x02
"""Bit in the second data byte of an error frame: the transmit queue dropped a frame."""

ERROR_RESTARTED = 0x100
"""Bit in the identifier of an error frame: the controller of this computer is back on the bus."""


class Frame(NamedTuple):
    """Data frame.

    Attributes:
        id: 11-bit identifier of the frame, which CANopen calls COB-ID.
        data: 0 to 8 data bytes.
        time_s: Unix time of the reception [s]; 0 if the time is unknown.
    """

    id: int
    data: bytes
    time_s: float = 0.0


def pack_frame(can_id: int, data: bytes) -> bytes:
    """Return the 16 bytes of a data frame."""
    return FRAME.pack(can_id, len(data), data)


def unpack_frame(raw: bytes, time_s: float = 0.0) -> Frame:
    """Return the frame that 16 bytes contain; the flags remain in `id`."""
    can_id, length, data = FRAME.unpack(raw)
    return Frame(can_id, data[:length], time_s)


class FrameBits(NamedTuple):
    """Number of bits of one frame.

    Attributes:
        nominal: Number of bits without stuff bits.
        worst: Number of bits with the maximum number of stuff bits.
    """

    nominal: int
    worst: int


class BusLoad(NamedTuple):
    """Bus load as a share of the bit rate: 1.0 is a full bus.

    Attributes:
        nominal: Bus load without stuff bits.
        worst: Bus load with the maximum number of stuff bits.
    """

    nominal: float
    worst: float


_STUFFED, _STUFFED_EXTENDED = 34, 54
"""Number of bits subject to stuffing without data, for 11-bit and for 29-bit identifiers."""

_PLAIN = 13
"""Number of bits in a frame that are not subject to stuffing.

Bits without stuffing are the delimiters, acknowledgement, end of frame and interframe space.
"""


def frame_bits(n_bytes: int, *, extended: bool = False) -> FrameBits:
    """Return the number of bits of a data frame.

    Args:
        n_bytes: Number of data bytes, 0 to 8.
        extended: Whether the identifier has 29 bits instead of 11.

    Raises:
        ValueError: `n_bytes` is not a valid length of a classic CAN frame.
    """
    if not 0 <= n_bytes <= 8:
        raise ValueError(f"a classic CAN frame has 0 to 8 data bytes, not {n_bytes}")
    stuffed = (_STUFFED_EXTENDED if extended else _STUFFED) + 8 * n_bytes
    nominal = stuffed + _PLAIN
    return FrameBits(nominal, nominal + (stuffed - 1) // 4)


def bits_of(lengths: Iterable[int]) -> FrameBits:
    """Return the total number of bits of frames with given numbers of data bytes."""
    each = [frame_bits(n_bytes) for n_bytes in lengths]
    return FrameBits(sum(bits.nominal for bits in each), sum(bits.worst for bits in each))


def bus_load(lengths: Iterable[int], rate_hz: float, bitrate: float) -> BusLoad:
    """Return the load of a bus on which all frames of a cycle are sent `rate_hz` times per second.

    Args:
        lengths: Number of data bytes of each frame in one cycle; all frames have 11-bit
            identifiers.
        rate_hz: Cycle rate [Hz].
        bitrate: Bit rate of the bus [bit/s].
    """
    bits = bits_of(lengths)
    return BusLoad(bits.nominal * rate_hz / bitrate, bits.worst * rate_hz / bitrate)
