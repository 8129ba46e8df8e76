"""What waits to be sent on a CAN bus, and which of it has priority."""

from __future__ import annotations

import heapq
import itertools
from collections import deque

from hil.can.frame import EXTENDED, REMOTE


def arbitration(can_id: int) -> int:
    """The field that decides who sends, as a number: the lowest wins (ISO 11898-1).

    The 11 leading bits, then RTR or SRR, IDE, the 18 further bits and RTR of an extended frame.
    """
    remote = 1 if can_id & REMOTE else 0
    if can_id & EXTENDED:
        base, further = can_id >> 18 & 0x7FF, can_id & 0x3_FFFF
        return base << 21 | 0b11 << 19 | further << 1 | remote
    return (can_id & 0x7FF) << 21 | remote << 20


def _priority(raw: bytes) -> int:
    return arbitration(int.from_bytes(raw[:4], "little"))


class InOrder:
    """One controller: its frames leave in the order in which they came."""

    def __init__(self) -> None:
        self._frames: deque[bytes] = deque()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def head(self) -> int:
        """What its next frame has in arbitration."""
        return _priority(self._frames[0])

    def put(self, raw: bytes) -> None:
        """One more frame."""
        self._frames.append(raw)

    def squeeze(self, raw: bytes) -> None:
        """It is full: the new frame is dropped."""

    def take(self) -> bytes:
        """The next frame, which leaves."""
        return self._frames.popleft()


class Sorted:
    """Many controllers: the lowest identifier leaves first, equal ones in order."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, int, bytes]] = []
        self._number = itertools.count()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def head(self) -> int:
        """What its next frame has in arbitration."""
        return self._frames[0][0]

    def put(self, raw: bytes) -> None:
        """One more frame."""
        heapq.heappush(self._frames, (_priority(raw), next(self._number), raw))

    def squeeze(self, raw: bytes) -> None:
        """It is full: what would leave last is dropped, so that one node cannot stop another."""
        self.put(raw)
        self._frames.remove(max(self._frames))
        heapq.heapify(self._frames)

    def take(self) -> bytes:
        """The next frame, which leaves."""
        return heapq.heappop(self._frames)[2]


Queue = InOrder | Sorted
