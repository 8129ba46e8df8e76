"""The event log of a run: state changes, checkpoints, prompts, trips; one JSON object a line.

Lines are written and fsynced as they come by a thread of the log's own, so `append` costs the
control thread no file work, and the death of the recorder can still be logged.
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
    """Appends events to a `.jsonl` file, in the order of the calls, from any thread.

    Args:
        path: The file; created when missing, continued after a crash.

    Raises:
        RecordingError: The file cannot be opened for appending.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
            size = os.fstat(self._descriptor).st_size
            if size and os.pread(self._descriptor, 1, size - 1) != b"\n":
                os.write(self._descriptor, b"\n")  # ends a line that a crash has torn
            fsync_directory(self.path.parent)
        except OSError as error:
            raise RecordingError(
                f"cannot open {path}: {error.strerror or error}",
                hint="see whether the folder may be written to and the disk has room",
            ) from error
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._error: OSError | None = None
        self._closed = self._ended = False
        self._thread = threading.Thread(target=self._run, name="hil-events", daemon=True)
        self._thread.start()

    def append(self, kind: str, /, **data: Any) -> Mapping[str, Any]:
        """Log that something happened; return the event, for `Recorder.put_event` and observers.

        Args:
            kind: What happened, such as `state`, `checkpoint`, `trip`.
            **data: Anything JSON can hold; arrays and paths are converted.

        Raises:
            RecordingError: An earlier line could not be written, or the log is closed.
        """
        now = time.time()
        stamp = datetime.fromtimestamp(now, UTC).isoformat(timespec="milliseconds")
        event = {"t": now, "time": stamp, "kind": kind, **data}
        if self._error is not None or self._closed:
            raise self._refusal()
        self._lines.put(json_line(event))
        return event

    def close(self, timeout_s: float = 10.0) -> None:
        """Wait until every line is on the disk. Idempotent.

        Raises:
            RecordingError: A line could not be written, or the disk took longer than that.
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
                hint="mend or free the disk",
            )
        return RecordingError(f"the event log {self.path} is closed")

    def _waiting(self) -> list[bytes]:
        """Return every line there is, at least one; none at the end. They share one fsync."""
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
    """Return the events of a log, in order, without lines that a crash or an edit spoilt.

    Raises:
        DataError: The file cannot be read.
    """
    return [event for event in map(_event_of, _lines_of(path)) if event is not None]


def foreign_lines(path: Path) -> int:
    """Return how many lines of a log are no events, and not what a crash leaves of one either.

    Raises:
        DataError: The file cannot be read.
    """
    spoilt = (line for line in _lines_of(path) if line.strip() and _event_of(line) is None)
    # A torn event begins as every event does, and has no end.
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
            hint="see whether it exists and may be read",
        ) from error


def _event_of(line: bytes) -> dict[str, Any] | None:
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return event if isinstance(event, dict) and "kind" in event else None
