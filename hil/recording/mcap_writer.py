"""Writes one MCAP file; single-threaded but for `sync`, used by the recorder and by importers.

The file is called `NN.mcap.partial` until it is finished, and is locked until then, so that
it is not taken for one that a kill has left. What explains the data (metadata, attachments, message
definitions) is written first and before the file gets even that name, so that whatever bears it
says what it is. Chunks are 1 MiB, zstd.

`McapWriter` knows files, topics and rows; `McapStream` below it knows the records of the format and
writes them in blocks. `mcap.writer.Writer` takes messages one by one (10 µs each) and keeps an
object per chunk until the end; at ten chunks a second its index of a 1 GB recording takes 0.4 s to
write, during which a control thread gets the interpreter 6 ms late. Here a block of messages is one
numpy operation and the index lies ready in bytes (decision 0012). What is written once is left to
`mcap.records`.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment as AttachmentRecord
from mcap.records import (
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hil.core import IntArray, RecordingError, StructArray, fsync_directory, utf8_text
from hil.recording.mcap_records import (
    CHECKSUM_BYTES,
    INDEX_HEADER,
    MAGIC,
    MESSAGE_FIELDS,
    RECORD_HEADER,
)
from hil.recording.recording_files import PARTIAL_SUFFIX
from hil.recording.viewer_messages import (
    EVENT_SCHEMA,
    EVENT_TEXT,
    EVENT_TOPIC,
    JOINT_STATE_SCHEMA,
    JOINT_STATE_TEXT,
    JOINT_STATE_TOPIC,
    JointStateView,
    encode_event,
)
from hil.robot import CDR_HEADER, STATE_TOPIC, Topic

FILE_FORMAT_VERSION = 1
"""Version of what is around the topics: metadata, attachments, clocks. See decision 0002."""

FILE_METADATA = "hil"
"""Metadata record that says what wrote the file."""

RECOVERED_METADATA = "recovered"
"""Metadata record in which a rebuilt file says what it was rebuilt from."""

CHUNK_BYTES = 1 << 20
"""Size of a chunk before compression."""

_UINT32 = 0xFFFFFFFF
_COMPRESSION = struct.pack("<I", 4) + b"zstd"
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEX_OFFSET = struct.Struct("<HQ")


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
        for taken in (self.path, self.partial_path):
            if taken.exists():
                raise RecordingError(
                    f"{taken} exists already, and a recording is never appended to or replaced",
                    hint="record under the next number",
                )
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
        """Path of the data until the file is finished."""
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
        """Close and delete the file, in which nothing of value was written. Errors are ignored."""
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
        """Write metadata and attachments, and announce all topics."""
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
            state = self.topics[STATE_TOPIC]
            self._joint_states = JointStateView(joint_names, state.rate_hz)
            every, unit = str(self._joint_states.every), state.units.get("effort", "")
            self._channels[JOINT_STATE_TOPIC] = stream.register(
                JOINT_STATE_TOPIC,
                JOINT_STATE_SCHEMA,
                JOINT_STATE_TEXT,
                {"decimation": every, "unit.effort": unit},
            )

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
    """Return times as MCAP stores them: whole nanoseconds, not negative; 0 where unknown."""
    # fmax and fmin take the number where the other one is NaN.
    whole = np.fmin(np.fmax(seconds, 0.0), 9.2e9) * 1e9
    return whole.astype(np.int64)


# The records of the file.


class McapStream:
    """Writes MCAP records to a binary file that has no other writer.

    Args:
        file: Open for writing, empty.
        profile: What the messages keep to, such as `ros2`.
        library: Name of the writing software.
    """

    def __init__(self, file: IO[bytes], profile: str, library: str) -> None:
        self._file = file
        self.size = 0
        self._zstd = zstandard.ZstdCompressor()
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        self._chunks = 0
        self._chunk_index = bytearray()
        self._first_ns, self._last_ns = np.iinfo(np.int64).max, 0
        self._content: list[bytes] = []
        self._length = 0
        self._entries: list[_Entries] = []
        self._write(MAGIC)
        self._write(_bytes_of(Header(profile, library)))

    def add_metadata(self, name: str, record: Mapping[str, str]) -> None:
        """Write a named record of text → text."""
        self.end_chunk()
        texts = {utf8_text(key): utf8_text(value) for key, value in record.items()}
        content = _bytes_of(Metadata(name=name, metadata=texts))
        self._metadata.append(MetadataIndex(offset=self.size, length=len(content), name=name))
        self._write(content)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write a file to be carried along."""
        self.end_chunk()
        content = _bytes_of(AttachmentRecord(0, 0, name, media_type, data))
        self._attachments.append(
            AttachmentIndex(self.size, len(content), 0, 0, len(data), name, media_type)
        )
        self._write(content)

    def register(
        self, topic: str, schema: str, definition: str, metadata: Mapping[str, str]
    ) -> int:
        """Announce a topic of CDR messages; returns its channel.

        Announced outside chunks, so that a file without a single message says what it would
        hold, and again in the first chunk, which is where checksums protect it.
        """
        number = len(self._channels) + 1
        self._schemas[number] = Schema(number, definition.encode(), "ros2msg", schema)
        self._channels[number] = Channel(number, topic, "cdr", dict(metadata), number)
        announced = _bytes_of(self._schemas[number], self._channels[number])
        self._write(announced)
        self._put(announced)
        return number

    def add_messages(
        self, channel: int, log_ns: IntArray, publish_ns: IntArray, messages: StructArray
    ) -> None:
        """Append N messages of one size.

        Args:
            channel: As returned by `register`.
            log_ns: (N,) log times [ns], not negative.
            publish_ns: (N,) publish times [ns], not negative.
            messages: (N,) the messages, packed, encapsulation header included.
        """
        size = messages.dtype.itemsize
        records = np.empty(len(messages), [*MESSAGE_FIELDS, ("message", f"V{size}")])
        records["opcode"] = Opcode.MESSAGE
        records["length"] = records.itemsize - RECORD_HEADER.size
        records["channel"] = channel
        records["sequence"] = (self._counts[channel] + np.arange(len(records))) & _UINT32
        records["log_time"], records["publish_time"] = log_ns, publish_ns
        records["message"] = messages.view(f"V{size}")
        most = max(1, CHUNK_BYTES // records.itemsize)
        for begin in range(0, len(records), most):
            self._add(channel, log_ns[begin : begin + most], records[begin : begin + most])

    def end_chunk(self) -> None:
        """Compress and write what has been added since the last chunk, with its index."""
        if not self._entries:
            return
        content = b"".join(self._content)
        times = np.concatenate([entries[:, 0] for _, entries in self._entries])
        first, last = int(times.min()), int(times.max())
        data = self._zstd.compress(content)
        start = self.size
        self._write_record(
            Opcode.CHUNK,
            _CHUNK.pack(first, last, len(content), zlib.crc32(content))
            + _COMPRESSION
            + struct.pack("<Q", len(data)),
            data,
        )
        length, indexes = self.size - start, self._write_message_indexes()
        index = _CHUNK_INDEX.pack(first, last, start, length, len(indexes))
        index += indexes + struct.pack("<Q", self.size - start - length)
        index += _COMPRESSION + struct.pack("<QQ", len(data), len(content))
        self._chunk_index += RECORD_HEADER.pack(Opcode.CHUNK_INDEX, len(index)) + index
        self._chunks += 1
        self._first_ns, self._last_ns = min(self._first_ns, first), max(self._last_ns, last)
        self._content, self._length, self._entries = [], 0, []

    def finish(self) -> None:
        """Write what the file ends with: summary, footer, magic. The file stays open."""
        self.end_chunk()
        self._write(_bytes_of(DataEnd(0)))
        start = self.size
        groups = [
            (Opcode.SCHEMA, _bytes_of(*self._schemas.values())),
            (Opcode.CHANNEL, _bytes_of(*self._channels.values())),
            (Opcode.STATISTICS, _bytes_of(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_index)),
            (Opcode.ATTACHMENT_INDEX, _bytes_of(*self._attachments)),
            (Opcode.METADATA_INDEX, _bytes_of(*self._metadata)),
        ]
        crc, offsets = 0, b""
        for opcode, content in groups:
            if content:
                offsets += _bytes_of(SummaryOffset(opcode, self.size, len(content)))
                crc = zlib.crc32(content, crc)
                self._write(content)
        offsets_start = self.size
        self._write(offsets)
        footer = _bytes_of(Footer(start, offsets_start, 0))
        crc = zlib.crc32(footer[:-CHECKSUM_BYTES], zlib.crc32(offsets, crc))
        self._write(footer[:-CHECKSUM_BYTES] + struct.pack("<I", crc) + MAGIC)

    def _add(self, channel: int, log_ns: IntArray, records: StructArray) -> None:
        if self._length + records.nbytes > CHUNK_BYTES:
            self.end_chunk()
        offsets = self._length + records.itemsize * np.arange(len(records))
        self._entries.append(_Entries(channel, np.stack([log_ns, offsets], axis=1)))
        self._counts[channel] += len(records)
        self._put(records.tobytes())

    def _put(self, content: bytes) -> None:
        self._content.append(content)
        self._length += len(content)

    def _write_message_indexes(self) -> bytes:
        """Write the index of every channel in the chunk; return the map channel → its place."""
        places = b""
        for channel in dict.fromkeys(channel for channel, _ in self._entries):
            found = [entries for of_channel, entries in self._entries if of_channel == channel]
            entries = np.concatenate(found).astype("<u8").tobytes()
            places += _INDEX_OFFSET.pack(channel, self.size)
            self._write_record(
                Opcode.MESSAGE_INDEX, INDEX_HEADER.pack(channel, len(entries)), entries
            )
        return places

    def _write_record(self, opcode: Opcode, head: bytes, rest: bytes) -> None:
        self._write(RECORD_HEADER.pack(opcode, len(head) + len(rest)) + head)
        self._write(rest)

    def _write(self, content: bytes) -> None:
        self._file.write(content)
        self.size += len(content)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunks,
            message_count=sum(self._counts.values()),
            message_start_time=int(self._first_ns) if self._chunks else 0,
            message_end_time=int(self._last_ns),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


class _Entries(NamedTuple):
    """Where messages of a channel are in the chunk: (N, 2) log time [ns] and offset."""

    channel: int
    entries: IntArray


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]
    return content
