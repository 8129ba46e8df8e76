"""Set-points on their way into the PLC: chunks, and two sums that the PLC adds up as well."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hil.core import StructArray
from hil.robot import Segment

Write = Callable[[bytes, int], None]
"""Puts bytes into the PLC's array of set-points, from this byte on."""

MODULO = 2**32


def set_points(segment: Segment, kind: np.dtype[Any]) -> StructArray:
    """(N,) rows of the PLC's array for the samples of a segment."""
    rows = np.zeros(len(segment.q), kind)
    rows["aQ"], rows["aQd"], rows["aQdd"] = segment.q, segment.qd, segment.qdd
    return rows


def sums_of(rows: StructArray) -> tuple[int, int]:
    """The sum of all 32-bit words, and the sum of its intermediate results, modulo 2³².

    The second one knows the order: words that are exchanged change it (J. G. Fletcher, 1982).
    """
    words = np.frombuffer(rows.tobytes(), "<u4").astype(np.uint64)
    # Wraps at 2⁶⁴, which keeps what is left modulo 2³².
    weights = np.arange(len(words), 0, -1, dtype=np.uint64)
    return int(words.sum()) % MODULO, int((weights * words).sum()) % MODULO


def upload(rows: StructArray, write: Write, chunk_bytes: int) -> None:
    """Write set-points, whole rows at a time.

    Args:
        rows: (N,) set-points.
        write: Writes.
        chunk_bytes: Most that is written at once.
    """
    most = max(1, chunk_bytes // rows.itemsize)
    for first in range(0, len(rows), most):
        write(rows[first : first + most].tobytes(), first * rows.itemsize)
