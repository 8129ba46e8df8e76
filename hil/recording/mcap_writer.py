"""Writer of one MCAP file, used by the recorder and by importers; single-threaded except `sync`.

Until an MCAP file is finished, its name is `NN.mcap.partial` and the file is locked, so that the
file is not mistaken for the remains of a killed process. Metadata, attachments and message
definitions are written first, before the new file gets the name `NN.mcap.partial`. Every file named
`NN.mcap.partial` therefore describes its own content. A chunk has a size of 1 MiB before it is
compressed with zstd.

`McapWriter` handles files, topics and rows; `McapStream` encodes the MCAP records and writes them
in blocks. The class `mcap.writer.Writer` of the mcap package accepts single messages (10 µs each)
and keeps one object per chunk in memory until the end of the file. With `mcap.writer.Writer` and
ten chunks per second, writing the index of a 1 GB recording takes 0.4 s, and the control thread
gets the Python interpreter 6 ms late during this time. `McapStream` processes a block of messages
in one numpy operation and keeps the index as encoded bytes (decision 0012). Records that are
written only a single time per file are encoded by `mcap.records`.
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
"""Version of the hil file format: metadata, attachments and clocks. See decision 0002."""

FILE_METADATA = "hil"
"""Name of the metadata record that contains the version of the file format."""

RECOVERED_METADATA = "recovered"
"""Name of the metadata record in which a rebuilt file describes the torn file from which it was
rebuilt."""

CHUNK_BYTES = 1 << 20
"""Size of a chunk of messages before compression [bytes]."""

_UINT32 = 0xFFFFFFFF
_COMPRESSION = struct.pack("<I", 4) + b"zstd"
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEX_OFFSET = struct.Struct("<HQ")


class Attachment(NamedTuple):
    """File stored inside a recording, such as the spec, the plan, a calibration or a URDF."""

    name: str
    media_type: str
    data: bytes


class McapWriter:
    """Writer of one MCAP file with fixed-size rows, messages for viewers and events.

    The messages for viewers are JointState messages.

    The log time of a message is the `host_time` (Unix) of the row, the publish time is
    `device_time`. Each row also contains its host time and its device time, unrounded. If the host
    time of a row is NaN, the device time is used as log time and as publish time.

    Args:
        path: Final path of the file; the file name is `path` + `.partial` until `finish`.
        topics: Topics that can be written to the file.
        metadata: Metadata records (text → text) by name, written first.
        attachments: Files that are attached to the MCAP file after the metadata.
        joint_names: Names of the joints in the state rows; empty for a file without JointState
            messages. If joint names are set, state rows are also written as JointState messages to
            `/joint_states`.

    Raises:
        RecordingError: The file exists, finished or partial, or the file cannot be created.
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
                    hint="use the next number for the recording",
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
        """Path of the file before it gets its final name."""
        return self.path.with_name(self.path.name + PARTIAL_SUFFIX)

    @property
    def size(self) -> int:
        """Number of bytes written to the file so far, without the chunk in progress."""
        return self._stream.size

    def write(self, topic: str, rows: StructArray) -> None:
        """Append rows of a topic in the order of the array.

        Raises:
            RecordingError: The file has no such topic, the rows have a different dtype, or the rows
                could not be written.
        """
        require_rows_of(self.topics, topic, rows)
        with self._refusal_named():
            self._append(topic, rows, _with_cdr_header(rows))
            if topic == STATE_TOPIC and self._joint_states is not None:
                shown = self._joint_states.select(rows)
                self._append(JOINT_STATE_TOPIC, shown, self._joint_states.encode(shown))

    def write_event(self, event: Mapping[str, Any]) -> None:
        """Append an event; `t` is its Unix time [s] and `kind` its kind."""
        stamp = _nanoseconds(np.array([float(event["t"])]))
        content = encode_event(event)
        message = np.frombuffer(content, f"V{len(content)}")
        with self._refusal_named():
            self._stream.add_messages(self._channels[EVENT_TOPIC], stamp, stamp, message)

    def flush(self, *, durable: bool) -> None:
        """Write all data to the kernel; written data survive a kill of the process.

        If `durable` is true, the data are also synced to the disk, so that they survive a power
        loss.
        """
        with self._refusal_named():
            self._stream.end_chunk()
            self._file.flush()
        if durable:
            self.sync()

    def sync(self) -> None:
        """Wait until all flushed data are on the disk; any thread can call this method.

        Raises:
            RecordingError: The disk reported an error while data were synced.
        """
        with self._refusal_named():
            os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write the index, sync the file to the disk and rename the file to its final name."""
        with self._refusal_named():
            self._stream.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self.partial_path.rename(self.path)
            _lock(self._file, fcntl.LOCK_UN)  # only after the rename
            self._file.close()
            fsync_directory(self.path.parent)

    def abandon(self) -> None:
        """Close the file without finishing it; flushed data remain in the partial file."""
        # On a full disk, closing fails again for the buffered data, which are lost in any case.
        with contextlib.suppress(OSError, ValueError):
            _lock(self._file, fcntl.LOCK_UN)
            self._file.close()

    def discard(self) -> None:
        """Close and delete a file that contains no useful data.

        Errors are ignored.
        """
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
                hint="free space on the disk, or repair it; the file contains all flushed data",
            ) from error

    def _explain(
        self,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment],
        joint_names: Sequence[str],
    ) -> None:
        """Write metadata and attachments, and announce all topics of the file."""
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
    """Raise if the rows do not have the dtype of their topic.

    Raises:
        RecordingError: The file has no such topic, or the dtypes differ.
    """
    topic = topics.get(name)
    if topic is None:
        raise RecordingError(
            f"the recording has no topic {name}", hint=f"it has {', '.join(topics)}"
        )
    if rows.dtype != topic.dtype:
        raise RecordingError(f"rows of {name} are {rows.dtype}, not {topic.dtype}")


def _lock(file: IO[bytes], how: int) -> None:
    """Lock or unlock an open file with the system call `flock`.

    Explicit unlocking releases the lock also for forked child processes, which keep the file open;
    closing the file in this process would not release the lock.
    """
    with contextlib.suppress(OSError):  # the file system does not support locks
        fcntl.flock(file.fileno(), how)


def _with_cdr_header(rows: StructArray) -> StructArray:
    size = rows.dtype.itemsize
    messages = np.empty(len(rows), [("cdr", f"V{len(CDR_HEADER)}"), ("row", f"V{size}")])
    messages["cdr"] = np.void(CDR_HEADER)
    messages["row"] = np.ascontiguousarray(rows).view(f"V{size}")
    return messages


def _nanoseconds(seconds: StructArray) -> IntArray:
    """Return times in the form of MCAP: whole nanoseconds, not negative; 0 if unknown."""
    # fmax and fmin return the number if the other argument is NaN.
    whole = np.fmin(np.fmax(seconds, 0.0), 9.2e9) * 1e9
    return whole.astype(np.int64)


# Encoding of the records.


class McapStream:
    """Encoder that writes MCAP records to a binary file; the file has no other writer.

    Args:
        file: Empty binary file that is open for writing.
        profile: MCAP profile of the messages, such as `ros2`.
        library: Name of the writing software, stored in the header.
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
        """Write a named metadata record (text → text)."""
        self.end_chunk()
        texts = {utf8_text(key): utf8_text(value) for key, value in record.items()}
        content = _bytes_of(Metadata(name=name, metadata=texts))
        self._metadata.append(MetadataIndex(offset=self.size, length=len(content), name=name))
        self._write(content)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, a named file, to the MCAP file."""
        self.end_chunk()
        content = _bytes_of(AttachmentRecord(0, 0, name, media_type, data))
        self._attachments.append(
            AttachmentIndex(self.size, len(content), 0, 0, len(data), name, media_type)
        )
        self._write(content)

    def register(
        self, topic: str, schema: str, definition: str, metadata: Mapping[str, str]
    ) -> int:
        """Announce a topic of CDR messages and return its new channel id.

        The announcement is written outside chunks, so that a file without messages still lists its
        topics. The announcement is repeated in the first chunk, because checksums protect the
        content of chunks.
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
        """Append N messages of equal size to one channel.

        Args:
            channel: Channel id that `register` returned.
            log_ns: (N,) log times of the messages [ns], not negative.
            publish_ns: (N,) publish times of the messages [ns], not negative.
            messages: (N,) messages as packed rows of equal size, each with its encapsulation
                header.
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
        """Compress and write the messages added since the last chunk, followed by their index."""
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
        """Write the end of the file: summary, footer, magic bytes.

        The binary file itself stays open.
        """
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
        """Write the message index of every channel in the chunk.

        Return the encoded map from channel to index offset.
        """
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
    """Positions of the messages of a channel in the chunk: log time [ns] and offset, (N, 2)."""

    channel: int
    entries: IntArray


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]
    return content
