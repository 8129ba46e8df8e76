"""Recorder thread that writes rows to disk, so that the control thread does no file access.

The recorder uses two threads, because one fsync can take half a second on a slow disk. The recorder
thread only passes data to the kernel, and data in the kernel survive a kill of the process. The
disk thread performs all operations that wait for the disk: fsync, opening the next part and
finishing the last part of a recording.

Durability: every `flush_interval_s` (0.1 s) of wall time, the recorder thread passes all received
rows to the kernel. A kill of the process therefore loses at most the rows of 0.1 s plus the rows of
one write, however slow the disk is. The disk thread calls `fsync` every `fsync_interval_s` seconds,
so that a power loss loses at most the rows of `fsync_interval_s` plus the duration of one fsync. On
slow media, increase `fsync_interval_s`; set `fsync_interval_s` to infinity if the data must survive
only a kill of the process.

Rotation: when one part of the recording has reached `rotate_bytes`, the recorder continues in the
next part, which is already open; the disk thread finishes the previous part. Every row is in
exactly one part of the recording, and the counts of samples and gaps continue across parts.

Continuity: gaps, duplicates and overruns are counted during recording, with the device clock.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType, TracebackType
from typing import Any, Literal, NamedTuple

import numpy as np

from hil.core import RecordingError, StructArray
from hil.recording.mcap_writer import McapWriter, require_rows_of

NextPart = Callable[[int], McapWriter]
"""Callback that opens one part of the recording, identified by its number; number 1 is the
second part."""

_GAP_PERIODS = 1.5
_DUPLICATE_PERIODS = 0.1
_LONGEST_WAIT_S = 1.0


@dataclass(frozen=True, slots=True)
class Counts:
    """Continuity of the samples of one topic; T is the nominal sampling time 1/rate.

    Attributes:
        samples: Number of rows that were recorded.
        gaps: Number of pairs of consecutive samples between which the device time advanced by more
            than 1.5 T, so that at least one sample is missing in between.
        missing: Number of samples that are missing in the gaps, rounded.
        duplicates: Number of pairs of consecutive samples between which the device time advanced by
            less than 0.1 T, did not change or decreased.
        overruns: Number of samples that follow no gap but that the host received more than 1.5 T
            after the previous sample, because the read loop was too slow.
        first_time: Device time of the first sample [s]; NaN before the first sample.
        last_time: Device time of the newest sample [s].
        last_host_time: Host time of the newest sample [s].
    """

    samples: int = 0
    gaps: int = 0
    missing: int = 0
    duplicates: int = 0
    overruns: int = 0
    first_time: float = float("nan")
    last_time: float = float("nan")
    last_host_time: float = float("nan")

    def after(self, rows: StructArray, rate_hz: float) -> Counts:
        """Return new counts that also include `rows`.

        A row is any record with `device_time` and `host_time`.
        """
        if not len(rows):
            return self
        device, host = rows["device_time"], rows["host_time"]
        # Before the first sample the time is NaN, and comparisons with NaN are false.
        steps = np.diff(device, prepend=self.last_time) * rate_hz
        host_steps = np.diff(host, prepend=self.last_host_time) * rate_hz
        gap = steps > _GAP_PERIODS
        return replace(
            self,
            samples=self.samples + len(rows),
            gaps=self.gaps + int(gap.sum()),
            missing=self.missing + int(np.rint(steps[gap] - 1.0).sum()),
            duplicates=self.duplicates + int((steps < _DUPLICATE_PERIODS).sum()),
            overruns=self.overruns + int((~gap & (host_steps > _GAP_PERIODS)).sum()),
            first_time=float(device[0]) if self.samples == 0 else self.first_time,
            last_time=float(device[-1]),
            last_host_time=float(host[-1]),
        )


class Recorder:
    """Recorder that writes blocks of rows in a separate thread and never drops a row.

    Only one thread, the control thread, is allowed to call `put` and `close`; any thread can call
    the other methods.

    Args:
        writer: Writer of the first part of the recording, already open. The recorder finishes the
            MCAP file of the writer, or leaves the file unfinished if writing fails.
        next_part: Callback that opens part 1, 2, … with the same topics when the recording is
            rotated; never called in the control thread.
        rotate_bytes: Size of a part [bytes] at which the recorder continues in the next part; used
            only with `next_part`. One part also receives the rows that arrive while the next part
            is being opened.
        flush_interval_s: Wall time between two flushes to the kernel [s].
        fsync_interval_s: Wall time between two calls of fsync [s].
        backlog_limit_s: Maximum delay of writing behind reading, in seconds of data at nominal
            rates.
        on_backlog: Reaction if the delay of writing exceeds its limit: `raise` an error, or `wait`
            for the disk. The value `wait` is allowed only for robots with a virtual clock, which
            pause until their state is read.
    """

    def __init__(
        self,
        writer: McapWriter,
        *,
        next_part: NextPart | None = None,
        rotate_bytes: float | None = None,
        flush_interval_s: float = 0.1,
        fsync_interval_s: float = 0.1,
        backlog_limit_s: float = 10.0,
        on_backlog: Literal["raise", "wait"] = "raise",
    ) -> None:
        self._writer = writer
        self._topics = writer.topics
        self._rotate_bytes = rotate_bytes if next_part is not None else None
        self._flush_interval_s = flush_interval_s
        self._limit = max(1, int(backlog_limit_s * sum(t.rate_hz for t in writer.topics.values())))
        self._on_backlog = on_backlog
        self._blocks: deque[_Block] = deque()
        self._events: deque[Mapping[str, Any]] = deque()
        self._rows_put = self._rows_written = 0
        self._writing_since: float | None = None
        self._counts = {name: Counts() for name in writer.topics}
        self._error: BaseException | None = None
        self._closing = False
        self._wake, self._progress = threading.Event(), threading.Event()
        self._disk = DiskThread(writer, next_part, fsync_interval_s, self._fail)
        self._thread = threading.Thread(target=self._run, name="hil-recorder", daemon=True)
        self._thread.start()

    @property
    def backlog(self) -> int:
        """Number of rows that were passed to the recorder but are not written yet."""
        return self._rows_put - self._rows_written

    @property
    def behind_s(self) -> float:
        """Age of the oldest row that has not reached the kernel yet [s, wall time].

        A kill of the process would lose the rows that are younger than this age.
        """
        since = self._writing_since
        if since is None:
            try:
                since = self._blocks[0].since
            except IndexError:
                return 0.0
        return time.monotonic() - since

    @property
    def counts(self) -> Mapping[str, Counts]:
        """Numbers of samples, gaps, duplicates and overruns per topic, for all written rows."""
        return MappingProxyType(self._counts)

    def put(self, topic: str, rows: StructArray) -> None:
        """Copy rows of a topic into the queue of the recorder.

        The rows are stored whenever possible, even if this method raises an error.

        Raises:
            RecordingError: Writing has failed, or the delay of writing exceeds the limit.
        """
        require_rows_of(self._topics, topic, rows)
        if self._thread.is_alive() and not self._closing:
            # Copied as bytes, because copying a structured array field by field takes ten times as
            # long.
            self._blocks.append(_Block(topic, rows.tobytes(), time.monotonic()))
            self._rows_put += len(rows)
        self._require_alive()
        if self.backlog > self._limit // 2:
            self._wake.set()
        if self.backlog > self._limit:
            self._fallen_behind()

    def put_event(self, event: Mapping[str, Any]) -> None:
        """Queue an event (`t`, `kind` and any JSON data) for the topic `/events`.

        Raises:
            RecordingError: An earlier write to the recording has failed.
        """
        self._require_alive()
        self._events.append(event)

    def close(self, timeout_s: float = 60.0) -> Mapping[str, Counts]:
        """Write all queued rows, finish the file and return the final counts. Idempotent.

        Raises:
            RecordingError: Writing has failed or did not end in time; the flushed rows remain in
                the partial file.
        """
        deadline = time.monotonic() + timeout_s
        self._closing = True
        self._wake.set()
        self._thread.join(timeout_s)
        ended = self._disk.join(deadline - time.monotonic())
        if self._error is not None:
            raise self._as_recording_error()
        if self._thread.is_alive() or not ended:
            raise RecordingError(
                f"{self._writer.partial_path} could not be finished within {timeout_s:g} s",
                hint="the disk hangs or is too slow; the file contains all data flushed before",
            )
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
            # The error of the with block is the cause; raising here would hide it.
            if error is None:
                raise

    def _require_alive(self) -> None:
        if self._error is not None:
            raise self._as_recording_error()
        if self._closing:
            raise RecordingError(f"the recorder of {self._writer.path} is closed")
        if not self._thread.is_alive():
            raise RecordingError(f"the recorder of {self._writer.path} died")

    def _as_recording_error(self) -> RecordingError:
        if isinstance(self._error, RecordingError):
            return RecordingError(self._error.message, hint=self._error.hint)
        return RecordingError(f"the recorder of {self._writer.path} died: {self._error!r}")

    def _fail(self, error: BaseException) -> None:
        if self._error is None:
            self._error = error
        self._progress.set()

    def _fallen_behind(self) -> None:
        while self._on_backlog == "wait" and self.backlog > self._limit:
            self._progress.wait(self._flush_interval_s)
            self._progress.clear()
            self._require_alive()
        if self.backlog > self._limit:
            raise RecordingError(
                f"recording has fallen behind by {self.backlog} rows (limit {self._limit}); "
                "they are in memory, but the disk is too slow",
                hint="record to a faster disk or at a lower rate",
            )

    def _run(self) -> None:
        try:
            flushed = time.monotonic()
            while not self._closing:
                self._wake.wait(flushed + self._flush_interval_s - time.monotonic())
                self._wake.clear()
                flushed = time.monotonic()
                self._write_backlog()
                self._rotate()
            self._write_backlog()
            self._disk.finish()
        except BaseException as error:  # every exception must reach the control thread
            self._fail(error)
            self._disk.abandon()

    def _write_backlog(self) -> None:
        if not self._blocks and not self._events:
            return
        self._writing_since = self._blocks[0].since if self._blocks else None
        blocks = [self._blocks.popleft() for _ in range(len(self._blocks))]
        events = [self._events.popleft() for _ in range(len(self._events))]
        rows_written = self._rows_written
        for name in dict.fromkeys(block.topic for block in blocks):
            topic = self._topics[name]
            content = b"".join(block.content for block in blocks if block.topic == name)
            rows = np.frombuffer(content, topic.dtype)
            self._writer.write(name, rows)
            self._counts[name] = self._counts[name].after(rows, topic.rate_hz)
            rows_written += len(rows)
        for event in events:
            self._writer.write_event(event)
        self._writer.flush(durable=False)
        self._rows_written, self._writing_since = rows_written, None
        self._disk.written()
        self._progress.set()

    def _rotate(self) -> None:
        """Continue in the next part if the current part is full and the next is open.

        The caller must flush all rows of the current part before.
        """
        if self._rotate_bytes is None or self._writer.size < self._rotate_bytes:
            return
        if new := self._disk.part_after(self._writer):
            self._writer = new


class _Block(NamedTuple):
    """Rows that wait to be written, with their time of queueing [s, monotonic clock]."""

    topic: str
    content: bytes
    since: float


class DiskThread:
    """Thread that syncs the open part of a recording to disk and opens the next part.

    Args:
        writer: Writer of the open part.
        next_part: Callback that opens the next part; None if the recording has only one part.
        fsync_interval_s: Wall time between two calls of fsync [s].
        failed: Callback that receives an exception of the disk thread; the disk thread ends after
            an exception.
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
        # None → "wanted" → a part → None: the recorder thread requests and takes a part, the disk
        # thread opens it. Each transition has exactly one owner, so that no part is opened unused.
        self._next: Literal["wanted"] | McapWriter | None = None
        self._full: deque[McapWriter] = deque()
        self._ending: Callable[[], None] | None = None
        self._wake = threading.Event()
        self._last_sync = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="hil-disk", daemon=True)
        self._thread.start()

    def written(self) -> None:
        """Record that the open part contains data that are not synced to disk yet."""
        self._unsynced = True

    def part_after(self, writer: McapWriter) -> McapWriter | None:
        """Return the next part if it is open; otherwise request that it is opened, return None.

        The caller repeats the call until the next part is returned. When the next part is returned,
        the disk thread finishes `writer` later. The caller must flush `writer` before the call.
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
        """Finish all parts of the recording and stop the thread; later rows cannot be written."""
        self._end(self._finish_all)

    def abandon(self) -> None:
        """Close all parts of the recording without finishing them and stop the thread."""
        self._end(self._abandon_all)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end of the thread; return whether it ended before the timeout."""
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
                if self._next == "wanted" and self._next_part is not None:
                    self._part += 1
                    self._next = self._next_part(self._part)
                now = time.monotonic()
                if self._unsynced and now - self._last_sync >= self._interval_s:
                    self._last_sync, self._unsynced = now, False
                    self._writer.sync()
            self._ending()
        except BaseException as error:  # every exception must reach the control thread
            self._failed(error)
            # The recorder thread continues to write to the open part until the recorder is closed.
            while self._ending is None:
                self._wake.wait(_LONGEST_WAIT_S)
                self._wake.clear()
            self._abandon_all()

    def _finish_full(self) -> None:
        while self._full:
            self._full[0].finish()
            self._full.popleft()

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
