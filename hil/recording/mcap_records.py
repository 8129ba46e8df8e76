"""The records of an MCAP file: how they are laid out, and which of them are whole.

Format: mcap.dev/spec, version 0. `scan` walks over the records of a file without decompressing
anything. One forward pass serves finished files and torn ones alike, because it does not rely on
the footer: what a crash cuts off is the end. Every length is checked against the file before it is
used, so garbage cannot ask for absurd amounts of memory.

Messages stand in chunks, which are compressed and checksummed: `read_chunk` opens one and
`records_in` walks over what it holds. Whatever is no record raises `Torn`, which says why; readers
turn it into an error or leave that piece out.
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
"""Stands at the beginning and at the end of a file."""

RECORD_HEADER = struct.Struct("<BQ")
"""Opcode, length of the content."""

MESSAGE_FIELDS = [
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
    ("log_time", "<u8"), ("publish_time", "<u8"),
]  # fmt: skip
"""What stands before the data of a message, record header included, as fields for numpy."""

CHUNK_TIMES = struct.Struct("<QQ")
"""First and last log time [ns], at the beginning of a chunk."""

INDEX_HEADER = struct.Struct("<HI")
"""Channel, length of the entries; at the beginning of a message index."""

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
        if run_of(path) is not None:
            raise DataError(
                f"{path} is not an MCAP file any more: its beginning is lost",
                hint=hint_of_lost(path),
            )
        raise DataError(
            f"{path} is not an MCAP file: it does not begin with the MCAP magic bytes",
            hint="other formats are read by `hil import`",
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
    """Read the record behind the whole ones. Raises `Torn` when none is there."""
    file.seek(layout.good_bytes)
    head = file.read(RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        raise Torn("it ends without a footer")
    opcode, length = RECORD_HEADER.unpack(head)
    offset = layout.good_bytes + RECORD_HEADER.size
    if opcode == 0:
        raise Torn("zeros where a record should be")
    if length > layout.size - offset:
        raise Torn("it ends within a record")
    if opcode == Opcode.MESSAGE_INDEX:
        _take_index(file, layout, offset, length)
    else:
        if layout.chunks:  # message indexes follow their chunk: all of them have been seen
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
            raise Torn("it ends without the closing magic bytes")
        layout.complete = True


def _take_index(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    if length < INDEX_HEADER.size or not layout.chunks:
        raise Torn("a message index that belongs to no chunk")
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
        raise Torn(f"a record of {length} bytes that should be short")
    try:
        record = read_explanation(opcode, file.read(length))
    except Torn as spoilt:
        # Its length led to the next record: only this one is lost.
        if len(layout.spoilt) < _MOST_NAMED:
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


def _require_true_summary(file: IO[bytes], layout: Layout, offset: int, length: int) -> None:
    """Believe what the summary repeated about channels only if its checksum is right."""
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
        raise Torn("its summary is damaged")


def whole_records(file: IO[bytes], layout: Layout) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, length of content) of every record before the tear, in file order."""
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
    """Return one record from its content. Raises `Torn` when it is not one."""
    try:
        return kind(ReadDataStream(BytesIO(content)))
    # A length beyond 2⁶³ is an OverflowError, which is no ValueError.
    except (McapError, struct.error, ValueError, OverflowError) as error:
        raise Torn(f"unreadable record: {error}") from error


def read_explanation(opcode: int, content: bytes) -> Explanation:
    """Return a record that explains the messages. Raises `Torn` if it is unreadable or spoilt."""
    record = parse(_EXPLANATIONS[opcode], content)
    if isinstance(record, Attachment):
        checksum = int.from_bytes(content[-CHECKSUM_BYTES:], "little")
        if checksum and zlib.crc32(content[:-CHECKSUM_BYTES]) != checksum:
            raise Torn(f"an attachment ({record.name}) whose checksum is wrong")
    return record


# Inside a chunk.


def read_chunk(file: IO[bytes], span: ChunkSpan, zstd: zstandard.ZstdDecompressor) -> bytes:
    """Return the decompressed content of a chunk, its checksum verified.

    Args:
        file: The open file.
        span: The chunk.
        zstd: One for all chunks of a file: making one costs as much as using it on a small chunk.

    Raises:
        Torn: The chunk is damaged.
    """
    if span.length > _LARGEST_CHUNK_BYTES:
        raise Torn(f"a chunk of {span.length} bytes")
    file.seek(span.offset)
    chunk = parse(Chunk.read, file.read(span.length))
    if chunk.uncompressed_size > _LARGEST_CHUNK_BYTES:
        raise Torn(f"a chunk that claims {chunk.uncompressed_size} bytes")
    if chunk.compression not in _DECOMPRESS:
        raise Torn(f"a chunk with the unknown compression {chunk.compression[:20]!r}")
    try:
        data = _DECOMPRESS[chunk.compression](chunk, zstd)
    except (ValueError, RuntimeError, MemoryError, zstandard.ZstdError) as error:
        raise Torn(f"a chunk that does not decompress: {error}") from error
    if len(data) != chunk.uncompressed_size:
        raise Torn(f"a chunk of {len(data)} bytes that should be {chunk.uncompressed_size}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Torn("a chunk whose checksum is wrong")
    return data


def _unzstd(chunk: Chunk, zstd: zstandard.ZstdDecompressor) -> bytes:
    # A frame that announces another size than the chunk would allocate what it likes.
    announced = zstandard.frame_content_size(chunk.data)
    if announced not in (-1, chunk.uncompressed_size):
        raise ValueError(f"it claims {chunk.uncompressed_size} bytes and holds {announced}")
    return zstd.decompress(chunk.data, max_output_size=chunk.uncompressed_size)


def _unlz4(chunk: Chunk, _: zstandard.ZstdDecompressor) -> bytes:
    # One byte more than it should be shows a frame that goes on.
    data: bytes = LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size + 1)
    return data


def _plain(chunk: Chunk, _: zstandard.ZstdDecompressor) -> bytes:
    return chunk.data


_DECOMPRESS = {"": _plain, "zstd": _unzstd, "lz4": _unlz4}


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset of the record, length of its content) of every record in a chunk.

    Raises:
        Torn: The chunk ends within a record, or holds what no chunk holds.
    """
    offset, end, head = 0, len(data), RECORD_HEADER.size
    while offset < end:
        if offset + head > end:
            raise Torn("a chunk that ends within a record")
        opcode, length = RECORD_HEADER.unpack_from(data, offset)
        if opcode not in _IN_CHUNKS:
            raise Torn(f"a chunk with something else than messages in it ({opcode:#04x})")
        if offset + head + length > end:
            raise Torn("a chunk that ends within a record")
        yield opcode, offset, length
        offset += head + length


# Beginning and end: a look at a few bytes, where walking over the whole file would take too long.


def has_its_beginning(path: Path) -> bool:
    """Return whether a file begins as an MCAP file does; if not, nothing of it can be saved.

    True for a file that cannot be read: that is another problem.
    """
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return True


def torn_although_finished(recordings: Iterable[Path]) -> list[Path]:
    """Return the recordings that have their final name, but not their end: they were cut off."""
    finished = (path for path in recordings if not path.name.endswith(PARTIAL_SUFFIX))
    return [path for path in finished if not _has_its_end(path)]


def _has_its_end(path: Path) -> bool:
    """Return whether a file begins and ends as an MCAP file does; False if it cannot be read."""
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
