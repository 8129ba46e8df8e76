"""The interlocks that keep a run from moving on when its recording is in danger."""

from __future__ import annotations

import math
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

from hil.core import StructArray
from hil.engine.interlock_protocol import Action, Margin, Trip

POLL_S = 1.0
"""Between two looks at the disk [s]."""

NO_ANSWER_S = 10.0
"""A disk that has not answered for so long counts as broken [s]."""

CLEAR_FACTOR = 1.2
"""A disk with so many times the least space has enough again."""


def free_bytes(folder: Path) -> int:
    """Free space [B] where `folder` is, for whoever runs this."""
    return shutil.disk_usage(folder).free


class Backlog:
    """Trips when writing has fallen behind reading.

    Args:
        behind_s: How far, now [s]; cheap, and never waits.
        limit_s: How far it may be [s].
        action: What a trip does.
    """

    name = "recorder"

    def __init__(
        self, behind_s: Callable[[], float], limit_s: float, *, action: Action = "stop"
    ) -> None:
        self.action = action
        self.watches = f"{limit_s:g} s behind"
        self._behind_s = behind_s
        self._limit_s = limit_s

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        behind = self._behind_s()
        if behind <= self._limit_s:
            return None
        time_s = float(block["device_time"][-1])
        return Trip(self.name, -1, behind, self._limit_s, "s", time_s, "backlog of the recorder")

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return self._behind_s() <= 0.5 * self._limit_s

    def margin(self, block: StructArray) -> Margin | None:
        """See `HasMargin.margin`."""
        behind, limit = self._behind_s(), self._limit_s
        return Margin(behind, limit, "s", max(0.0, 1 - behind / limit), subject="backlog")


class FreeSpace:
    """Trips when a disk fills up, or does not answer.

    A thread of its own looks: asking a network disk that is gone takes for ever. It begins with
    the first check, which waits for its first answer: at that time the run is only being armed.

    Args:
        folder: Returns a folder on the disk.
        least_mb: Least free space [MB].
        action: What a trip does.
        free: Free space of a folder's disk [B]; may wait or raise `OSError`.
        now: Monotonic clock [s].
        poll_s: Between two looks [s].
    """

    name = "disk"

    def __init__(
        self,
        folder: Callable[[], Path],
        least_mb: float,
        *,
        action: Action = "stop",
        free: Callable[[Path], int] = free_bytes,
        now: Callable[[], float] = time.monotonic,
        poll_s: float = POLL_S,
    ) -> None:
        self.action = action
        self.watches = f"{least_mb:g} MB free"
        self._folder = folder
        self._least_mb = least_mb
        self._free = free
        self._now = now
        self._poll_s = poll_s
        self._free_mb, self._answered = float("inf"), now()
        self._first, self._closing = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        if self._thread is None:
            self._begin()
        silent = self._now() - self._answered > NO_ANSWER_S
        if not silent and self._free_mb >= self._least_mb:
            return None
        found = float("nan") if silent else self._free_mb
        subject = f"free space for {self._folder()}"
        time_s = float(block["device_time"][-1])
        return Trip(self.name, -1, found, self._least_mb, "MB", time_s, subject, least=True)

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return self.check(block) is None and self._free_mb >= CLEAR_FACTOR * self._least_mb

    def margin(self, block: StructArray) -> Margin | None:
        """See `HasMargin.margin`."""
        free, least = self._free_mb, self._least_mb
        if math.isinf(free):
            return None
        share = max(0.0, 1 - least / free) if free > 0 else 0.0
        return Margin(free, least, "MB", share, subject="free space", least=True)

    def close(self) -> None:
        """End the thread; one that waits for a disk is left to it."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(self._poll_s)

    def _begin(self) -> None:
        self._answered, folder = self._now(), self._folder()
        self._thread = threading.Thread(
            target=self._look, args=(folder,), name="hil-free-space", daemon=True
        )
        self._thread.start()
        self._first.wait(self._poll_s)

    def _look(self, folder: Path) -> None:
        while not self._closing.is_set():
            try:
                self._free_mb = self._free(folder) / 1e6
                self._answered = self._now()
            except OSError:  # counts as no answer
                pass
            self._first.set()
            self._closing.wait(self._poll_s)
