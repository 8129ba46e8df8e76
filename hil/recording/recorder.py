"""The recorder thread: the control thread hands over blocks and never touches a disk.

Two threads, because a disk may take half a second for one fsync. The recorder thread only writes
into the kernel, which is what a kill cannot undo; everything that has to wait for the disk is done
by the disk thread beside it: fsync, opening the next part, finishing the last one.

Durability. Every `flush_interval_s` (0.1 s) of wall time the recorder thread writes what has come
in into the kernel, so that killing the process loses at most that much plus one write, however slow
the disk is. The disk thread calls `fsync` every `fsync_interval_s`, so that a power loss loses at
most that much plus the time the disk takes; set it higher on slow media, or to infinity where only
kills are feared.

Rotation. A part that has reached `rotate_bytes` is followed by the next one, which is open by
then; the old one is finished beside. No row is in both or in neither, and the counts go on.

Continuity. Gaps, duplicates and overruns are counted while recording, by the device clock.
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
"""Opens a part of the recording by its number: 1 is the one after the first."""

_GAP_PERIODS = 1.5
_DUPLICATE_PERIODS = 0.1
_LONGEST_WAIT_S = 1.0


@dataclass(frozen=True, slots=True)
class Counts:
    """Continuity of one topic's samples, with T = 1/rate.

    Attributes:
        samples: Rows recorded.
        gaps: Device time advanced by more than 1.5 T: at least one sample is missing.
        missing: Samples that the gaps swallowed, rounded.
        duplicates: Device time advanced by less than 0.1 T, stood still or went back.
        overruns: Nothing is missing, but the host received the sample more than 1.5 T after
            the one before: the loop that reads could not keep up.
        first_time: Device time of the first sample [s], NaN before it.
        last_time: Device time of the last sample [s].
        last_host_time: Host time of the last sample [s].
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
        """Return the counts after `rows` (any record with `device_time`, `host_time`)."""
        if not len(rows):
            return self
        device, host = rows["device_time"], rows["host_time"]
        # Before the very first sample the time is NaN, which no comparison counts.
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
    """Records blocks of rows through a thread of its own; nothing is ever dropped.

    `put` is called by one thread, the control thread; everything else but `close` by any.

    Args:
        writer: The open file; the recorder finishes it, or abandons it when writing fails.
        next_part: Opens part 1, 2, … with the same topics when rotating; called off the control
            thread.
        rotate_bytes: Go on in the next part once the open one has this size [bytes]; only with
            `next_part`. A part gets bigger by what comes in while the next one is opened.
        flush_interval_s: Wall time between flushes [s].
        fsync_interval_s: Wall time between calls of fsync [s].
        backlog_limit_s: How far writing may fall behind, in seconds of data at nominal rates.
        on_backlog: `raise` beyond the limit, or `wait` for the disk: right for virtual clocks
            only, where the robot stands still until its state is read.
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
        """Rows handed over but not written yet."""
        return self._rows_put - self._rows_written

    @property
    def behind_s(self) -> float:
        """Time that the oldest row not yet in the kernel has been waiting [s, wall time].

        That is what a kill would lose now.
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
        """Samples, gaps, duplicates and overruns per topic, up to what has been written."""
        return MappingProxyType(self._counts)

    def put(self, topic: str, rows: StructArray) -> None:
        """Hand over rows of a topic; they are copied, and kept if at all possible when this raises.

        Raises:
            RecordingError: Writing has failed, or has fallen behind by more than the limit.
        """
        require_rows_of(self._topics, topic, rows)
        if self._thread.is_alive() and not self._closing:
            # As bytes: copying a structured array goes field by field and takes ten times as long.
            self._blocks.append(_Block(topic, rows.tobytes(), time.monotonic()))
            self._rows_put += len(rows)
        self._require_alive()
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
        """Write everything out and finish the file. Idempotent; return the final counts.

        Raises:
            RecordingError: Writing has failed or did not end in time; what was flushed is kept
                in the partial file.
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
                hint="the disk hangs or is far too slow; what was flushed is kept in that file",
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
            # The first error is the one that explains; this one would hide it.
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
                "they are kept, but the disk does not keep up",
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
        except BaseException as error:  # whatever it was, the control thread has to hear of it
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
        """Go on in the next part if this one is full and that one is open. All is flushed here."""
        if self._rotate_bytes is None or self._writer.size < self._rotate_bytes:
            return
        if new := self._disk.part_after(self._writer):
            self._writer = new


class _Block(NamedTuple):
    """Rows that wait to be written, and when they were handed over [s, monotonic clock]."""

    topic: str
    content: bytes
    since: float


class DiskThread:
    """Keeps the open part durable and has the next one ready; owned by the recorder thread.

    Args:
        writer: The open part.
        next_part: Opens the part that follows, None where there is none.
        fsync_interval_s: Wall time between calls of fsync [s].
        failed: Called with what went wrong, in this thread; nothing more is done after it.
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
        """Note that the open part holds something that the disk does not have yet."""
        self._unsynced = True

    def part_after(self, writer: McapWriter) -> McapWriter | None:
        """Return the next part once it is open, else None: it is being opened then; ask again.

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
        """Have all parts finished, then end; nothing more may be written."""
        self._end(self._finish_all)

    def abandon(self) -> None:
        """Have all parts closed as they are, then end."""
        self._end(self._abandon_all)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end; return whether it came in time."""
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
        except BaseException as error:  # whatever it was, the control thread has to hear of it
            self._failed(error)
            # The recorder thread goes on writing to the open part until it closes.
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
