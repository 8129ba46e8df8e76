"""Reading and copying of the undamaged data of a torn or damaged MCAP file.

The module supports files of all MCAP writers. Only one chunk of the file is in memory at a time. A
chunk is either accepted completely or rejected: a chunk with a wrong checksum, a chunk that cannot
be decompressed and a chunk that ends within a record are skipped and reported. The message indexes
and chunk headers of the new file are computed again instead of copied.

Definitions of channels and schemas come from three places in a file: chunks (with checksum), the
summary (with checksum if complete) and records outside chunks. A channel or schema definition in a
chunk overrides the definitions elsewhere, and channels with equal definitions are merged into one
channel.

A `Tally` (counts and checksums) of the recovered messages is compared with a tally of the messages
written to the new file. A `Tally` stores a count, a time range and a SHA-256 checksum per channel,
so that its size does not depend on the length of the recording. The function `tally_of` uses the
indexed reader of the mcap package, which reads the same messages as other tools.
"""

from __future__ import annotations

import hashlib
import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import McapReader, make_reader
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from numpy.typing import NDArray

from hil.core import DataError, RecordingError
from hil.recording.mcap_records import (
    CHUNK_TIMES,
    INDEX_ENTRY_BYTES,
    INDEX_HEADER,
    RECORD_HEADER,
    ChunkSpan,
    Layout,
    Torn,
    parse,
    read_chunk,
    read_explanation,
    records_in,
    whole_records,
)
from hil.recording.mcap_writer import CHUNK_BYTES, RECOVERED_METADATA

if TYPE_CHECKING:
    from hashlib import _Hash

_MOST_NAMED = 1000
_MOST_CHANNELS = 65535
_DATA_END_BYTES = 4
_EXPLANATIONS = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.METADATA,
    Opcode.ATTACHMENT,
)
_NO_SCHEMA = ("", "", b"")
_MESSAGE = struct.Struct("<HIQQ")
_TALLIED = struct.Struct("<IQQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
_LONGEST_COMPRESSION_NAME_BYTES = 16
_MOST_ZEROS = 1 << 22

_Message: TypeAlias = tuple[int, int, int, int, bytes]
"""Tuple with the content of one message: channel, sequence, log time [ns], publish time [ns],
data."""


class Definition(NamedTuple):
    """Description of how the messages of a channel are decoded.

    Channels with equal definitions are merged into one channel.
    """

    topic: str
    message_encoding: str
    metadata: tuple[tuple[str, str], ...]
    schema_name: str
    schema_encoding: str
    schema_data: bytes

    @classmethod
    def of(cls, channel: Channel, schema: Schema | None) -> Definition:
        """Return the description of how the messages of a channel are decoded."""
        how = (channel.topic, channel.message_encoding, tuple(channel.metadata.items()))
        if schema is None:
            return cls(*how, *_NO_SCHEMA)
        return cls(*how, schema.name, schema.encoding, schema.data)


@dataclass(slots=True)
class Kept:
    """Count, time range and digest of the messages of one channel.

    Attributes:
        messages: Number of messages of the channel.
        first_ns, last_ns: Earliest and latest log time of the messages [ns].
    """

    messages: int = 0
    first_ns: int = (1 << 64) - 1
    last_ns: int = 0
    digest: _Hash = field(default_factory=hashlib.sha256)

    def add(self, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add one message to the count, the time range and the digest."""
        self.messages += 1
        self.first_ns = min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)
        self.digest.update(_TALLIED.pack(sequence, log_ns, publish_ns, len(data)) + data)


@dataclass(slots=True)
class Tally:
    """Message statistics of all channels, and digests of metadata and attachments."""

    channels: dict[Definition, Kept] = field(default_factory=dict)
    explanations: list[str] = field(default_factory=list)

    def kept(self, definition: Definition) -> Kept:
        """Return the statistics of one channel; create an empty entry for a new channel."""
        return self.channels.setdefault(definition, Kept())

    def explain(self, record: Metadata | Attachment) -> None:
        """Add a metadata or attachment record to the statistics.

        The metadata record in which a rebuilt file describes its source is skipped.
        """
        if isinstance(record, Attachment):
            times = (record.create_time, record.log_time)
            parts: tuple[object, ...] = (times, record.media_type, record.data)
        elif record.name == RECOVERED_METADATA:
            return
        else:
            parts = (record.metadata,)
        digest = hashlib.sha256(repr(parts).encode("utf-8", "surrogatepass")).hexdigest()
        self.explanations.append(f"{type(record).__name__} {record.name} {digest}")

    @property
    def messages(self) -> int:
        """Total number of messages of all channels."""
        return sum(kept.messages for kept in self.channels.values())

    def difference(self, other: Tally) -> str:
        """Return a description of the first difference between two tallies.

        The returned text is empty if the tallies are equal.
        """
        for definition in self.channels | other.channels:
            ours, theirs = (tally.channels.get(definition, Kept()) for tally in (self, other))
            if ours.messages != theirs.messages:
                return f"{ours.messages} and {theirs.messages} messages of {definition.topic}"
            if ours.digest.digest() != theirs.digest.digest():
                return f"the content of the messages of {definition.topic}"
        if sorted(self.explanations) != sorted(other.explanations):
            return "its metadata and attachments"
        return ""


@dataclass(frozen=True, slots=True)
class Damage:
    """Record or chunk before the tear that was lost.

    Attributes:
        offset: Position of the lost record in the file [bytes].
        length: Length [bytes].
        what: Kind of the lost record and reason for the loss.
        first_ns, last_ns: Range of the message log times according to the header of the chunk [ns];
            0 if unknown.
    """

    offset: int
    length: int
    what: str
    first_ns: int = 0
    last_ns: int = 0


@dataclass(slots=True)
class Salvage:
    """Result of copying a torn file: statistics of the recovered and the lost data.

    Attributes:
        tally: Statistics of the recovered messages.
        damages: Descriptions of the lost records and chunks, at most the first thousand.
        damaged: Total number of lost records and chunks.
        orphans: Number of messages that were lost because their channel or schema definition is
            unreadable.
        misindexed: Number of chunks whose message indexes do not match their messages.
        ended: Whether all messages had been written, so that the tear is after the last message.
    """

    tally: Tally = field(default_factory=Tally)
    damages: list[Damage] = field(default_factory=list)
    damaged: int = 0
    orphans: int = 0
    misindexed: int = 0
    ended: bool = False

    def lose(self, damage: Damage) -> None:
        """Add a lost record or chunk to the statistics."""
        self.damaged += 1
        if self.damaged <= _MOST_NAMED:
            self.damages.append(damage)


def rebuild(
    source: IO[bytes], path: Path, layout: Layout, out: IO[bytes], note: dict[str, str]
) -> Salvage:
    """Write all undamaged data of `source` to `out` as a finished MCAP file.

    Args:
        source: The open torn file.
        path: Name of the torn file, used in error messages.
        layout: Result of `scan`; the positions of chunks and messages are not needed.
        out: Empty output file that is open for writing.
        note: Metadata that describe the torn file from which the new file is rebuilt.

    Raises:
        DataError: The torn file defines more channels than an MCAP file can have.
    """
    writer = Writer(out, chunk_size=CHUNK_BYTES)
    writer.start(profile=layout.header.profile if layout.header else "")
    salvage = _Copy(source, path, layout, writer).run()
    lost = {"damaged_records": str(salvage.damaged), "orphaned_messages": str(salvage.orphans)}
    writer.add_metadata(RECOVERED_METADATA, note | lost)
    writer.finish()  # type: ignore[no-untyped-call]
    return salvage


def survey(source: IO[bytes], path: Path, layout: Layout) -> Salvage:
    """Return the result that `rebuild` would return, without writing a file."""
    return _Copy(source, path, layout, None).run()


def tally_of(path: Path) -> Tally:
    """Return the statistics of a finished file, read with the mcap package.

    All checksums of the file are verified.

    Raises:
        RecordingError: The finished file cannot be read.
    """
    tally = Tally()
    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for definition, message in _indexed_messages(file, reader):
                tally.kept(definition).add(
                    message.sequence, message.log_time, message.publish_time, message.data
                )
            for metadata in reader.iter_metadata():
                tally.explain(metadata)
            for attachment in reader.iter_attachments():
                tally.explain(attachment)
    except (OSError, McapError, ValueError, KeyError, struct.error) as error:
        raise RecordingError(
            f"{path} cannot be read back: {error}",
            hint="recover its messages with: hil recover FILE",
        ) from error
    return tally


def _indexed_messages(file: IO[bytes], reader: McapReader) -> Iterator[tuple[Definition, Message]]:
    """Yield every message that the chunk index contains, with one chunk in memory at a time.

    (The call `iter_messages(log_time_order=False)` of mcap 1.6 would load the whole file before it
    returns the first message.)
    """
    summary = reader.get_summary()
    if summary is None:
        raise McapError("the file has no index")
    definitions = {
        channel.id: Definition.of(channel, summary.schemas.get(channel.schema_id))
        for channel in summary.channels.values()
    }
    for index in summary.chunk_indexes:
        file.seek(index.chunk_start_offset + RECORD_HEADER.size)
        chunk = Chunk.read(ReadDataStream(file))
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Message):
                yield definitions[record.channel_id], record


def never_got_a_message(file: IO[bytes], layout: Layout, salvage: Salvage) -> bool:
    """Return whether the writer of a torn file stopped before the first complete message.

    Every part of a recording is open for 0.1 s before its first samples are written, and the next
    part is already open while the current part is filled. A part without messages has therefore
    lost no data and is not a reason to reject a run.

    The topics of such a part must be announced, and the data before the tear must be undamaged.
    After the tear, only the remains of one interrupted write are accepted: the beginning of the
    first chunk, the beginning of the file end, or zeros. Any other bytes after the tear were
    possibly samples that became unreadable.

    Args:
        file: The open MCAP file.
        layout: Result of `scan` for the torn file.
        salvage: Statistics of the undamaged data of the file.
    """
    if salvage.tally.messages or salvage.damaged or salvage.orphans or layout.spoilt:
        return False
    if not layout.channels or layout.complete or layout.chunks:
        return False
    if salvage.ended:
        return True
    rest = layout.size - layout.good_bytes
    file.seek(layout.good_bytes)
    head = file.read(RECORD_HEADER.size)
    if not any(head):
        return rest <= _MOST_ZEROS and not any(file.read(rest))
    if len(head) < RECORD_HEADER.size:
        return head[0] in (Opcode.CHUNK, Opcode.DATA_END)
    opcode, length = RECORD_HEADER.unpack(head)
    if opcode == Opcode.DATA_END:
        return rest <= RECORD_HEADER.size + _DATA_END_BYTES
    return opcode == Opcode.CHUNK and _is_cut_chunk(file, length)


def _is_cut_chunk(file: IO[bytes], length: int) -> bool:
    """Return whether the sizes in a chunk header agree with the record length.

    A chunk with a wrong length could extend over the rest of the file.
    """
    head = file.read(_CHUNK_HEAD.size)
    if len(head) < _CHUNK_HEAD.size:
        return True
    name_bytes = _CHUNK_HEAD.unpack(head)[-1]
    if name_bytes > _LONGEST_COMPRESSION_NAME_BYTES:
        return False
    rest = file.read(name_bytes + _LENGTH.size)
    if len(rest) < name_bytes + _LENGTH.size:
        return True
    (data_bytes,) = _LENGTH.unpack_from(rest, name_bytes)
    return bool(length == _CHUNK_HEAD.size + name_bytes + _LENGTH.size + data_bytes)


class _Copy:
    """Single pass over a torn file that copies messages and collects channel definitions.

    Args:
        source: The open torn file.
        path: Name of the torn file, used in error messages.
        layout: Result of `scan` for the torn file.
        writer: Writer of the new file; None if no file is written.
    """

    def __init__(
        self, source: IO[bytes], path: Path, layout: Layout, writer: Writer | None
    ) -> None:
        self._source, self._layout, self._writer = source, layout, writer
        self._salvage = Salvage()
        self._zstd = zstandard.ZstdDecompressor()
        self._routes = _Routes(path, layout, self._salvage.tally, writer)
        self._indexed = _IndexCheck()

    def run(self) -> Salvage:
        """Copy all undamaged records; return statistics of recovered and lost data."""
        salvage = self._salvage
        for opcode, offset, length in whole_records(self._source, self._layout):
            if opcode == Opcode.CHUNK:
                self._chunk(offset, length)
            elif opcode == Opcode.MESSAGE_INDEX:
                self._indexed.see(self._source, offset, length)
            elif opcode == Opcode.MESSAGE:
                self._loose(offset, length)
            elif opcode == Opcode.DATA_END and length == _DATA_END_BYTES:
                salvage.ended = True
            elif salvage.ended:
                continue  # the summary is written again
            elif opcode in _EXPLANATIONS:
                self._explanation(opcode, offset, length)
            else:
                what = f"a record of unknown type {opcode:#04x}"
                salvage.lose(Damage(offset, length, what))
        # Without the data end, the tear has cut off the indexes of the last chunk.
        if salvage.ended:
            self._indexed.end_chunk()
        salvage.misindexed = self._indexed.wrong
        self._routes.finish()
        return salvage

    def _read(self, offset: int, length: int) -> bytes:
        self._source.seek(offset)
        return self._source.read(length)

    def _chunk(self, offset: int, length: int) -> None:
        self._indexed.end_chunk()
        try:
            data = read_chunk(self._source, ChunkSpan(offset, length, 0, 0), self._zstd)
            records = _parsed(data)
        except Torn as damage:
            times = CHUNK_TIMES.unpack(self._read(offset, CHUNK_TIMES.size))
            self._salvage.lose(Damage(offset, length, str(damage), *times))
            self._indexed.ignore_chunk()
            return
        for at, record in records:
            if isinstance(record, tuple):
                self._indexed.expect(record[0], record[2], at)
                self._message(record)
            else:
                self._routes.define(record)

    def _loose(self, offset: int, length: int) -> None:
        if length < _MESSAGE.size:
            self._salvage.lose(Damage(offset, length, "a message without a header"))
            return
        content = self._read(offset, length)
        self._message((*_MESSAGE.unpack_from(content), content[_MESSAGE.size :]))

    def _message(self, message: _Message) -> None:
        channel, sequence, log_ns, publish_ns, data = message
        route = self._routes.of(channel)
        if route is None:
            self._salvage.orphans += 1
            return
        route.kept.add(sequence, log_ns, publish_ns, data)
        if self._writer is not None:
            self._writer.add_message(route.channel, log_ns, data, publish_ns, sequence)

    def _explanation(self, opcode: int, offset: int, length: int) -> None:
        try:
            record = read_explanation(opcode, self._read(offset, length))
        except Torn as spoilt:
            self._salvage.lose(Damage(offset, length, str(spoilt)))
            return
        if not isinstance(record, Metadata | Attachment):
            return  # channels and schemas outside chunks are in the layout
        self._salvage.tally.explain(record)
        if self._writer is None:
            return
        if isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        else:
            times = (record.create_time, record.log_time)
            self._writer.add_attachment(*times, record.name, record.media_type, record.data)


def _parsed(data: bytes) -> list[tuple[int, Schema | Channel | _Message]]:
    """Return (offset, record) of all records of a chunk after parsing all of them."""
    out: list[tuple[int, Schema | Channel | _Message]] = []
    for opcode, offset, length in records_in(data):
        start = offset + RECORD_HEADER.size
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise Torn("a chunk with a message without a header")
            content = data[start + _MESSAGE.size : start + length]
            out.append((offset, (*_MESSAGE.unpack_from(data, start), content)))
        elif opcode == Opcode.SCHEMA:
            out.append((offset, parse(Schema.read, data[start : start + length])))
        else:
            out.append((offset, parse(Channel.read, data[start : start + length])))
    return out


class _Route(NamedTuple):
    """Destination of the messages of a channel: channel number in the new file, and statistics."""

    channel: int
    kept: Kept


class _Routes:
    """Mapping of the channels of a torn file to channels of the new file.

    A channel is registered in the new file when its first message is copied.

    Args:
        path: Name of the torn file, used in error messages.
        layout: Layout of the torn file with the channels and schemas that are defined outside the
            chunks.
        tally: Statistics to which the copied messages are added.
        writer: Writer of the new file; None if no file is written.
    """

    def __init__(self, path: Path, layout: Layout, tally: Tally, writer: Writer | None) -> None:
        self._path, self._tally, self._writer = path, tally, writer
        self._schemas, self._channels = dict(layout.schemas), dict(layout.channels)
        self._routes: dict[int, _Route | None] = {}
        self._new_channels: dict[Definition, int] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {_NO_SCHEMA: 0}

    def define(self, record: Schema | Channel) -> None:
        """Store a channel or schema definition from a chunk."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record
        self._routes.clear()

    def of(self, channel: int) -> _Route | None:
        """Return the destination of the messages of a channel; None if the channel is undefined.

        Raises:
            DataError: The torn file defines more channels than an MCAP file can have.
        """
        if channel not in self._routes:
            definition = self._definition(channel)
            self._routes[channel] = definition and _Route(
                self._new_channels.get(definition) or self._register(definition),
                self._tally.kept(definition),
            )
        return self._routes[channel]

    def finish(self) -> None:
        """Register the remaining channels, which have no messages, in the new file."""
        for channel in self._channels:
            self.of(channel)

    def _definition(self, number: int) -> Definition | None:
        channel = self._channels.get(number)
        if channel is None:
            return None
        if channel.schema_id == 0:  # the format uses 0 for a channel without a schema
            return Definition.of(channel, None)
        schema = self._schemas.get(channel.schema_id)
        return None if schema is None else Definition.of(channel, schema)

    def _register(self, definition: Definition) -> int:
        if len(self._new_channels) >= _MOST_CHANNELS:
            raise DataError(
                f"{self._path} defines more than {_MOST_CHANNELS} channels",
                hint="no recorder writes such files: restore an undamaged copy from a backup",
            )
        new = len(self._new_channels) + 1
        if self._writer is not None:
            schema = definition[3:]
            if schema not in self._new_schemas:
                self._new_schemas[schema] = self._writer.register_schema(*schema)
            topic, encoding, metadata = definition[:3]
            new = self._writer.register_channel(
                topic, encoding, self._new_schemas[schema], dict(metadata)
            )
        self._new_channels[definition] = new
        return new


class _IndexCheck:
    """Check of the message indexes that follow a chunk, which no checksum protects.

    The caller passes every message of a chunk to the check, followed by every message index of the
    chunk. The check counts the chunks with wrong message indexes. A chunk without message indexes
    is valid, because MCAP writers are allowed to omit the indexes.
    """

    def __init__(self) -> None:
        self.wrong = 0
        self._expected: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._seen = self._failed = self._ignored = False

    def expect(self, channel: int, log_ns: int, offset: int) -> None:
        """Add a message of the current chunk."""
        self._expected[channel].append((log_ns, offset))

    def see(self, file: IO[bytes], offset: int, length: int) -> None:
        """Compare the message index at `offset` in the file with the messages of the chunk."""
        self._seen = True
        if length < INDEX_HEADER.size:
            self._failed = True
            return
        file.seek(offset)
        channel, _ = INDEX_HEADER.unpack(file.read(INDEX_HEADER.size))
        expected = self._expected.pop(channel, [])
        # Only an index of the expected length is read, because a wrong length can span the whole
        # file.
        if length != INDEX_HEADER.size + INDEX_ENTRY_BYTES * len(expected):
            self._failed = True
            return
        entries = np.frombuffer(file.read(INDEX_ENTRY_BYTES * len(expected)), "<u8")
        # Some writers sort the entries by time, others keep the order of the messages.
        self._failed |= not np.array_equal(_sorted(entries), _sorted(expected))

    def ignore_chunk(self) -> None:
        """Skip the check of a damaged chunk, whose messages are unknown."""
        self._ignored = True

    def end_chunk(self) -> None:
        """Finish the check of a chunk after its last index."""
        failed = self._failed or bool(self._expected)
        self.wrong += self._seen and failed and not self._ignored
        self._expected.clear()
        self._seen = self._failed = self._ignored = False


def _sorted(pairs: Any) -> NDArray[np.uint64]:
    """Return an (N, 2) array of log times [ns] and offsets, sorted by time, then by offset."""
    table = np.asarray(pairs, np.uint64).reshape(-1, 2)
    return table[np.lexsort((table[:, 1], table[:, 0]))]
