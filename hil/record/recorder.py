"""The recorder thread: the control thread hands over blocks and never touches a disk.

Durability. Every `flush_interval_s` (0.1 s) of wall time the thread writes what has come in and
closes the chunk, so that killing the process loses at most that much plus one write. Every
`fsync_interval_s` it also calls `fsync`, so that a power loss loses at most that much plus the
time the disk takes; set it higher on slow media, or to infinity where only kills are feared.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from types import MappingProxyType, TracebackType
from typing import Any, Literal

import numpy as np

from hil.errors import RecordingError
from hil.record.continuity import Counts
from hil.record.writer import McapWriter, require_rows_of
from hil.typing import StructArray


class Recorder:
    """Records blocks of rows through a thread of its own; nothing is ever dropped.

    `put` is called by one thread, the control thread. `put_event` may be called by any.

    Args:
        writer: The open file; the recorder finishes it, or abandons it when writing fails.
        flush_interval_s: Wall time between flushes [s].
        fsync_interval_s: Wall time between calls of fsync [s].
        backlog_limit_s: How far writing may fall behind, in seconds of data at nominal rates.
        on_backlog: `raise` beyond the limit, or `wait` for the disk: right for virtual clocks
            only, where the robot stands still while nobody reads.
    """

    def __init__(
        self,
        writer: McapWriter,
        *,
        flush_interval_s: float = 0.1,
        fsync_interval_s: float = 0.1,
        backlog_limit_s: float = 10.0,
        on_backlog: Literal["raise", "wait"] = "raise",
    ) -> None:
        self._writer = writer
        self._flush_interval_s = flush_interval_s
        self._fsync_interval_s = fsync_interval_s
        self._limit = max(1, int(backlog_limit_s * sum(t.rate_hz for t in writer.topics.values())))
        self._on_backlog = on_backlog
        self._blocks: deque[tuple[str, bytes]] = deque()
        self._events: deque[Mapping[str, Any]] = deque()
        self._rows_put = self._rows_written = 0
        self._counts = {name: Counts() for name in writer.topics}
        self._error: BaseException | None = None
        self._closing = False
        self._wake, self._progress = threading.Event(), threading.Event()
        self._last_flush = self._last_fsync = time.monotonic()
        self._unsynced = False
        self._thread = threading.Thread(target=self._run, name="hil-recorder", daemon=True)
        self._thread.start()

    @property
    def backlog(self) -> int:
        """Rows handed over but not written yet."""
        return self._rows_put - self._rows_written

    @property
    def counts(self) -> Mapping[str, Counts]:
        """Samples, gaps, duplicates and overruns per topic, up to what has been written."""
        return MappingProxyType(self._counts)

    def put(self, topic: str, rows: StructArray) -> None:
        """Hand over rows of a topic; they are copied, and kept even when this raises.

        Raises:
            RecordingError: Writing has failed, or has fallen behind by more than the limit.
        """
        require_rows_of(self._writer.topics, topic, rows)
        self._require_alive()
        # As bytes: copying a structured array goes field by field and takes ten times as long.
        self._blocks.append((topic, rows.tobytes()))
        self._rows_put += len(rows)
        if self.backlog > self._limit // 2:
            self._wake.set()
        if self.backlog > self._limit:
            self._fallen_behind()

    def put_event(self, event: Mapping[str, Any]) -> None:
        """Hand over an event (`t`, `kind` and anything JSON can hold) for `/events`.

        Raises:
            RecordingError: Writing has failed.
        """
        self._require_alive()
        self._events.append(event)

    def close(self, timeout_s: float = 60.0) -> Mapping[str, Counts]:
        """Write everything out and finish the file. Idempotent; returns the final counts.

        Raises:
            RecordingError: Writing has failed or did not end in time; what was flushed is kept
                in the partial file.
        """
        self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise RecordingError(
                f"{self._writer.partial_path} could not be finished within {timeout_s:g} s",
                hint="the disk hangs or is far too slow; what was flushed is kept in that file",
            )
        if self._error is not None:
            raise self._as_recording_error()
        return self.counts

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except RecordingError:
            # The first error is the one that explains; this one would hide it.
            if error is None:
                raise

    def _require_alive(self) -> None:
        if self._error is not None:
            raise self._as_recording_error()
        if not self._thread.is_alive() or self._closing:
            raise RecordingError(f"the recorder of {self._writer.path} is closed")

    def _as_recording_error(self) -> RecordingError:
        if isinstance(self._error, RecordingError):
            return RecordingError(self._error.message, hint=self._error.hint)
        return RecordingError(f"the recorder of {self._writer.path} died: {self._error!r}")

    def _fallen_behind(self) -> None:
        while self._on_backlog == "wait" and self.backlog > self._limit:
            self._progress.wait(self._flush_interval_s)
            self._progress.clear()
            self._require_alive()
        if self.backlog > self._limit:
            raise RecordingError(
                f"recording has fallen behind by {self.backlog} rows (limit {self._limit}); "
                "they are kept, but the disk does not keep up",
                hint="record to a faster disk, at a lower rate, or raise the fsync interval",
            )

    def _run(self) -> None:
        try:
            while not self._closing:
                self._wake.wait(self._flush_interval_s)
                self._wake.clear()
                self._write_backlog()
                self._flush()
            self._write_backlog()
            self._writer.finish()
        except BaseException as error:  # whatever it was, the control thread has to hear of it
            self._error = error
            self._writer.abandon()

    def _write_backlog(self) -> None:
        blocks = [self._blocks.popleft() for _ in range(len(self._blocks))]
        events = [self._events.popleft() for _ in range(len(self._events))]
        for name in dict.fromkeys(name for name, _ in blocks):
            topic = self._writer.topics[name]
            content = b"".join(block for of_topic, block in blocks if of_topic == name)
            rows = np.frombuffer(content, topic.dtype)
            self._writer.write(name, rows)
            self._counts[name] = self._counts[name].after(rows, topic.rate_hz)
            self._rows_written += len(rows)
        for event in events:
            self._writer.write_event(event)
        self._unsynced |= bool(blocks or events)
        self._progress.set()

    def _flush(self) -> None:
        now = time.monotonic()
        if now - self._last_flush < self._flush_interval_s:
            return
        durable = self._unsynced and now - self._last_fsync >= self._fsync_interval_s
        self._writer.flush(durable=durable)
        self._last_flush = now
        if durable:
            self._last_fsync, self._unsynced = now, False
