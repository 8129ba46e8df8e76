"""What is whole in a torn or damaged MCAP file: counted, and copied into a new, indexed file.

Works for files of any writer. One chunk is in memory at a time. A chunk is taken as a whole or not
at all: one whose checksum is wrong, that does not decompress or that ends within a record is left
out and reported. Message indexes and chunk headers are not believed but made anew.

Channels and schemas are known from three places: chunks (checksummed), the summary (checksummed
when it is whole) and records outside chunks. What a chunk says replaces what the others said, and
equal definitions become one channel.

A `Tally` of what was taken is compared with a tally of what was written, without keeping either: it
holds a count, a time range and a SHA-256 per channel, so it is as small for a day's recording as
for a second's. `tally_of` reads with mcap's own indexed reader: what it finds is what other tools
will find.
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
"""Channel, sequence, log time, publish time, data."""


class Definition(NamedTuple):
    """All that says how a message is to be read; equal ones are one channel."""

    topic: str
    message_encoding: str
    metadata: tuple[tuple[str, str], ...]
    schema_name: str
    schema_encoding: str
    schema_data: bytes

    @classmethod
    def of(cls, channel: Channel, schema: Schema | None) -> Definition:
        """Return the definition of a channel's messages."""
        how = (channel.topic, channel.message_encoding, tuple(channel.metadata.items()))
        if schema is None:
            return cls(*how, *_NO_SCHEMA)
        return cls(*how, schema.name, schema.encoding, schema.data)


@dataclass(slots=True)
class Kept:
    """The messages of one channel.

    Attributes:
        messages: Number of messages.
        first_ns, last_ns: Earliest and latest log time [ns].
    """

    messages: int = 0
    first_ns: int = (1 << 64) - 1
    last_ns: int = 0
    digest: _Hash = field(default_factory=hashlib.sha256)

    def add(self, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Count one message."""
        self.messages += 1
        self.first_ns = min(self.first_ns, log_ns)
        self.last_ns = max(self.last_ns, log_ns)
        self.digest.update(_TALLIED.pack(sequence, log_ns, publish_ns, len(data)) + data)


@dataclass(slots=True)
class Tally:
    """All channels with messages, and what explains them."""

    channels: dict[Definition, Kept] = field(default_factory=dict)
    explanations: list[str] = field(default_factory=list)

    def kept(self, definition: Definition) -> Kept:
        """Return the messages of one channel so far."""
        return self.channels.setdefault(definition, Kept())

    def explain(self, record: Metadata | Attachment) -> None:
        """Count a record, but for the one in which a rebuilt file says what it was made from."""
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
        """Messages of all channels."""
        return sum(kept.messages for kept in self.channels.values())

    def difference(self, other: Tally) -> str:
        """Return the first thing in which two tallies differ, in words; empty if they are equal."""
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
    """Something before the tear that is lost.

    Attributes:
        offset: Where it is in the file.
        length: Its length [bytes].
        what: What it is and what is wrong with it.
        first_ns, last_ns: Log times of its messages as its own header says; 0 where it does not.
    """

    offset: int
    length: int
    what: str
    first_ns: int = 0
    last_ns: int = 0


@dataclass(slots=True)
class Salvage:
    """What a copy kept and what it had to leave out.

    Attributes:
        tally: What was kept.
        damages: What was left out, the first thousand of it.
        damaged: Number of things that were left out in all.
        orphans: Messages whose channel or schema is nowhere defined any more.
        misindexed: Chunks whose message indexes lead elsewhere than to their messages.
        ended: All messages had been written: a tear comes behind them.
    """

    tally: Tally = field(default_factory=Tally)
    damages: list[Damage] = field(default_factory=list)
    damaged: int = 0
    orphans: int = 0
    misindexed: int = 0
    ended: bool = False

    def lose(self, damage: Damage) -> None:
        """Note something that is lost."""
        self.damaged += 1
        if self.damaged <= _MOST_NAMED:
            self.damages.append(damage)


def rebuild(
    source: IO[bytes], path: Path, layout: Layout, out: IO[bytes], note: dict[str, str]
) -> Salvage:
    """Write all that is whole in `source` to `out` as a finished MCAP file.

    Args:
        source: The torn file, open.
        path: Its name, for messages.
        layout: What `scan` found in it; places are not needed.
        out: Where the new file goes, at its beginning.
        note: Metadata that say what the new file was made from.

    Raises:
        DataError: It defines more channels than a file can have.
    """
    writer = Writer(out, chunk_size=CHUNK_BYTES)
    writer.start(profile=layout.header.profile if layout.header else "")
    salvage = _Copy(source, path, layout, writer).run()
    lost = {"damaged_records": str(salvage.damaged), "orphaned_messages": str(salvage.orphans)}
    writer.add_metadata(RECOVERED_METADATA, note | lost)
    writer.finish()  # type: ignore[no-untyped-call]
    return salvage


def survey(source: IO[bytes], path: Path, layout: Layout) -> Salvage:
    """Return what `rebuild` would keep and leave out, without writing anything."""
    return _Copy(source, path, layout, None).run()


def tally_of(path: Path) -> Tally:
    """Return what mcap's own reader finds in a finished file, by its index and all checksums.

    Raises:
        RecordingError: It cannot be read.
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
            hint="hil recover FILE makes whole what is left of it",
        ) from error
    return tally


def _indexed_messages(file: IO[bytes], reader: McapReader) -> Iterator[tuple[Definition, Message]]:
    """Yield every message, found through the index of chunks; one chunk at a time.

    (`iter_messages(log_time_order=False)` of mcap 1.6 holds the whole file before it yields.)
    """
    summary = reader.get_summary()
    if summary is None:
        raise McapError("it has no index")
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
    """Return whether a torn file held no whole message when its writing ended.

    Every part lies open for 0.1 s before its first samples reach it, and the next one lies ready
    while the last is being filled. Such a part has lost nothing, and is no reason to refuse a run.

    Its topics must be announced and nothing before the tear be damaged. Behind it there may be
    what one interrupted write leaves: the beginning of the first chunk or of the ending, or
    zeros. Bytes that are none of these may have been samples, however they came to be unreadable.

    Args:
        file: The open file.
        layout: What `scan` found in it.
        salvage: What is whole in it.
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
    """Return whether the head of a chunk agrees with its length: a wrong one may span the file."""
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
    """One pass over the data of a file; what is known of channels grows as it goes.

    Args:
        source: The torn file, open.
        path: Its name, for messages.
        layout: What `scan` found in it.
        writer: Of the new file; None where none is written.
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
        """Copy everything; return what was kept and what is lost."""
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
                continue  # the summary is made anew
            elif opcode in _EXPLANATIONS:
                self._explanation(opcode, offset, length)
            else:
                what = f"a record of the unknown kind {opcode:#04x}"
                salvage.lose(Damage(offset, length, what))
        if salvage.ended:  # else the tear cut the indexes of the last chunk off
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
            self._salvage.lose(Damage(offset, length, "a message without a head"))
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
    """Return (offset, record) of everything in a chunk, parsed before any of it is used."""
    out: list[tuple[int, Schema | Channel | _Message]] = []
    for opcode, offset, length in records_in(data):
        start = offset + RECORD_HEADER.size
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise Torn("a chunk with a message without a head")
            content = data[start + _MESSAGE.size : start + length]
            out.append((offset, (*_MESSAGE.unpack_from(data, start), content)))
        elif opcode == Opcode.SCHEMA:
            out.append((offset, parse(Schema.read, data[start : start + length])))
        else:
            out.append((offset, parse(Channel.read, data[start : start + length])))
    return out


class _Route(NamedTuple):
    """Where the messages of a channel go: its number in the new file, and its count."""

    channel: int
    kept: Kept


class _Routes:
    """All channels of a torn file, registered in the new one as they are met.

    Args:
        path: The torn file, for messages.
        layout: What is known of its channels from outside the chunks.
        tally: Where messages are counted.
        writer: Of the new file; None where none is written.
    """

    def __init__(self, path: Path, layout: Layout, tally: Tally, writer: Writer | None) -> None:
        self._path, self._tally, self._writer = path, tally, writer
        self._schemas, self._channels = dict(layout.schemas), dict(layout.channels)
        self._routes: dict[int, _Route | None] = {}
        self._new_channels: dict[Definition, int] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {_NO_SCHEMA: 0}

    def define(self, record: Schema | Channel) -> None:
        """Take a definition as a chunk has it."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record
        self._routes.clear()

    def of(self, channel: int) -> _Route | None:
        """Return where the messages of a channel go; None if it is defined nowhere.

        Raises:
            DataError: The file defines more channels than a file can have.
        """
        if channel not in self._routes:
            definition = self._definition(channel)
            self._routes[channel] = definition and _Route(
                self._new_channels.get(definition) or self._register(definition),
                self._tally.kept(definition),
            )
        return self._routes[channel]

    def finish(self) -> None:
        """Register the channels that have no messages, too."""
        for channel in self._channels:
            self.of(channel)

    def _definition(self, number: int) -> Definition | None:
        channel = self._channels.get(number)
        if channel is None:
            return None
        if channel.schema_id == 0:  # by the format: there is none
            return Definition.of(channel, None)
        schema = self._schemas.get(channel.schema_id)
        return None if schema is None else Definition.of(channel, schema)

    def _register(self, definition: Definition) -> int:
        if len(self._new_channels) >= _MOST_CHANNELS:
            raise DataError(
                f"{self._path} defines more than {_MOST_CHANNELS} channels",
                hint="nothing writes such files: take it from a copy that is whole",
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
    """Whether the message indexes behind a chunk lead to its messages: no checksum covers them.

    Gets every message of a chunk, then every index behind it; counts wrong chunks. A chunk without
    any index is right: writers may leave them out.
    """

    def __init__(self) -> None:
        self.wrong = 0
        self._expected: dict[int, list[tuple[int, int]]] = defaultdict(list)
        self._seen = self._failed = self._ignored = False

    def expect(self, channel: int, log_ns: int, offset: int) -> None:
        """Take a message of the chunk."""
        self._expected[channel].append((log_ns, offset))

    def see(self, file: IO[bytes], offset: int, length: int) -> None:
        """Take a message index: where its content is in the file."""
        self._seen = True
        if length < INDEX_HEADER.size:
            self._failed = True
            return
        file.seek(offset)
        channel, _ = INDEX_HEADER.unpack(file.read(INDEX_HEADER.size))
        expected = self._expected.pop(channel, [])
        # Only an index of the right length is read: a wrong one may claim the whole file.
        if length != INDEX_HEADER.size + INDEX_ENTRY_BYTES * len(expected):
            self._failed = True
            return
        entries = np.frombuffer(file.read(INDEX_ENTRY_BYTES * len(expected)), "<u8")
        # Some writers sort the entries by time, others leave them as the messages came.
        self._failed |= not np.array_equal(_sorted(entries), _sorted(expected))

    def ignore_chunk(self) -> None:
        """Expect nothing: the chunk is damaged, so nothing is known of its messages."""
        self._ignored = True

    def end_chunk(self) -> None:
        """Judge the chunk: its indexes are over."""
        failed = self._failed or bool(self._expected)
        self.wrong += self._seen and failed and not self._ignored
        self._expected.clear()
        self._seen = self._failed = self._ignored = False


def _sorted(pairs: Any) -> NDArray[np.uint64]:
    """Return (N, 2) log times [ns] and offsets, by time and then by offset."""
    table = np.asarray(pairs, np.uint64).reshape(-1, 2)
    return table[np.lexsort((table[:, 1], table[:, 0]))]
