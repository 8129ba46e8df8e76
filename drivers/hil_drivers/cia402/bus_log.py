"""A log of the bus while the arm is driven; the thread that owns the bus never waits for a disk."""

from __future__ import annotations

from collections import deque

from hil.canbus.candump import CandumpWriter
from hil.canbus.frame import unpack_frame


class BusLog:
    """All frames in the order in which this end saw them, as `candump -L` writes them.

    Args:
        path: File; what is there is replaced.
        channel: How to call the bus in it.

    Raises:
        RecordingError: The file cannot be made; `flush` and `close` raise it as well.
    """

    def __init__(self, path: str, channel: str) -> None:
        self._writer = CandumpWriter(path, "".join(channel.split()) or "can")
        self._waiting: deque[tuple[float, bytes]] = deque()

    def __call__(self, time_s: float, raw: bytes) -> None:
        """Keep a frame [Unix time, 16 bytes]; from any thread."""
        self._waiting.append((time_s, raw))

    def flush(self) -> None:
        """Write what is kept; from one thread."""
        while self._waiting:
            time_s, raw = self._waiting.popleft()
            self._writer.write(unpack_frame(raw, time_s))

    def close(self) -> None:
        """Write all and be done. Idempotent."""
        self.flush()
        self._writer.close()
