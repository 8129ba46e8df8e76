"""Parsing of the records of an MCAP file, and detection of the intact records.

The file format is specified at mcap.dev/spec, version 0. `scan` walks over the records of a file
without decompressing data. A single forward pass handles finished and torn files, because the pass
does not need the footer, which a crash cuts off. Every record length is compared with the file size
before use, so that invalid bytes cannot cause huge memory allocations.

Messages are stored in chunks, which are compressed and have a checksum: `read_chunk` decompresses a
chunk and `records_in` walks over its records. Invalid bytes raise `Torn` with the reason; readers
convert `Torn` into an error or skip the invalid part.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, TypeAlias, TypeVar

import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema, Statistics

from hil.core import DataError
from hil.recording.recording_files import PARTIAL_SUFFIX, hint_of_lost, run_of

MAGIC = b"\x89MCAP0\r\n"
"""Magic bytes at the beginning and at the end of an MCAP file."""

RECORD_HEADER = struct.Struct("<BQ")
"""Format of a record header: opcode, length of the content [bytes]."""

MESSAGE_FIELDS = [
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
    ("log_time", "<u8"), ("publish_time", "<u8"),
]  # fmt: skip
"""Numpy fields of a message record before the data, including the record header."""

CHUNK_TIMES = struct.Struct("<QQ")
"""Format of the first and last log time [ns] at the beginning of a chunk."""

INDEX_HEADER = struct.Struct("<HI")
"""Format of the header of a message index: channel id, length of the entries [bytes]."""

INDEX_ENTRY_BYTES = 16
CHECKSUM_BYTES = 4

_FOOTER = struct.Struct("<QQI")
_LONGEST_EXPLANATION_BYTES = 1 << 28
_LARGEST_CHUNK_BYTES = 1 << 28
_MOST_NAMED = 10
_IN_CHUNKS = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)

Explanation: TypeAlias = Header | Metadata | Attachment | Schema | Channel | Statistics

_EXPLANATIONS: dict[int, Callable[[ReadDataStream], Explanation]] = {
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.STATISTICS: Statistics.read,
}

_Record = TypeVar("_Record")


class Torn(Exception):
    """Error for bytes that are not a valid MCAP record; `args[0]` contains the reason."""


@dataclass(slots=True)
class ChunkSpan:
    """Position of a chunk and of its message indexes in the file.

    Attributes:
        offset, length: Position and length of the content of the chunk record in the file [bytes].
        first_ns, last_ns: Range of the log times of the messages [ns].
        indexes: Map from channel id to (offset, number of messages) of the index entries.
        doubtful: Whether at least one message index of the chunk is invalid.
        indexed: Whether all message indexes of the chunk are present and valid.
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
    """Result of a single pass over the records of a file.

    Attributes:
        complete: Whether the footer and the closing magic bytes are present.
        good_bytes: Length of the part of the file that consists of complete records [bytes].
        size: Length of the whole file [bytes].
        tear: Reason why the pass ended before the footer; empty if the footer was reached.
        spoilt: Descriptions of the unreadable records in the file.
        counts: Number of messages per channel id according to the summary; None without a valid
            summary.
        loose: Positions (offset, length) of the messages outside chunks.
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
        """Position and kind of the damage of the file; empty if the file is not damaged."""
        if not self.complete:
            return f"torn at byte {self.good_bytes} of {self.size}: {self.tear}"
        return f"damaged: {'; '.join(self.spoilt)}" if self.spoilt else ""


def scan(file: IO[bytes], path: Path, *, places: bool = True) -> Layout:
    """Return the positions of all records of an MCAP file.

    Args:
        file: The open MCAP file.
        path: Name of the file, used in error messages.
        places: Whether to store the attachments and the positions of all chunks and of all messages
            outside chunks. If `places` is false, the returned layout needs little memory for files
            of any size.

    Raises:
        DataError: The file is not an MCAP file.
    """
    layout = Layout(size=file.seek(0, 2))
    file.seek(0)
    if file.read(len(MAGIC)) != MAGIC:
        if run_of(path) is not None:
            raise DataError(
                f"{path} is no longer an MCAP file: its first bytes are lost",
                hint=hint_of_lost(path),
            )
        raise DataError(
            f"{path} is not an MCAP file: it does not begin with the MCAP magic bytes",
            hint="convert other formats with `hil import`",
        )
    layout.good_bytes = len(MAGIC)
    try:
        while not layout.complete:
            _take_next(file, layout)
            if not places:
                layout.loose.clear()
                layout.attachments.clear()
                del layout.chunks[:-1]
    except Torn as tear:
        layout.tear = str(tear)
    return layout


def _take_next(file: IO[bytes], layout: Layout) -> None:
    """Read the next record of the file.

    Raises `Torn` if the next bytes are not a valid record.
    """
    file.seek(layout.good_bytes)
    head = file.read(RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        raise Torn("the file ends without a footer")
    opcode, length = RECORD_HEADER.unpack(head)
    offset = layout.good_bytes + RECORD_HEADER.size
    if opcode == 0:
        raise Torn("zeros instead of a record")
    if length > layout.size - offset:
        raise Torn("the file ends within a record")
    if opcode == Opcode.MESSAGE_INDEX:
        _take_index(file, layout, offset, length)
    else:
        # message indexes follow their chunk, so all indexes of the chunk have been read
        if layout.chunks:
            last = layout.chunks[-1]
            last.indexed = bool(last.indexes) and not last.doubtful
        if opcode == Opcode.CHUNK:
            if length < CHUNK_TIMES.size:
                raise Torn("a chunk without content")
            times = CHUNK_TIMES.unpack(file.read(CHUNK_TIMES.size))
            layout.chunks.append(ChunkSpan(offset, length, *times))
        elif opcode == Opcode.MESSAGE:
            layout.loose.append((offset, length))
        elif opcode in _EXPLANATIONS:
            _take_explanation(file, layout, opcode, offset, length)
    layout.good_bytes = offset + length
    if opcode == Opcode.FOOTER:
        _require_true_summary(file, layout, offset, length)
        file.seek(layout.good_bytes)
        if file.read(len(MAGIC)) != MAGIC:
            raise Torn("the file ends without the closing magic bytes")
        layout.complete = True


def _take_index(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    if length < INDEX_HEADER.size or not layout.chunks:
        raise Torn("a message index without a chunk")
    channel, entries = INDEX_HEADER.unpack(file.read(INDEX_HEADER.size))
    chunk = layout.chunks[-1]
    impossible = entries != length - INDEX_HEADER.size or entries % INDEX_ENTRY_BYTES
    if impossible or channel in chunk.indexes:
        chunk.doubtful = True
    else:
        chunk.indexes[channel] = (offset + INDEX_HEADER.size, entries // INDEX_ENTRY_BYTES)


def _take_explanation(
    file: IO[bytes], layout: Layout, opcode: int, offset: int, length: int
) -> None:
    if length > _LONGEST_EXPLANATION_BYTES:
        raise Torn(f"a record of {length} bytes, too long for its type")
    try:
        record = read_explanation(opcode, file.read(length))
    except Torn as spoilt:
        # The length of the record is valid, so only this record is lost.
        if len(layout.spoilt) < _MOST_NAMED:
            kind = Opcode(opcode).name.lower()
            layout.spoilt.append(f"the {kind} record at byte {offset}: {spoilt}")
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


def _require_true_summary(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    """Discard the channel definitions of the summary if the summary checksum is wrong."""
    if length < _FOOTER.size:
        raise Torn("a footer without content")
    file.seek(offset)
    start, _, checksum = _FOOTER.unpack(file.read(_FOOTER.size))
    covered = offset + _FOOTER.size - CHECKSUM_BYTES - start
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
        raise Torn("the summary is damaged")


def whole_records(file: IO[bytes], layout: Layout) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, content length) of every record before the tear, in file order."""
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
    """Return a record parsed from the bytes of its content.

    Raises `Torn` if the bytes are invalid.
    """
    try:
        return kind(ReadDataStream(BytesIO(content)))
    # A length beyond 2⁶³ raises OverflowError, which is not a subclass of ValueError.
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise Torn(f"unreadable record: {error}") from error


def read_explanation(opcode: int, content: bytes) -> Explanation:
    """Return a descriptive record, such as a schema or metadata.

    Raises:
        Torn: The record is unreadable or damaged.
    """
    record = parse(_EXPLANATIONS[opcode], content)
    if isinstance(record, Attachment):
        checksum = int.from_bytes(content[-CHECKSUM_BYTES:], "little")
        if checksum and zlib.crc32(content[:-CHECKSUM_BYTES]) != checksum:
            raise Torn(f"an attachment ({record.name}) whose checksum is wrong")
    return record


# Content of a chunk.


def read_chunk(file: IO[bytes], span: ChunkSpan, zstd: zstandard.ZstdDecompressor) -> bytes:
    """Return the decompressed content of a chunk after checking its checksum.

    Args:
        file: The open MCAP file.
        span: Position of the chunk in the file.
        zstd: Decompressor that is shared by all chunks of a file. Creating a decompressor costs as
            much time as decompressing a small chunk.

    Raises:
        Torn: The chunk is damaged and cannot be decompressed.
    """
    if span.length > _LARGEST_CHUNK_BYTES:
        raise Torn(f"a chunk of {span.length} bytes")
    file.seek(span.offset)
    chunk = parse(Chunk.read, file.read(span.length))
    if chunk.uncompressed_size > _LARGEST_CHUNK_BYTES:
        raise Torn(f"a chunk that declares {chunk.uncompressed_size} bytes")
    if chunk.compression not in _DECOMPRESS:
        raise Torn(f"a chunk with the unknown compression {chunk.compression[:20]!r}")
    try:
        data = _DECOMPRESS[chunk.compression](chunk, zstd)
    except (ValueError, RuntimeError, MemoryError, zstandard.ZstdError) as error:
        raise Torn(f"a chunk that does not decompress: {error}") from error
    if len(data) != chunk.uncompressed_size:
        raise Torn(f"a chunk of {len(data)} bytes instead of {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Torn("a chunk whose checksum is wrong")
    return data


def _unzstd(chunk: Chunk, zstd: zstandard.ZstdDecompressor) -> bytes:
    # A frame header with a different size than the chunk could cause a huge allocation.
    announced = zstandard.frame_content_size(chunk.data)
    if announced not in (-1, chunk.uncompressed_size):
        raise ValueError(f"{announced} bytes instead of {chunk.uncompressed_size}")
    return zstd.decompress(chunk.data, max_output_size=chunk.uncompressed_size)


def _unlz4(chunk: Chunk, _: zstandard.ZstdDecompressor) -> bytes:
    # Requesting one byte more than expected reveals a frame that is too long.
    data: bytes = LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size + 1)
    return data


def _plain(chunk: Chunk, _: zstandard.ZstdDecompressor) -> bytes:
    return chunk.data


_DECOMPRESS = {"": _plain, "zstd": _unzstd, "lz4": _unlz4}


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, record offset, content length) of every record in a chunk.

    Raises:
        Torn: The chunk ends within a record, or contains a kind of record that chunks cannot
            contain.
    """
    offset, end, head = 0, len(data), RECORD_HEADER.size
    while offset < end:
        if offset + head > end:
            raise Torn("a chunk that ends within a record")
        opcode, length = RECORD_HEADER.unpack_from(data, offset)
        if opcode not in _IN_CHUNKS:
            raise Torn(f"a chunk with a record that is not a message ({opcode:#04x})")
        if offset + head + length > end:
            raise Torn("a chunk that ends within a record")
        yield opcode, offset, length
        offset += head + length


# Fast checks of the first and last bytes, for callers that cannot wait for a pass over the file.


def has_its_beginning(path: Path) -> bool:
    """Return whether a file begins with the MCAP magic bytes; other files are irrecoverable.

    The function returns True for a file that cannot be read, because its read error is reported by
    a different function.
    """
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return True


def torn_although_finished(recordings: Iterable[Path]) -> list[Path]:
    """Return the recordings that have their final file name although their end is missing."""
    finished = (path for path in recordings if not path.name.endswith(PARTIAL_SUFFIX))
    return [path for path in finished if not _has_its_end(path)]


def _has_its_end(path: Path) -> bool:
    """Return whether a file begins and ends as an MCAP file; False if it is unreadable."""
    end = RECORD_HEADER.size + _FOOTER.size + len(MAGIC)
    try:
        with path.open("rb") as file:
            begins = file.read(len(MAGIC)) == MAGIC
            if file.seek(0, 2) < len(MAGIC) + end:
                return False
            file.seek(-end, 2)
            tail = file.read(end)
    except OSError:
        return False
    footer = RECORD_HEADER.pack(Opcode.FOOTER, _FOOTER.size)
    return begins and tail.startswith(footer) and tail.endswith(MAGIC)
