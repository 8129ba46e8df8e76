"""Walks the records of an MCAP file, whole or torn, without decompressing anything.

One forward pass serves finished files and torn ones alike, because it does not rely on the
footer: what a crash cuts off is the end. Every length is checked against the file before it is
used, so garbage cannot ask for absurd amounts of memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from hil.errors import DataError

MAGIC = b"\x89MCAP0\r\n"
RECORD_HEADER = struct.Struct("<BQ")
_INDEX_HEADER = struct.Struct("<HI")
_FOOTER = struct.Struct("<QQI")
_CHECKSUM_BYTES = 4
_CHUNK_TIMES = struct.Struct("<QQ")
_INDEX_ENTRY_BYTES = 16
_LONGEST_EXPLANATION_BYTES = 1 << 28

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
        indexed: Whether all its message indexes are there.
    """

    offset: int
    length: int
    first_ns: int
    last_ns: int
    indexes: dict[int, tuple[int, int]] = field(default_factory=dict)
    indexed: bool = False


@dataclass(slots=True)
class Layout:
    """What a pass over the file has found.

    Attributes:
        complete: The footer and the closing magic are there.
        good_bytes: Up to where the file consists of whole records.
        size: Length of the file.
        tear: Why the pass ended before the footer, empty if it did not.
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


def scan(file: IO[bytes], path: Path) -> Layout:
    """Find all records.

    Raises:
        DataError: The file is no MCAP file at all.
    """
    layout = Layout(size=file.seek(0, 2))
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        raise DataError(
            f"{path} is not an MCAP file: it does not begin with the MCAP magic bytes",
            hint="other formats are read by `hil import`",
        )
    layout.good_bytes = len(MAGIC)
    try:
        while not layout.complete:
            _next_record(file, layout)
    except Torn as tear:
        layout.tear = str(tear)
    return layout


def parse(kind: Callable[[ReadDataStream], _Record], content: bytes) -> _Record:
    """One record from its content. Raises `Torn` when it is not one."""
    try:
        return kind(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, ValueError) as error:
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
        layout.chunks[-1].indexed = bool(layout.chunks[-1].indexes)
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
        _explain(layout, opcode, file.read(length))


def _take_index(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    if length < _INDEX_HEADER.size or not layout.chunks:
        raise Torn("a message index that belongs to no chunk")
    channel, entries = _INDEX_HEADER.unpack(file.read(_INDEX_HEADER.size))
    if entries != length - _INDEX_HEADER.size or entries % _INDEX_ENTRY_BYTES:
        raise Torn("a message index of impossible length")
    span = (offset + _INDEX_HEADER.size, entries // _INDEX_ENTRY_BYTES)
    layout.chunks[-1].indexes[channel] = span


def _require_true_summary(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    """Believe what the summary repeated about channels only if its checksum is right."""
    if length < _FOOTER.size:
        raise Torn("a footer without content")
    file.seek(offset)
    start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    covered = offset + _FOOTER.size - _CHECKSUM_BYTES - start
    if checksum == 0:
        return
    true = 0 < covered < _LONGEST_EXPLANATION_BYTES
    if true:
        file.seek(start)
        true = zlib.crc32(file.read(covered)) == checksum
    if not true:
        layout.schemas.clear()
        layout.channels.clear()
        raise Torn("its summary is damaged")


def _explain(layout: Layout, opcode: int, content: bytes) -> None:
    record = parse(_EXPLANATIONS[opcode], content)
    if isinstance(record, Header):
        layout.header = record
    elif isinstance(record, Metadata):
        layout.metadata[record.name] = record.metadata
    elif isinstance(record, Attachment):
        layout.attachments.append(record)
    elif isinstance(record, Schema):
        layout.schemas[record.id] = record
    else:
        layout.channels[record.id] = record


_EXPLANATIONS: dict[
    int, Callable[[ReadDataStream], Header | Metadata | Attachment | Schema | Channel]
] = {
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
}
