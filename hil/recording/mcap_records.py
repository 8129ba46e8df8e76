"""Walks the records of an MCAP file, whole or torn, without decompressing anything.

One forward pass serves finished files and torn ones alike, because it does not rely on the
footer: what a crash cuts off is the end. Every length is checked against the file before it is
used, so garbage cannot ask for absurd amounts of memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, TypeAlias, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema, Statistics

from hil.recording.lost import no_mcap

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = struct.Struct("<BQ")
INDEX_HEADER = struct.Struct("<HI")
_FOOTER = struct.Struct("<QQI")
FOOTER_BYTES = _FOOTER.size
_CHECKSUM_BYTES = 4
_CHUNK_TIMES = struct.Struct("<QQ")
INDEX_ENTRY_BYTES = 16
_LONGEST_EXPLANATION_BYTES = 1 << 28
_MOST_TOLD = 10

_Record = TypeVar("_Record")


class Torn(Exception):
    """The bytes from here on are no record: `args[0]` says why."""


@dataclass(slots=True)
class ChunkSpan:
    """Where a chunk and its message indexes are.

    Attributes:
        offset, length: The chunk record's content, in bytes of the file.
        first_ns, last_ns: Range of its messages' log times [ns].
        indexes: Channel id → (offset, number of messages) of its index entries.
        doubtful: One of its message indexes cannot be right.
        indexed: Whether all its message indexes are there and none is doubtful.
    """

    offset: int
    length: int
    first_ns: int
    last_ns: int
    indexes: dict[int, tuple[int, int]] = field(default_factory=dict)
    doubtful: bool = False
    indexed: bool = False


@dataclass(slots=True)
class Layout:
    """What a pass over the file has found.

    Attributes:
        complete: The footer and the closing magic are there.
        good_bytes: Up to where the file consists of whole records.
        size: Length of the file.
        tear: Why the pass ended before the footer, empty if it did not.
        spoilt: Records that are there but cannot be read, in words.
        counts: Channel id → messages, as the summary says; None without one that can be believed.
        loose: (offset, length) of messages outside chunks.
    """

    size: int
    header: Header | None = None
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkSpan] = field(default_factory=list)
    loose: list[tuple[int, int]] = field(default_factory=list)
    good_bytes: int = 0
    complete: bool = False
    tear: str = ""
    spoilt: list[str] = field(default_factory=list)
    counts: dict[int, int] | None = None

    @property
    def problem(self) -> str:
        """Where and why the file is torn or spoilt, empty when it is neither."""
        if not self.complete:
            return f"torn at byte {self.good_bytes} of {self.size}: {self.tear}"
        return f"damaged: {'; '.join(self.spoilt)}" if self.spoilt else ""


def scan(file: IO[bytes], path: Path, *, places: bool = True) -> Layout:
    """Find all records.

    Args:
        file: The open file.
        path: Its name, for messages.
        places: Keep the attachments, and where every chunk and every message outside chunks is;
            without, the layout of a file of any size is small.

    Raises:
        DataError: The file is no MCAP file at all.
    """
    layout = Layout(size=file.seek(0, 2))
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise no_mcap(path)
    layout.good_bytes = len(MAGIC)
    try:
        while not layout.complete:
            _next_record(file, layout)
            if not places:
                layout.loose.clear()
                layout.attachments.clear()
                del layout.chunks[:-1]
    except Torn as tear:
        layout.tear = str(tear)
    return layout


def whole_records(file: IO[bytes], layout: Layout) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset, length of content) of every record before the tear, in file order."""
    start = len(MAGIC)
    while start + RECORD_HEADER.size <= layout.good_bytes:
        file.seek(start)
        opcode, length = RECORD_HEADER.unpack(file.read(RECORD_HEADER.size))
        content = start + RECORD_HEADER.size
        start = content + length
        if start > layout.good_bytes:
            return
        yield opcode, content, length


def parse(kind: Callable[[ReadDataStream], _Record], content: bytes) -> _Record:
    """One record from its content. Raises `Torn` when it is not one."""
    try:
        return kind(ReadDataStream(BytesIO(content)))
    # A length beyond 2⁶³ is an OverflowError, which is no ValueError.
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise Torn(f"unreadable record: {error}") from error


def _next_record(file: IO[bytes], layout: Layout) -> None:
    start = layout.good_bytes
    file.seek(start)
    head = file.read(RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        raise Torn("it ends without a footer")
    opcode, length = RECORD_HEADER.unpack(head)
    content = start + RECORD_HEADER.size
    if opcode == 0:
        raise Torn("zeros where a record should be")
    if length > layout.size - content:
        raise Torn("it ends within a record")
    _take(file, layout, opcode, content, length)
    layout.good_bytes = content + length
    if opcode == Opcode.FOOTER:
        _require_true_summary(file, layout, content, length)
        file.seek(layout.good_bytes)
        if file.read(len(MAGIC)) != MAGIC:
            raise Torn("it ends without the closing magic bytes")
        layout.complete = True


def _take(file: IO[bytes], layout: Layout, opcode: int, offset: int, length: int) -> None:
    if opcode == Opcode.MESSAGE_INDEX:
        _take_index(file, layout, offset, length)
        return
    if layout.chunks:
        last = layout.chunks[-1]
        last.indexed = bool(last.indexes) and not last.doubtful
    if opcode == Opcode.CHUNK:
        if length < _CHUNK_TIMES.size:
            raise Torn("a chunk without content")
        first, last = _CHUNK_TIMES.unpack(file.read(_CHUNK_TIMES.size))
        layout.chunks.append(ChunkSpan(offset, length, first, last))
    elif opcode == Opcode.MESSAGE:
        layout.loose.append((offset, length))
    elif opcode in _EXPLANATIONS:
        if length > _LONGEST_EXPLANATION_BYTES:
            raise Torn(f"a record of {length} bytes that should be short")
        _explain(layout, opcode, offset, file.read(length))


def _take_index(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    if length < INDEX_HEADER.size or not layout.chunks:
        raise Torn("a message index that belongs to no chunk")
    channel, entries = INDEX_HEADER.unpack(file.read(INDEX_HEADER.size))
    chunk = layout.chunks[-1]
    impossible = entries != length - INDEX_HEADER.size or entries % INDEX_ENTRY_BYTES
    if impossible or channel in chunk.indexes:
        chunk.doubtful = True
    else:
        span = (offset + INDEX_HEADER.size, entries // INDEX_ENTRY_BYTES)
        chunk.indexes[channel] = span


def _require_true_summary(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    """Believe what the summary repeated about channels only if its checksum is right."""
    if length < _FOOTER.size:
        raise Torn("a footer without content")
    file.seek(offset)
    start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    covered = offset + _FOOTER.size - _CHECKSUM_BYTES - start
    if checksum == 0:
        layout.counts = None
        return
    true = 0 < covered < _LONGEST_EXPLANATION_BYTES
    if true:
        file.seek(start)
        true = zlib.crc32(file.read(covered)) == checksum
    if not true:
        layout.schemas.clear()
        layout.channels.clear()
        layout.counts = None
        raise Torn("its summary is damaged")


def _explain(layout: Layout, opcode: int, offset: int, content: bytes) -> None:
    try:
        record = read_explanation(opcode, content)
    except Torn as spoilt:
        # Its length led to the next record: only this one is lost.
        if len(layout.spoilt) < _MOST_TOLD:
            kind = Opcode(opcode).name.lower()
            layout.spoilt.append(f"the {kind} record at byte {offset} is {spoilt}")
        return
    if isinstance(record, Header):
        layout.header = record
    elif isinstance(record, Metadata):
        layout.metadata[record.name] = record.metadata
    elif isinstance(record, Attachment):
        layout.attachments.append(record)
    elif isinstance(record, Schema):
        layout.schemas[record.id] = record
    elif isinstance(record, Channel):
        layout.channels[record.id] = record
    else:
        layout.counts = record.channel_message_counts


def read_explanation(opcode: int, content: bytes) -> Explanation:
    """A record that explains the messages. Raises `Torn` when it is unreadable or spoilt."""
    record = parse(_EXPLANATIONS[opcode], content)
    if isinstance(record, Attachment):
        checksum = int.from_bytes(content[-_CHECKSUM_BYTES:], "little")
        if checksum and zlib.crc32(content[:-_CHECKSUM_BYTES]) != checksum:
            raise Torn(f"an attachment ({record.name}) whose checksum is wrong")
    return record


Explanation: TypeAlias = Header | Metadata | Attachment | Schema | Channel | Statistics

_EXPLANATIONS: dict[int, Callable[[ReadDataStream], Explanation]] = {
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.STATISTICS: Statistics.read,
}
