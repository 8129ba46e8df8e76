"""Writes one MCAP file; single-threaded but for `sync`, used by the recorder and by importers.

The file is called `NN.mcap.partial` until it is finished, and is locked until then, so that
nobody takes it for one that a kill has left. What explains the data (metadata,
attachments, message definitions) is written first and before the file gets even that name, so
that whatever bears it says what it is. Chunks are 1 MiB, zstd.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple

import numpy as np

from hil.core import IntArray, RecordingError, StructArray, fsync_directory
from hil.recording.log_message import EVENT_SCHEMA, EVENT_TEXT, EVENT_TOPIC, encode_event
from hil.recording.recording_files import PARTIAL_SUFFIX
from hil.recording.stream import McapStream
from hil.recording.viewer_messages import (
    JOINT_STATE_SCHEMA,
    JOINT_STATE_TEXT,
    JOINT_STATE_TOPIC,
    JointStateView,
)
from hil.robot import CDR_HEADER, STATE_TOPIC, Topic

FILE_FORMAT_VERSION = 1
"""Version of what is around the topics: metadata, attachments, clocks. See decision 0002."""

FILE_METADATA = "hil"


class Attachment(NamedTuple):
    """A file carried inside the recording: the spec, the plan, a calibration, a URDF."""

    name: str
    media_type: str
    data: bytes


class McapWriter:
    """One MCAP file with fixed-size records, JointStates for viewers and events.

    A message's log time is the record's `host_time` (Unix), its publish time `device_time`; both
    stand in the record itself as well, unrounded. Where the host time is NaN, the device time
    is used for both.

    Args:
        path: Final path; the file is `path` + `.partial` until `finish`.
        topics: The topics to be written.
        metadata: Named records of text → text, written first.
        attachments: Files to carry along, written next.
        joint_names: When given, state rows also appear as JointStates under `/joint_states`.

    Raises:
        RecordingError: The file exists, finished or partial, or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        topics: Sequence[Topic],
        *,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Sequence[Attachment] = (),
        joint_names: Sequence[str] = (),
    ) -> None:
        self.path = Path(path)
        self.topics = {topic.name: topic for topic in topics}
        _require_free(self.path, self.partial_path)
        draft = self.path.with_name(f".{self.path.name}.{os.getpid()}.draft")
        with self._refusal_named():
            self._file: IO[bytes] = draft.open("xb")
        _lock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            with self._refusal_named():
                self._stream = McapStream(self._file, "ros2", "hil")
                self._explain(metadata or {}, attachments, joint_names)
                self.flush(durable=True)
                draft.rename(self.partial_path)
                fsync_directory(self.path.parent)
        except BaseException:
            self.abandon()
            draft.unlink(missing_ok=True)
            raise

    @property
    def partial_path(self) -> Path:
        """Where the data is until the file is finished."""
        return self.path.with_name(self.path.name + PARTIAL_SUFFIX)

    @property
    def size(self) -> int:
        """Bytes written so far, without the chunk in progress."""
        return self._stream.size

    def write(self, topic: str, rows: StructArray) -> None:
        """Append rows of a topic, in the order given.

        Raises:
            RecordingError: The file has no such topic, the rows are of another dtype, or the
                disk refuses.
        """
        require_rows_of(self.topics, topic, rows)
        with self._refusal_named():
            self._append(topic, rows, _with_cdr_header(rows))
            if topic == STATE_TOPIC and self._joint_states is not None:
                shown = self._joint_states.select(rows)
                self._append(JOINT_STATE_TOPIC, shown, self._joint_states.encode(shown))

    def write_event(self, event: Mapping[str, Any]) -> None:
        """Append an event; `t` is its Unix time [s] and `kind` what happened."""
        stamp = _nanoseconds(np.array([float(event["t"])]))
        content = encode_event(event)
        message = np.frombuffer(content, f"V{len(content)}")
        with self._refusal_named():
            self._stream.add_messages(self._channels[EVENT_TOPIC], stamp, stamp, message)

    def flush(self, *, durable: bool) -> None:
        """Hand everything to the kernel (survives a kill), or to the disk (survives power loss)."""
        with self._refusal_named():
            self._stream.end_chunk()
            self._file.flush()
        if durable:
            self.sync()

    def sync(self) -> None:
        """Wait until the disk has all that was flushed; may be called by a thread of its own.

        Raises:
            RecordingError: The disk refuses.
        """
        with self._refusal_named():
            os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the index, make the file durable and give it its final name."""
        with self._refusal_named():
            self._stream.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self.partial_path.rename(self.path)
            _lock(self._file, fcntl.LOCK_UN)  # not before it has its name
            self._file.close()
            fsync_directory(self.path.parent)

    def abandon(self) -> None:
        """Close without finishing; what was flushed stays readable in the partial file."""
        # A full disk refuses the buffered rest once more on close; it is lost either way.
        with contextlib.suppress(OSError, ValueError):
            _lock(self._file, fcntl.LOCK_UN)
            self._file.close()

    def discard(self) -> None:
        """Close and delete the file, in which nothing of worth was written. Errors are ignored."""
        self.abandon()
        with contextlib.suppress(OSError):
            self.partial_path.unlink()

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.finish()
        else:
            self.abandon()

    @contextlib.contextmanager
    def _refusal_named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(
                f"cannot write {self.partial_path}: {error.strerror or error}",
                hint="mend or free the disk; all that was flushed before is kept in that file",
            ) from error

    def _explain(
        self,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment],
        joint_names: Sequence[str],
    ) -> None:
        stream = self._stream
        version = {"format_version": str(FILE_FORMAT_VERSION)}
        own = {FILE_METADATA: version | dict(metadata.get(FILE_METADATA, {}))}
        for name, record in (own | {k: v for k, v in metadata.items() if k not in own}).items():
            stream.add_metadata(name, record)
        for item in attachments:
            stream.add_attachment(*item)
        self._channels = {
            topic.name: stream.register(
                topic.name, topic.schema_name, topic.schema_text, topic.channel_metadata
            )
            for topic in self.topics.values()
        }
        self._channels[EVENT_TOPIC] = stream.register(EVENT_TOPIC, EVENT_SCHEMA, EVENT_TEXT, {})
        self._joint_states: JointStateView | None = None
        if joint_names and STATE_TOPIC in self.topics:
            self._joint_states = self._register_joint_states(joint_names)

    def _register_joint_states(self, joint_names: Sequence[str]) -> JointStateView:
        topic = self.topics[STATE_TOPIC]
        view = JointStateView(joint_names, topic.rate_hz)
        self._channels[JOINT_STATE_TOPIC] = self._stream.register(
            JOINT_STATE_TOPIC,
            JOINT_STATE_SCHEMA,
            JOINT_STATE_TEXT,
            {"decimation": str(view.every), "unit.effort": topic.units.get("effort", "")},
        )
        return view

    def _append(self, topic: str, rows: StructArray, messages: StructArray) -> None:
        if not len(rows):
            return
        host, device = rows["host_time"], rows["device_time"]
        log_ns = _nanoseconds(np.where(np.isnan(host), device, host))
        self._stream.add_messages(self._channels[topic], log_ns, _nanoseconds(device), messages)


def require_rows_of(topics: Mapping[str, Topic], name: str, rows: StructArray) -> None:
    """Refuse rows that are not of the topic's dtype.

    Raises:
        RecordingError: There is no such topic, or the dtype differs.
    """
    topic = topics.get(name)
    if topic is None:
        raise RecordingError(
            f"the recording has no topic {name}", hint=f"it has {', '.join(topics)}"
        )
    if rows.dtype != topic.dtype:
        raise RecordingError(f"rows of {name} are {rows.dtype}, not {topic.dtype}")


def _require_free(*paths: Path) -> None:
    for taken in paths:
        if taken.exists():
            raise RecordingError(
                f"{taken} exists already, and a recording is never appended to or replaced",
                hint="record under the next number",
            )


def _lock(file: IO[bytes], how: int) -> None:
    """Lock or unlock it; unlocking frees it of forked children as well, closing would not."""
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(file.fileno(), how)


def _with_cdr_header(rows: StructArray) -> StructArray:
    size = rows.dtype.itemsize
    messages = np.empty(len(rows), [("cdr", f"V{len(CDR_HEADER)}"), ("row", f"V{size}")])
    messages["cdr"] = np.void(CDR_HEADER)
    messages["row"] = np.ascontiguousarray(rows).view(f"V{size}")
    return messages


def _nanoseconds(seconds: StructArray) -> IntArray:
    """Times as MCAP stores them: whole nanoseconds, not negative; 0 where unknown."""
    # fmax and fmin take the number where the other one is NaN.
    whole = np.fmin(np.fmax(seconds, 0.0), 9.2e9) * 1e9
    return whole.astype(np.int64)
