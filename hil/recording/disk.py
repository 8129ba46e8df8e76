"""The thread that waits for the disk: fsync, opening the next part, finishing the last one.

A disk may take half a second for one fsync. The recorder thread therefore only writes into the
kernel, which is what a kill cannot undo, and everything that has to wait is done here.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Literal

from hil.recording.mcap_writer import McapWriter

_LONGEST_WAIT_S = 1.0

NextPart = Callable[[int], McapWriter]
"""Opens a part of the recording by its number: 1 is the one after the first."""


class DiskThread:
    """Keeps the open part durable and has the next one ready; owned by the recorder thread.

    Args:
        writer: The open part.
        next_part: Opens the part that follows, None where there is none.
        fsync_interval_s: Wall time between calls of fsync [s].
        failed: Told what went wrong, in this thread; nothing more is done after it.
    """

    def __init__(
        self,
        writer: McapWriter,
        next_part: NextPart | None,
        fsync_interval_s: float,
        failed: Callable[[BaseException], None],
    ) -> None:
        self._writer = writer
        self._next_part = next_part
        self._interval_s = fsync_interval_s
        self._failed = failed
        self._part = 0
        self._unsynced = False
        # None → "wanted" → a part → None: the recorder thread asks and takes, this one opens. With
        # one owner for every step there is no moment in which a part could be opened in vain.
        self._next: Literal["wanted"] | McapWriter | None = None
        self._full: deque[McapWriter] = deque()
        self._ending: Callable[[], None] | None = None
        self._wake = threading.Event()
        self._last_sync = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="hil-disk", daemon=True)
        self._thread.start()

    def written(self) -> None:
        """The open part has got something that no disk has yet."""
        self._unsynced = True

    def part_after(self, writer: McapWriter) -> McapWriter | None:
        """The next part once it is open, else None: it is being opened then; ask again.

        When there is one, `writer`, which must be flushed, is finished here in its own time.
        """
        new = self._next
        if new is None:
            self._next = "wanted"
            self._wake.set()
        if new is None or new == "wanted":
            return None
        self._next = None
        self._full.append(writer)
        self._writer = new
        self._wake.set()
        return new

    def finish(self) -> None:
        """Nothing more will be written: have all parts finished, then end."""
        self._end(self._finish_all)

    def abandon(self) -> None:
        """Have all parts closed as they are, then end."""
        self._end(self._abandon_all)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; returns whether it came in time."""
        self._thread.join(max(0.0, timeout_s))
        return not self._thread.is_alive()

    def _end(self, how: Callable[[], None]) -> None:
        self._ending = how
        self._wake.set()

    def _run(self) -> None:
        try:
            while self._ending is None:
                self._wake.wait(min(self._interval_s, _LONGEST_WAIT_S))
                self._wake.clear()
                self._finish_full()
                self._open_next()
                self._sync_if_due()
            self._ending()
        except BaseException as error:  # whatever it was, the control thread has to hear of it
            self._failed(error)
            self._wait_for_the_end()
            self._abandon_all()

    def _finish_full(self) -> None:
        while self._full:
            self._full[0].finish()
            self._full.popleft()

    def _open_next(self) -> None:
        if self._next == "wanted" and self._next_part is not None:
            self._part += 1
            self._next = self._next_part(self._part)

    def _sync_if_due(self) -> None:
        now = time.monotonic()
        if self._unsynced and now - self._last_sync >= self._interval_s:
            self._last_sync, self._unsynced = now, False
            self._writer.sync()

    def _finish_all(self) -> None:
        self._finish_full()
        self._discard_next()
        self._writer.finish()

    def _abandon_all(self) -> None:
        self._discard_next()
        for writer in (*self._full, self._writer):
            writer.abandon()

    def _discard_next(self) -> None:
        if isinstance(self._next, McapWriter):
            self._next.discard()

    def _wait_for_the_end(self) -> None:
        """The recorder thread goes on writing to the open part until it is told to close."""
        while self._ending is None:
            self._wake.wait(_LONGEST_WAIT_S)
            self._wake.clear()
