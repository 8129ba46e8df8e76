"""Reading of recordings into numpy arrays, chunk by chunk, without decoding single messages.

Only fixed-size CDR messages can be read: the messages of this package, and every other topic whose
ROS 2 definition contains neither strings nor sequences.

All messages of one topic are returned as one structured array. The message indexes of a chunk
contain the positions of its messages; one numpy operation copies all messages of a topic from the
bytes of the chunk. No checksum protects the message indexes: the header of every message is
therefore verified, and the number of rows is compared with the count in the summary of the file. If
a message index is missing or wrong, the reader walks through all records of the chunk instead.
Recordings that are flushed ten times per second have small chunks, so several chunks are joined
into a batch to reduce the number of numpy calls. If a batch of chunks contains an error, its chunks
are read one by one.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from hil.core import (
    BoolArray,
    DataError,
    FloatArray,
    IntArray,
    StructArray,
    require_known_version,
)
from hil.recording.mcap_records import (
    INDEX_ENTRY_BYTES,
    MESSAGE_FIELDS,
    RECORD_HEADER,
    Torn,
    parse,
    read_chunk,
    records_in,
    scan,
)
from hil.recording.mcap_writer import FILE_FORMAT_VERSION, FILE_METADATA, Attachment
from hil.recording.recording_files import attempt_of, hint_of_lost
from hil.robot import CDR_HEADER, STATE_SCHEMA_VERSION, STATE_TOPIC, dtype_of_schema

_BATCH_BYTES = 1 << 20
_MESSAGE_HEAD = np.dtype([*MESSAGE_FIELDS, ("cdr", "<u4")])
"""Number of bytes before the data of a fixed-size row: record header, message header and CDR
header."""

_LENGTH_BEFORE_ROW = _MESSAGE_HEAD.itemsize - RECORD_HEADER.size
_CDR = int.from_bytes(CDR_HEADER, "little")
_LOOSE = -1
"""Unit number that denotes all messages outside chunks."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """Properties of one topic of a recording: message count, dtype and metadata.

    Attributes:
        name: Topic name.
        messages: Number of messages of the topic that can be read.
        schema_name: Name of the ROS 2 message definition.
        dtype: Dtype of the rows that `read_topic` returns; None if the messages have no fixed size.
        metadata: Metadata of the topic as text: `schema_version`, `rate_hz`, `clock`,
            `unit.<field>`.
    """

    name: str
    messages: int
    schema_name: str
    dtype: np.dtype[Any] | None
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Overview of the content of a recording, determined without reading samples.

    Attributes:
        path: Path of the recording.
        complete: Whether the recording file is complete and undamaged. For incomplete or damaged
            files, the remaining attributes describe the readable part.
        tear: Position and kind of the damage as text; empty if the file is complete.
        chunks: Number of complete chunks in the file.
        topics: Map from topic name to the properties of the topic.
        metadata: Metadata records (text → text) by record name.
        attachments: Contents of the attached files by file name.
    """

    path: Path
    complete: bool
    tear: str
    chunks: int
    topics: Mapping[str, TopicInfo]
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Mapping[str, Attachment]


def read_topic(path: Path, topic: str = STATE_TOPIC, *, salvage: bool = False) -> StructArray:
    """Return all rows of a topic of a recording in the order of writing, bit for bit.

    Args:
        path: Path of an MCAP file.
        topic: Topic name.
        salvage: Whether to return the undamaged rows of a torn or damaged file instead of raising
            an error.

    Raises:
        DataError: The file is missing, not an MCAP file, torn, damaged, or from a newer version of
            hil; or the topic is missing or its messages have no fixed size.
    """
    with _opened(path) as recording:
        return _rows_of(recording, topic, salvage=salvage)


def read_info(path: Path) -> RecordingInfo:
    """Return the content of a recording; for a torn file, the content before the tear.

    Raises:
        DataError: The file is missing, not an MCAP file, or from a newer version of hil.
    """
    with _opened(path) as recording:
        layout = recording.layout
        names = sorted({channel.topic for channel in layout.channels.values()})
        return RecordingInfo(
            path=recording.path,
            complete=not recording.tear,
            tear=recording.tear,
            chunks=len(layout.chunks),
            topics={name: _topic_info(recording, name) for name in names},
            metadata=layout.metadata,
            attachments={
                item.name: Attachment(item.name, item.media_type, item.data)
                for item in layout.attachments
            },
        )


def recorded_s(recordings: Iterable[Path]) -> float:
    """Return the total device time of all attempts, from first to last sample [s].

    Only the first and the last samples of each attempt are read.

    Args:
        recordings: Paths of the files, as in `RunDirectory.recordings`; unreadable files count as 0
            s.
    """
    total = 0.0
    for _, files in groupby(recordings, attempt_of):
        spans = [span for file in files if (span := _span(file)) is not None]
        covered = spans[-1][1] - spans[0][0] if spans else 0.0
        total += covered if 0 < covered < np.inf else 0.0
    return total


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Recording]:
    try:
        with Path(path).open("rb") as file:
            yield _Recording(file, Path(path))
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="check that the file exists and is readable",
        ) from error
    except MemoryError:
        raise DataError(
            f"reading {path} requires more memory than is available",
            hint="the file is damaged: recover its messages with: hil recover FILE",
        ) from None


def _topic_info(recording: _Recording, topic: str) -> TopicInfo:
    channels = recording.channels_of(topic)
    first = channels[0]
    dtype = None
    with contextlib.suppress(DataError):
        dtype = recording.dtype_of(first)
    schema = recording.layout.schemas.get(first.schema_id)
    return TopicInfo(
        name=topic,
        messages=recording.count(channels),
        schema_name=schema.name if schema else "",
        dtype=dtype,
        metadata=first.metadata,
    )


def _span(path: Path) -> tuple[float, float] | None:
    """Return the device times of the first and last samples [s], or None without samples."""
    try:
        with path.open("rb") as file:
            recording = _Recording(file, path)
            ends = [
                _first_times(recording, units) for units in (recording.units, recording.units[::-1])
            ]
    except (DataError, OSError):
        return None
    first, last = ends
    return None if first is None or last is None else (float(first[0]), float(last[-1]))


def _first_times(recording: _Recording, units: Iterable[int]) -> FloatArray | None:
    """Return the device times in the first of these units that contains samples."""
    channels = recording.channels_of(STATE_TOPIC)
    dtype = recording.dtype_of(channels[0])
    if "device_time" not in (dtype.names or ()):  # topic of a different tool with the same name
        return None
    of_topic = _mask_of(channels)
    for unit in units:
        try:
            content = recording.content(unit)
            recording.distrust_index(unit)
            offsets = np.sort(recording.offsets(unit, of_topic))
            if len(offsets):
                rows = _rows_at(content, offsets, of_topic, dtype).view(dtype)
                times: FloatArray = rows["device_time"]
                return times
        except Torn:
            continue
    return None


# Reading of all messages of a topic as one array.


def _rows_of(recording: _Recording, topic: str, *, salvage: bool) -> StructArray:
    """Return all rows of a topic in file order; `salvage` skips torn and damaged parts.

    Raises:
        DataError: The topic is missing or has no fixed message size, or the file is torn or
            damaged.
    """
    if salvage and not recording.layout.complete:
        recording.distrust_indexes()  # and read the channel definitions in the chunks
    named = recording.channels_of(topic)
    # A channel without messages possibly has a damaged definition outside the chunks.
    channels = [channel for channel in named if recording.count([channel])] or named
    dtype = recording.dtype_of(channels[0])
    if any(recording.dtype_of(channel) != dtype for channel in channels):
        raise DataError(
            f"{recording.path}: the messages of {topic} have different types",
            hint="the recording is damaged, or contains several recordings",
        )
    if not salvage and recording.tear:
        raise DataError(
            f"{recording.path} is {recording.tear}; {len(recording.layout.chunks)} complete "
            f"chunks with {recording.count(channels)} messages of {topic} can be read",
            hint=_hint_of_damage(recording.path),
        )
    lift = _Lift(recording, _mask_of(channels), dtype, salvage)
    rows = _filled(recording.count(channels), dtype, lift.blocks())
    promised = recording.promised(channels)
    if promised is None or len(rows) == promised:
        return rows
    # Message indexes have no checksum: only the count reveals messages that a wrong index omits.
    if not salvage:
        raise DataError(
            f"{recording.path} is damaged: its summary counts {promised} messages of {topic}, "
            f"but its message indexes count {len(rows)}",
            hint=_hint_of_damage(recording.path),
        )
    recording.distrust_indexes()
    return _filled(recording.count(channels), dtype, lift.blocks())


def _filled(expected: int, dtype: np.dtype[Any], blocks: Iterator[StructArray]) -> StructArray:
    out, filled = np.empty(expected, dtype), 0
    for block in blocks:
        if (excess := filled + len(block) - len(out)) > 0:
            out = np.append(out, np.empty(excess, dtype))
        out[filled : filled + len(block)].view(block.dtype)[:] = block
        filled += len(block)
    return out[:filled]


def _hint_of_damage(path: Path) -> str:
    return (
        f"recover the undamaged messages with: hil recover {path}; "
        "or read them with read_topic(…, salvage=True)"
    )


@dataclass(frozen=True)
class _Lift:
    """Extraction of the rows of a topic from a recording, block by block.

    Attributes:
        recording: The open recording from which rows are read.
        of_topic: (65536,) mask that is true for the channel ids that belong to the topic.
        dtype: Dtype that the rows must have.
        salvage: Whether to skip damaged chunks instead of raising an error.
    """

    recording: _Recording
    of_topic: BoolArray
    dtype: np.dtype[Any]
    salvage: bool

    def blocks(self) -> Iterator[StructArray]:
        """Yield the rows of the topic for each batch of units."""
        batch: list[tuple[int, bytes, IntArray]] = []
        size = 0
        for unit in self.recording.units:
            try:
                data = self.recording.content(unit)
            except Torn as tear:
                self._skip_or_raise(unit, tear)
                continue
            batch.append((unit, data, self.recording.offsets(unit, self.of_topic)))
            size += len(data)
            if size > _BATCH_BYTES:
                yield from self._lifted(batch)
                batch, size = [], 0
        if batch:
            yield from self._lifted(batch)

    def _lifted(self, batch: list[tuple[int, bytes, IntArray]]) -> Iterator[StructArray]:
        try:
            yield self._rows(batch)
        except Torn:
            for unit, data, _ in batch:
                try:
                    self.recording.distrust_index(unit)
                    offsets = self.recording.offsets(unit, self.of_topic)
                    yield self._rows([(unit, data, offsets)])
                except Torn as tear:
                    self._skip_or_raise(unit, tear)

    def _rows(self, batch: list[tuple[int, bytes, IntArray]]) -> StructArray:
        starts = np.cumsum([0, *(len(data) for _, data, _ in batch)])
        shifted = [
            start + offsets for start, (_, _, offsets) in zip(starts[:-1], batch, strict=True)
        ]
        data = b"".join(data for _, data, _ in batch)
        return _rows_at(data, np.sort(np.concatenate(shifted)), self.of_topic, self.dtype)

    def _skip_or_raise(self, unit: int, tear: Torn) -> None:
        if not self.salvage:
            recording = self.recording
            raise DataError(
                f"{recording.path} is damaged: {recording.place_of(unit)} is {tear}",
                hint=_hint_of_damage(recording.path),
            ) from tear


def _mask_of(channels: Sequence[Channel]) -> BoolArray:
    """Return a (65536,) mask that is true for the numbers of these channels."""
    mask = np.zeros(1 << 16, np.bool_)
    mask[[channel.id for channel in channels]] = True
    return mask


def _rows_at(
    data: bytes, offsets: IntArray, of_topic: BoolArray, dtype: np.dtype[Any]
) -> StructArray:
    """Return the rows of the messages at `offsets`, as raw `V{itemsize}` records.

    Args:
        data: Decompressed content of one chunk, or of several joined chunks.
        offsets: (N,) positions of the message records in `data`, ascending.
        of_topic: (65536,) mask that is true for the channel ids that belong to the topic.
        dtype: Dtype that the rows must have.

    Raises:
        Torn: A record at one of the offsets is not a fixed-size CDR message of the topic.
    """
    size = dtype.itemsize
    room = len(data) - _MESSAGE_HEAD.itemsize - size
    if not len(offsets):
        return np.empty(0, f"V{size}")
    if offsets[0] < 0 or (offsets[1:] <= offsets[:-1]).any():
        raise Torn("a chunk whose messages overlap")
    other = Torn(f"a chunk with messages that are not little-endian CDR of {size} bytes")
    if offsets[-1] > room:
        raise other
    head = _at(data, offsets, _MESSAGE_HEAD.itemsize).view(_MESSAGE_HEAD)
    whole = (head["opcode"] == Opcode.MESSAGE) & (head["length"] == _LENGTH_BEFORE_ROW + size)
    if not (whole & of_topic[head["channel"]] & (head["cdr"] == _CDR)).all():
        raise other
    return _at(data, offsets + _MESSAGE_HEAD.itemsize, size)


def _at(data: bytes, offsets: IntArray, size: int) -> StructArray:
    """Return copies of `size` bytes from each offset, gathered over all overlapping windows."""
    windows: StructArray = np.ndarray(len(data) - size + 1, f"V{size}", data, strides=(1,))
    return windows[offsets]


class _Recording:
    """MCAP file opened for reading, with the positions of its records.

    Torn files are read up to the first damaged record. A *unit* is a part of an MCAP file that can
    be read separately: one chunk, or all messages outside chunks together.

    Args:
        file: The open MCAP file.
        path: Name of the file, used in error messages.

    Raises:
        DataError: The file is not an MCAP file, or was written by a newer version of hil.
    """

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self.path = path
        self.layout = scan(file, path)
        self._file, self._zstd = file, zstandard.ZstdDecompressor()
        own = self.layout.metadata.get(FILE_METADATA)
        if own is not None:
            require_known_version(path, own, "format_version", FILE_FORMAT_VERSION)
        self._walked: dict[int, dict[int, IntArray]] = {}
        self._damage: dict[int, str] = {}
        for number, span in enumerate(self.layout.chunks):
            if not span.indexed or not span.indexes.keys() <= self.layout.channels.keys():
                self._walk(number)
        if self.layout.loose:
            self._walk(_LOOSE)

    @property
    def tear(self) -> str:
        """Position and kind of the damage of the file; empty if the file is not damaged."""
        return self.layout.problem

    def channels_of(self, topic: str) -> list[Channel]:
        """Return all channels of a topic.

        Raises `DataError` if no channel of the file belongs to the topic.
        """
        channels = self.layout.channels.values()
        found = [channel for channel in channels if channel.topic == topic]
        if not found:
            names = sorted({channel.topic for channel in channels})
            raise DataError(
                f"{self.path} has no topic {topic}" + (f" ({self.tear})" if self.tear else ""),
                hint=f"it has {', '.join(names)}" if names else hint_of_lost(self.path),
            )
        return found

    def count(self, channels: Sequence[Channel]) -> int:
        """Return the number of messages of these channels in undamaged chunks."""
        ids = [channel.id for channel in channels]
        walked = sum(len(found[i]) for found in self._walked.values() for i in ids if i in found)
        indexed = (
            span.indexes[i][1]
            for number, span in enumerate(self.layout.chunks)
            if number not in self._walked and number not in self._damage
            for i in ids
            if i in span.indexes
        )
        return walked + sum(indexed)

    def promised(self, channels: Sequence[Channel]) -> int | None:
        """Return the message count of these channels in the summary; None without summary."""
        counts = self.layout.counts
        return None if counts is None else sum(counts.get(c.id, 0) for c in channels)

    def dtype_of(self, channel: Channel) -> np.dtype[Any]:
        """Return the numpy dtype of the messages of a channel.

        Raises:
            DataError: The messages are not fixed-size CDR messages, or have a newer schema version.
        """
        if channel.topic == STATE_TOPIC and "schema_version" in channel.metadata:
            where = Path(f"{self.path}:{channel.topic}")
            known = STATE_SCHEMA_VERSION
            require_known_version(where, channel.metadata, "schema_version", known)
        schema = self.layout.schemas.get(channel.schema_id)
        if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
            raise DataError(
                f"{self.path}: {channel.topic} is not CDR with a ROS 2 definition",
                hint="hil reads its own recordings only; convert others with: hil import",
            )
        try:
            return dtype_of_schema(schema.data.decode("utf-8", "replace"))
        except DataError as error:
            raise DataError(
                f"{self.path}: {channel.topic} cannot be read as rows: {error.message}",
                hint="`hil import` converts ROS 2 bags with messages of any kind",
            ) from None

    @property
    def units(self) -> list[int]:
        """Numbers of all units of the file."""
        return [*range(len(self.layout.chunks)), *([_LOOSE] if self.layout.loose else [])]

    def content(self, unit: int) -> bytes:
        """Return the decompressed records of one unit of the file.

        Raises `Torn` if the unit of the file is damaged.
        """
        if unit in self._damage:
            raise Torn(self._damage[unit])
        if unit != _LOOSE:
            return read_chunk(self._file, self.layout.chunks[unit], self._zstd)
        records = []
        for offset, length in self.layout.loose:
            self._file.seek(offset - RECORD_HEADER.size)
            records.append(self._file.read(RECORD_HEADER.size + length))
        return b"".join(records)

    def offsets(self, unit: int, of_topic: BoolArray) -> IntArray:
        """Return the positions of the messages of a topic in the content of a unit, unsorted.

        Args:
            unit: Number of the unit, one of `units`.
            of_topic: (65536,) mask that is true for the channel ids that belong to the topic.
        """
        if unit in self._walked:
            found = [walked for i, walked in self._walked[unit].items() if of_topic[i]]
        else:
            found = []
            for channel, (offset, messages) in self.layout.chunks[unit].indexes.items():
                if of_topic[channel]:
                    self._file.seek(offset)
                    entries = self._file.read(INDEX_ENTRY_BYTES * messages)
                    found.append(np.frombuffer(entries, "<i8")[1::2])
        if len(found) == 1:
            return found[0]
        return np.concatenate(found) if found else np.empty(0, np.int64)

    def distrust_index(self, unit: int) -> None:
        """Locate the messages of a unit record by record instead of by its index.

        The message index is not used, because no checksum protects it.
        """
        if unit not in self._walked:
            self._walk(unit)

    def distrust_indexes(self) -> None:
        """Locate the messages of every undamaged unit record by record."""
        for unit in self.units:
            if unit not in self._damage:
                self.distrust_index(unit)

    def place_of(self, unit: int) -> str:
        """Return the position of a unit as text for error messages."""
        if unit == _LOOSE:
            return "a message outside chunks"
        return f"chunk {unit} at byte {self.layout.chunks[unit].offset}"

    def _walk(self, unit: int) -> None:
        """Locate messages and read channel definitions of a unit record by record."""
        schemas, channels = [], []
        offsets: defaultdict[int, list[int]] = defaultdict(list)
        try:
            data = self.content(unit)
            for opcode, offset, length in records_in(data):
                start = offset + RECORD_HEADER.size
                if opcode == Opcode.MESSAGE:
                    offsets[int.from_bytes(data[start : start + 2], "little")].append(offset)
                elif opcode == Opcode.SCHEMA:
                    schemas.append(parse(Schema.read, data[start : start + length]))
                else:
                    channels.append(parse(Channel.read, data[start : start + length]))
        except Torn as tear:
            self._damage[unit] = str(tear)
            return
        self._walked[unit] = {i: np.array(at, np.int64) for i, at in offsets.items()}
        self.layout.schemas.update((schema.id, schema) for schema in schemas)
        self.layout.channels.update((channel.id, channel) for channel in channels)
