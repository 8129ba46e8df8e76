"""Pulls the PLC's ring in blocks: every row once, in order, and what was lost is counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from hil.core import RobotConnectionError, StructArray

Read = Callable[[int, int], bytes]
"""Bytes of the ring: from which byte on, and how many."""

SAFE_ROWS = 256
"""Rows next to being overwritten that are not asked for after an overrun: they were gone by the
time they are read."""

TORN_AGAIN = 3
"""How often a block with a torn row is read again."""


class Ring:
    """Follows one ring.

    Args:
        read: Reads its bytes.
        row: dtype of a row.
        rows: Its length.
        chunk_bytes: Most that is read at once.

    Attributes:
        next: Sequence number of the row that is read next.
        gaps: How often rows were overwritten before they were read.
        lost: How many rows that were.
        skipped: Rows that nobody wanted: nothing had been started, and nobody had read for long.
        torn: How often a block was read again because a row in it was being written.
    """

    def __init__(self, read: Read, row: np.dtype[Any], rows: int, chunk_bytes: int) -> None:
        self._read, self._row, self._rows = read, row, rows
        self._most = max(1, chunk_bytes // row.itemsize)
        self.next = self.gaps = self.lost = self.skipped = self.torn = 0
        self._behind_gap = -1

    def begin(self, head: int) -> None:
        """Forget what was before; the next row is the one with this number."""
        self.next = head

    def forget(self, head: int, keep: int) -> None:
        """Leave out what is older than the newest `keep` rows before `head`: nobody wants it."""
        if head - self.next > keep:
            self.skipped += head - keep - self.next
            self.next = head - keep

    def pull(self, head: int) -> StructArray:
        """(N,) rows that have been written and not been read.

        Args:
            head: Rows written so far; the newest has the number before it.

        Raises:
            RobotConnectionError: The PLC has begun anew, or gives rows that are none.
        """
        if head < self.next:
            raise RobotConnectionError(
                f"the PLC's program was started anew: {head} rows written, {self.next} were read",
                hint="see to the PLC, then connect again",
            )
        if head - self.next > self._rows:
            self._skip_to(head - self._rows + min(SAFE_ROWS, self._rows // 2))
        blocks = []
        while self.next < head:
            block = self._block(min(self._most, head - self.next))
            blocks.append(block)
            self.next += len(block)
        return np.concatenate(blocks) if blocks else np.zeros(0, self._row)

    def _block(self, count: int) -> StructArray:
        """Rows that lie behind each other; fewer than asked for where the ring turns."""
        at = self.next % self._rows
        count = min(count, self._rows - at)
        size = self._row.itemsize
        for _ in range(TORN_AGAIN):
            rows = np.frombuffer(self._read(at * size, count * size), self._row)
            expected = np.arange(self.next, self.next + count, dtype=np.uint64)
            whole = (rows["nSequence"] == expected) & (rows["nSequenceEnd"] == expected)
            if whole.all():
                return rows
            newest = int(np.minimum(rows["nSequence"], rows["nSequenceEnd"]).max())
            if newest >= self.next + self._rows:
                # Overtaken while reading: what is left of this lap begins behind the newest.
                self._skip_to(newest - self._rows + 1 + min(SAFE_ROWS, self._rows // 2))
                return rows[:0]
            self.torn += 1
        raise RobotConnectionError(
            f"row {self.next} of the PLC's ring is none: its number is "
            f"{int(rows['nSequence'][0])} and {int(rows['nSequenceEnd'][0])}",
            hint="is another program running in the PLC? connect again",
        )

    def _skip_to(self, number: int) -> None:
        """Give up the rows before this number; gaps without a row between them are one."""
        self.gaps += self.next != self._behind_gap
        self.lost += number - self.next
        self.next = self._behind_gap = number
