"""Event log of a run: state changes, checkpoints, prompts, trips; one JSON object per line.

A separate thread writes the lines and syncs the file, so that `append` causes no file access in the
control thread. Because the event log is separate from the recorder, a failure of the recorder can
still be logged.
"""

from __future__ import annotations

import json
import os
import queue
import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

from hil.core import DataError, RecordingError, fsync_directory, json_line

_CLOSE = None
_BEGINNING = b'{"t": '


class EventLog:
    """Event log that appends events to a `.jsonl` file, in call order and from any thread.

    Args:
        path: Path of the log file; a missing file is created, and an existing file is continued
            after a crash.

    Raises:
        RecordingError: The log file cannot be opened for appending.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            size = os.fstat(self._descriptor).st_size
            if size and os.pread(self._descriptor, 1, size - 1) != b"\n":
                os.write(self._descriptor, b"\n")  # terminates a line that a crash has torn
            fsync_directory(self.path.parent)
        except OSError as error:
            raise RecordingError(
                f"cannot open {path}: {error.strerror or error}",
                hint="check that the folder is writable and that the disk has free space",
            ) from error
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._error: OSError | None = None
        self._closed = self._ended = False
        self._thread = threading.Thread(target=self._run, name="hil-events", daemon=True)
        self._thread.start()

    def append(self, kind: str, /, **data: Any) -> Mapping[str, Any]:
        """Log an event and return it for `Recorder.put_event` and observers.

        Args:
            kind: Kind of the event, such as `state`, `checkpoint`, `trip`.
            **data: Any JSON data; arrays and paths are converted.

        Raises:
            RecordingError: An earlier event could not be written, or the log is closed.
        """
        now = time.time()
        stamp = datetime.fromtimestamp(now, UTC).isoformat(timespec="milliseconds")
        event = {"t": now, "time": stamp, "kind": kind, **data}
        if self._error is not None or self._closed:
            raise self._refusal()
        self._lines.put(json_line(event))
        return event

    def close(self, timeout_s: float = 10.0) -> None:
        """Wait until every logged event is on the disk.

        Idempotent.

        Raises:
            RecordingError: An event could not be written, or the disk needed more than `timeout_s`.
        """
        if not self._closed:
            self._closed = True
            self._lines.put(_CLOSE)
        self._thread.join(timeout_s)
        if self._error is not None or self._thread.is_alive():
            raise self._refusal()

    def __enter__(self) -> EventLog:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _refusal(self) -> RecordingError:
        if self._error is not None:
            return RecordingError(
                f"cannot write {self.path}: {self._error.strerror or self._error}",
                hint="free space on the disk, or repair it",
            )
        return RecordingError(f"the event log {self.path} is closed")

    def _waiting(self) -> list[bytes]:
        """Return all queued lines, at least one, for a single fsync.

        The returned list is empty only after the log is closed.
        """
        lines: list[bytes] = []
        while not self._ended and (not lines or not self._lines.empty()):
            line = self._lines.get()
            if line is _CLOSE:
                self._ended = True
            else:
                lines.append(line.encode() + b"\n")
        return lines

    def _run(self) -> None:
        try:
            while lines := self._waiting():
                content = b"".join(lines)
                while content:
                    content = content[os.write(self._descriptor, content) :]
                os.fsync(self._descriptor)
        except OSError as error:
            self._error = error
        finally:
            os.close(self._descriptor)


def read_events(path: Path) -> list[dict[str, Any]]:
    """Return the events of a log in order, without lines damaged by a crash or an edit.

    Raises:
        DataError: The log file cannot be read.
    """
    return [event for event in map(_event_of, _lines_of(path)) if event is not None]


def foreign_lines(path: Path) -> int:
    """Return the number of damaged lines of a log, without lines torn by a crash.

    Raises:
        DataError: The log file cannot be read.
    """
    spoilt = (line for line in _lines_of(path) if line.strip() and _event_of(line) is None)
    # A torn event has the common beginning of all events and no closing brace.
    return sum(
        line[: len(_BEGINNING)] != _BEGINNING[: len(line)] or line.endswith(b"}") for line in spoilt
    )


def _lines_of(path: Path) -> list[bytes]:
    try:
        return Path(path).read_bytes().split(b"\n")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="check that the file exists and is readable",
        ) from error


def _event_of(line: bytes) -> dict[str, Any] | None:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) and "kind" in event else None
