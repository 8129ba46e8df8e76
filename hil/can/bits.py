"""What classic CAN frames cost on the wire, and how full a bus is with a list of them.

Counted with the interframe space, as ISO 11898-1 lays frames out. Bits are stuffed from the start
of the frame to the end of its check sum: one more at most after every fourth of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

_STUFFED, _STUFFED_EXTENDED = 34, 54
"""Bits open to stuffing, without data: 11- and 29-bit identifiers."""
_PLAIN = 13
"""The others: delimiters, acknowledgement, end of frame and interframe space."""


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
