"""A log of the bus while the arm is driven; the thread that owns the bus never waits for a disk."""

from __future__ import annotations

import itertools
from collections import deque
from pathlib import Path

from hil.can import CandumpWriter, unpack_frame


class BusLog:
    """All frames in the order in which this end saw them, as `candump -L` writes them.

    Args:
        path: File; where there is one, the first of `run-2.log`, `run-3.log`, … that is free: a log
            is one connection, and that of another is not lost.
        channel: How to call the bus in it.

    Raises:
        RecordingError: The file cannot be made; `flush` and `close` raise it as well.
    """

    def __init__(self, path: str, channel: str) -> None:
        self._writer = CandumpWriter(_free(Path(path)), "".join(channel.split()) or "can")
        self._waiting: deque[tuple[float, bytes]] = deque()

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._writer.path

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


def _free(path: Path) -> Path:
    others = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return next(each for each in itertools.chain([path], others) if not each.exists())
