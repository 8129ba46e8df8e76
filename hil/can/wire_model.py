"""The wire of a classic CAN bus: one frame at a time, the lowest identifier first.

Deterministic: it has no clock of its own, every call says what time it is. A frame counts with all
the stuff bits it can have: what passes here passes on a real wire. Errors are not modelled.

Participants wait in transmit queues. One controller sends in the order of its program (`InOrder`);
an end behind which there are many controllers sends the lowest identifier first (`Sorted`), as they
would among themselves.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

from hil.can.frames import EXTENDED, FRAME, REMOTE, frame_bits

DEPTH = 64
"""Frames that the transmit queue of one participant takes."""


class Passed(NamedTuple):
    """A frame that has passed.

    Attributes:
        end: Who has sent it.
        raw: The frame.
        at_s: When its last bit was on the wire.
    """

    end: Hashable
    raw: bytes
    at_s: float


class Wire:
    """A wire that several participants want to use.

    Args:
        bitrate: Of the bus [bit/s].
        speed: Seconds of the bus in one second of the caller's clock.
        depth: Frames that a transmit queue takes.

    Attributes:
        busy_s: For how long it was busy up to the last call [s of the caller's clock].
        frames: That have passed.
        refused: That were dropped because the queue of their sender was full.
    """

    def __init__(self, bitrate: float, *, speed: float = 1.0, depth: int = DEPTH) -> None:
        if not (bitrate > 0 and speed > 0 and depth > 0):
            raise ValueError("bit rate, speed and depth of a wire are above 0")
        self._bit_s = 1.0 / (bitrate * speed)
        self._depth = depth
        self._queues: dict[Hashable, Queue] = {}
        self._leaving: set[Hashable] = set()
        self._passing: Passed | None = None
        self._passed: list[Passed] = []
        self.busy_s = 0.0
        self.frames = 0
        self.refused = 0

    def join(self, end: Hashable, *, sorts: bool = False) -> None:
        """One more participant.

        Args:
            end: Names it.
            sorts: Several controllers are behind it: its own frames compete with each other.
        """
        self._queues[end] = Sorted() if sorts else InOrder()

    def leave(self, end: Hashable) -> None:
        """It goes; what it has handed to its controller before still passes."""
        self._leaving.add(end)
        self._tidy(end)

    def forget(self, end: Hashable) -> None:
        """Drop what waits in its queue."""
        self._queues[end] = type(self._queues[end])()

    def offer(self, end: Hashable, raw: bytes, now_s: float) -> bool:
        """It wants to send a frame; whether its queue had room.

        Where it had none, one frame was dropped: the new one, or that of the highest identifier
        behind an end that sorts.
        """
        self._advance(now_s)
        queue = self._queues[end]
        if len(queue) >= self._depth:
            self.refused += 1
            queue.squeeze(raw)
            return False
        queue.put(raw)
        if self._passing is None:
            self._start(now_s)
        return True

    def passed(self, now_s: float) -> list[Passed]:
        """Frames that have passed since the last call, in order."""
        self._advance(now_s)
        passed, self._passed = self._passed, []
        return passed

    def waiting(self, end: Hashable) -> int:
        """Frames in the queue of a participant, without the one on the wire."""
        return len(self._queues[end])

    @property
    def due_s(self) -> float | None:
        """When there is a frame that has passed, `None` while there is none to come."""
        if self._passed:
            return self._passed[0].at_s
        return self._passing.at_s if self._passing else None

    def _advance(self, now_s: float) -> None:
        while self._passing is not None and self._passing.at_s <= now_s:
            passing = self._passing
            self._passed.append(passing)
            self.frames += 1
            self._start(passing.at_s)

    def _start(self, at_s: float) -> None:
        """The wire is free: the lowest identifier among those who want to send wins."""
        ready = [(queue.head, end) for end, queue in self._queues.items() if len(queue)]
        if not ready:
            self._passing = None
            return
        _, winner = min(ready, key=lambda pair: pair[0])
        raw = self._queues[winner].take()
        self._tidy(winner)
        lasts_s = bits_on_wire(raw) * self._bit_s
        self.busy_s += lasts_s
        self._passing = Passed(winner, raw, at_s + lasts_s)

    def _tidy(self, end: Hashable) -> None:
        if end in self._leaving and not len(self._queues[end]):
            self._leaving.discard(end)
            del self._queues[end]


def bits_on_wire(raw: bytes) -> int:
    """Bits of a frame with all the stuff bits it can have; a remote frame has no data."""
    can_id, length, _ = FRAME.unpack(raw)
    return frame_bits(0 if can_id & REMOTE else length, extended=bool(can_id & EXTENDED)).worst


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


def _priority(raw: bytes) -> int:
    return arbitration(int.from_bytes(raw[:4], "little"))


def arbitration(can_id: int) -> int:
    """The field that decides who sends, as a number: the lowest wins (ISO 11898-1).

    The 11 leading bits, then RTR or SRR, IDE, the 18 further bits and RTR of an extended frame.
    """
    remote = 1 if can_id & REMOTE else 0
    if can_id & EXTENDED:
        base, further = can_id >> 18 & 0x7FF, can_id & 0x3_FFFF
        return base << 21 | 0b11 << 19 | further << 1 | remote
    return (can_id & 0x7FF) << 21 | remote << 20


Queue = InOrder | Sorted
