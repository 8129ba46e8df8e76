"""Reads recordings straight into numpy, chunk by chunk, without decoding a single message.

Only fixed-size CDR messages can be read this way: those of this package, and any other topic
whose ROS 2 definition has neither strings nor sequences.

All messages of one topic become one structured array. Where they are in a chunk is known from its
message indexes; a gather over the chunk's bytes lifts them out as rows. No checksum covers the
indexes, so what a row's head says is compared with what it must be, and the summary's count with
what was read; an index that is missing or wrong is replaced by a walk through the chunk. Recordings
that are flushed ten times a second have small chunks, so chunks are put together until the work in
numpy is worth its calls. When something in such a batch is not as it should be, its chunks are
looked at one by one.
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
"""What stands before a fixed-size row: record header, message header, CDR header."""

_LENGTH_BEFORE_ROW = _MESSAGE_HEAD.itemsize - RECORD_HEADER.size
_CDR = int.from_bytes(CDR_HEADER, "little")
_LOOSE = -1
"""The unit of all messages outside chunks."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a recording.

    Attributes:
        name: Topic name.
        messages: Number of messages that can be read.
        schema_name: ROS 2 message name.
        dtype: The rows `read_topic` gives, None when messages differ in size.
        metadata: `schema_version`, `rate_hz`, `clock`, `unit.<field>` as text.
    """

    name: str
    messages: int
    schema_name: str
    dtype: np.dtype[Any] | None
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """What is in a recording, found without reading its samples.

    Attributes:
        path: The file.
        complete: False for a torn or spoilt file; the rest then describes what is left of it.
        tear: Where and how it is torn or spoilt, empty when complete.
        chunks: Number of whole chunks.
        topics: Topic name → what it holds.
        metadata: Named records of text → text.
        attachments: Files carried along, by name.
    """

    path: Path
    complete: bool
    tear: str
    chunks: int
    topics: Mapping[str, TopicInfo]
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Mapping[str, Attachment]


def read_topic(path: Path, topic: str = STATE_TOPIC, *, salvage: bool = False) -> StructArray:
    """Return all rows of a topic in the order they were written, bit for bit.

    Args:
        path: An MCAP file.
        topic: Topic name.
        salvage: Read what is whole in a torn or damaged file instead of refusing it.

    Raises:
        DataError: The file is missing, no MCAP, torn, damaged, or from a newer hil; or the topic
            is missing or not of fixed size.
    """
    with _opened(path) as recording:
        return _rows_of(recording, topic, salvage=salvage)


def read_info(path: Path) -> RecordingInfo:
    """Return what is in a recording; torn files are described as far as they go.

    Raises:
        DataError: The file is missing, no MCAP, or from a newer hil.
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
    """Return the device time from the first to the last sample of every attempt, added up [s].

    Only the first and the last samples are read.

    Args:
        recordings: `RunDirectory.recordings`; what cannot be read counts nothing.
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
            hint="see whether it exists and may be read",
        ) from error
    except MemoryError:
        raise DataError(
            f"{path} asks for more memory than there is",
            hint="the file is damaged: hil recover FILE makes whole what is left",
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
    """Return the device time of the first and the last sample [s]; None where none is whole."""
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
    """Return the device times in the first of these units that has any."""
    channels = recording.channels_of(STATE_TOPIC)
    dtype = recording.dtype_of(channels[0])
    if "device_time" not in (dtype.names or ()):  # another tool's topic of the same name
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


# All messages of a topic as one array.


def _rows_of(recording: _Recording, topic: str, *, salvage: bool) -> StructArray:
    """Return all rows of a topic, in file order; `salvage` skips what is torn or damaged.

    Raises:
        DataError: The topic is missing or has no fixed size, or the file is torn or damaged.
    """
    if salvage and not recording.layout.complete:
        recording.distrust_indexes()  # and find what the chunks say about channels
    named = recording.channels_of(topic)
    # A channel without messages may be one whose definition was spoilt outside the chunks.
    channels = [channel for channel in named if recording.count([channel])] or named
    dtype = recording.dtype_of(channels[0])
    if any(recording.dtype_of(channel) != dtype for channel in channels):
        raise DataError(
            f"{recording.path}: the messages of {topic} are of several kinds",
            hint="the recording is damaged, or several were put into one file",
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
    # Message indexes have no checksum: a wrong one hides messages without any other sign.
    if not salvage:
        raise DataError(
            f"{recording.path} is damaged: its summary counts {promised} messages of {topic}, "
            f"its message indexes {len(rows)}",
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
        f"hil recover {path} makes a whole file of what is left; "
        "read_topic(…, salvage=True) reads it"
    )


@dataclass(frozen=True)
class _Lift:
    """Lifts the rows of a topic out of a recording, block by block.

    Attributes:
        recording: The open file.
        of_topic: (65536,) true for the channel ids that belong to the topic.
        dtype: What a row must be.
        salvage: Skip what is damaged instead of raising.
    """

    recording: _Recording
    of_topic: BoolArray
    dtype: np.dtype[Any]
    salvage: bool

    def blocks(self) -> Iterator[StructArray]:
        """Yield the rows of one batch of units after the other."""
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
    """Return (65536,) true for the ids of these channels."""
    mask = np.zeros(1 << 16, np.bool_)
    mask[[channel.id for channel in channels]] = True
    return mask


def _rows_at(
    data: bytes, offsets: IntArray, of_topic: BoolArray, dtype: np.dtype[Any]
) -> StructArray:
    """Return the rows of the messages at `offsets`, as raw `V{itemsize}` records.

    Args:
        data: Content of a chunk, or of several behind each other.
        offsets: (N,) where the message records begin, ascending.
        of_topic: (65536,) true for the channel ids that belong to the topic.
        dtype: What a row must be.

    Raises:
        Torn: Something else than fixed-size CDR messages of the topic stands there.
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
    """Copy `size` bytes from each offset: a gather over all overlapping windows."""
    windows: StructArray = np.ndarray(len(data) - size + 1, f"V{size}", data, strides=(1,))
    return windows[offsets]


class _Recording:
    """An open MCAP file whose records have been found; torn files are known up to the tear.

    What can be read on its own is a *unit*: a chunk, or all messages outside chunks together.

    Args:
        file: The open file.
        path: Its name, for messages.

    Raises:
        DataError: It is no MCAP file, or was written by a newer hil.
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
        """Where and why the file ends too early or is spoilt, empty when it is neither."""
        return self.layout.problem

    def channels_of(self, topic: str) -> list[Channel]:
        """Return the channels of a topic. Raises `DataError` when there is none."""
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
        """Return how many messages of these channels stand in whole chunks."""
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
        """Return how many messages of these channels the summary counts, None without one."""
        counts = self.layout.counts
        return None if counts is None else sum(counts.get(c.id, 0) for c in channels)

    def dtype_of(self, channel: Channel) -> np.dtype[Any]:
        """Return the dtype of a channel's messages.

        Raises:
            DataError: They are not fixed-size CDR, or of a newer schema version.
        """
        if channel.topic == STATE_TOPIC and "schema_version" in channel.metadata:
            where = Path(f"{self.path}:{channel.topic}")
            known = STATE_SCHEMA_VERSION
            require_known_version(where, channel.metadata, "schema_version", known)
        schema = self.layout.schemas.get(channel.schema_id)
        if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
            raise DataError(
                f"{self.path}: {channel.topic} is not CDR with a ROS 2 definition",
                hint="hil reads recordings of its own; import others: hil import",
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
        """All units."""
        return [*range(len(self.layout.chunks)), *([_LOOSE] if self.layout.loose else [])]

    def content(self, unit: int) -> bytes:
        """Return the records of a unit, decompressed. Raises `Torn` when it is damaged."""
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
        """Return where a topic's messages are in a unit's content, in any order.

        Args:
            unit: One of `units`.
            of_topic: (65536,) true for the channel ids that belong to the topic.
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
        """Find a unit's messages by walking through it: checksums do not cover indexes."""
        if unit not in self._walked:
            self._walk(unit)

    def distrust_indexes(self) -> None:
        """Do the same for every unit that is whole."""
        for unit in self.units:
            if unit not in self._damage:
                self.distrust_index(unit)

    def place_of(self, unit: int) -> str:
        """Return where a unit is, for messages."""
        if unit == _LOOSE:
            return "a message outside chunks"
        return f"chunk {unit} at byte {self.layout.chunks[unit].offset}"

    def _walk(self, unit: int) -> None:
        """Find a unit's messages, and what it says about channels, record by record."""
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
