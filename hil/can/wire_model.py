"""Model of the wire of a classic CAN bus: one frame at a time, the lowest identifier first.

The model is deterministic and has no clock: the caller passes the time with every call. In the
model each frame has the maximum number of stuff bits. Frames that fit onto the modelled wire
therefore also fit onto a real wire. Transmission errors are not modelled.

Frames wait in transmit queues until the wire is free. A participant with one controller sends in
the order of its program (`InOrder`). A participant with many controllers sends the lowest
identifier first (`Sorted`), like the arbitration between these controllers.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

from hil.can.frames import EXTENDED, FRAME, REMOTE, frame_bits

DEPTH = 64
"""Capacity of the transmit queue of one participant [frames]."""


class Passed(NamedTuple):
    """Frame that was transmitted.

    Attributes:
        end: Key of the participant that sent the frame.
        raw: The 16 bytes of the frame.
        at_s: Time at which the last bit of the frame was on the wire [s].
    """

    end: Hashable
    raw: bytes
    at_s: float


class Wire:
    """Model of the wire that several participants share.

    Args:
        bitrate: Bit rate of the bus [bit/s].
        speed: Ratio of bus time to the time of the caller's clock.
        depth: Capacity of a transmit queue [frames].

    Attributes:
        busy_s: Total time for which the wire was busy up to the last call [s of the caller's
            clock].
        frames: Number of transmitted frames.
        refused: Number of frames dropped because the transmit queue of their sender was full.
    """

    def __init__(self, bitrate: float, *, speed: float = 1.0, depth: int = DEPTH) -> None:
        if not (bitrate > 0 and speed > 0 and depth > 0):
            raise ValueError("bit rate, speed and depth of a wire must be above 0")
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
        """Add a participant.

        Args:
            end: Key of the participant.
            sorts: Whether the participant has several controllers, whose frames are sorted by
                identifier.
        """
        self._queues[end] = Sorted() if sorts else InOrder()

    def leave(self, end: Hashable) -> None:
        """Remove a participant after its queued frames were transmitted."""
        self._leaving.add(end)
        self._tidy(end)

    def forget(self, end: Hashable) -> None:
        """Drop the frames in a participant's transmit queue."""
        self._queues[end] = type(self._queues[end])()

    def offer(self, end: Hashable, raw: bytes, now_s: float) -> bool:
        """Queue a frame of a participant; return whether the transmit queue had space.

        If the queue is full, the new frame is dropped. If the participant sorts its frames, the
        frame with the highest identifier is dropped instead.
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
        """Return the frames transmitted since the last call, in the order of transmission."""
        self._advance(now_s)
        passed, self._passed = self._passed, []
        return passed

    def waiting(self, end: Hashable) -> int:
        """Return the number of frames in a participant's queue, without the frame on the wire."""
        return len(self._queues[end])

    @property
    def due_s(self) -> float | None:
        """Time at which the next frame is transmitted; `None` if no frame is pending."""
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
        """Start the transmission of the frame with the lowest identifier in all queues."""
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
    """Return the bits of a frame with all possible stuff bits; a remote frame has no data."""
    can_id, length, _ = FRAME.unpack(raw)
    return frame_bits(0 if can_id & REMOTE else length, extended=bool(can_id & EXTENDED)).worst


class InOrder:
    """Transmit queue of one controller, which sends frames in the order of their arrival."""

    def __init__(self) -> None:
        self._frames: deque[bytes] = deque()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def head(self) -> int:
        """Arbitration value of the next frame."""
        return _priority(self._frames[0])

    def put(self, raw: bytes) -> None:
        """Add a frame."""
        self._frames.append(raw)

    def squeeze(self, raw: bytes) -> None:
        """Drop the new frame, because the queue is full."""

    def take(self) -> bytes:
        """Remove and return the frame that arrived first."""
        return self._frames.popleft()


class Sorted:
    """Transmit queue of many controllers, which sends the lowest identifier first.

    Frames with equal identifiers are sent in the order of their arrival.
    """

    def __init__(self) -> None:
        self._frames: list[tuple[int, int, bytes]] = []
        self._number = itertools.count()

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def head(self) -> int:
        """Arbitration value of the next frame."""
        return self._frames[0][0]

    def put(self, raw: bytes) -> None:
        """Add a frame."""
        heapq.heappush(self._frames, (_priority(raw), next(self._number), raw))

    def squeeze(self, raw: bytes) -> None:
        """Add a frame to a full queue and drop the last, so that no node blocks the others."""
        self.put(raw)
        self._frames.remove(max(self._frames))
        heapq.heapify(self._frames)

    def take(self) -> bytes:
        """Remove and return the frame with the lowest identifier."""
        return heapq.heappop(self._frames)[2]


def _priority(raw: bytes) -> int:
    return arbitration(int.from_bytes(raw[:4], "little"))


def arbitration(can_id: int) -> int:
    """Return an identifier's arbitration field as a number; the lowest wins (ISO 11898-1).

    The field consists of the 11 leading bits, then RTR or SRR, IDE, the 18 further bits and RTR of
    an extended frame.
    """
    remote = 1 if can_id & REMOTE else 0
    if can_id & EXTENDED:
        base, further = can_id >> 18 & 0x7FF, can_id & 0x3_FFFF
        return base << 21 | 0b11 << 19 | further << 1 | remote
    return (can_id & 0x7FF) << 21 | remote << 20


Queue = InOrder | Sorted
