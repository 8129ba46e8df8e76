"""Inside one chunk of an MCAP file: decompress it, find its messages, lift them out as rows."""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

import numpy as np
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

from hil.core import BoolArray, IntArray, StructArray
from hil.recording.mcap_records import RECORD_HEADER, ChunkSpan, Torn, parse
from hil.robot import CDR_HEADER

_LARGEST_CHUNK_BYTES = 1 << 28

_IN_CHUNKS = (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)

MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
        ("log_time", "<u8"), ("publish_time", "<u8"), ("cdr", "<u4"),
    ]
)  # fmt: skip
"""What stands before a fixed-size row: record header, message header, CDR header."""

_LENGTH_BEFORE_ROW = MESSAGE_HEAD.itemsize - RECORD_HEADER.size
_CDR = int.from_bytes(CDR_HEADER, "little")


class ChunkContent(NamedTuple):
    """What a walk through a chunk finds; offsets are those of the message records."""

    schemas: list[Schema]
    channels: list[Channel]
    offsets: dict[int, list[int]]


def read_chunk(file: IO[bytes], span: ChunkSpan, zstd: zstandard.ZstdDecompressor) -> bytes:
    """The decompressed, checksummed content of a chunk.

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


def walk(data: bytes) -> ChunkContent:
    """Find a chunk's records one after the other; for chunks without (whole) message indexes."""
    content = ChunkContent([], [], defaultdict(list))
    for opcode, offset, length in records_in(data):
        if opcode == Opcode.MESSAGE:
            start = offset + RECORD_HEADER.size
            channel = int.from_bytes(data[start : start + 2], "little")
            content.offsets[channel].append(offset)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            body = data[offset + RECORD_HEADER.size :][:length]
            if opcode == Opcode.SCHEMA:
                content.schemas.append(parse(Schema.read, body))
            else:
                content.channels.append(parse(Channel.read, body))
    return content


def indexed_offsets(file: IO[bytes], span: ChunkSpan, of_topic: BoolArray) -> IntArray:
    """Offsets of a topic's messages within the chunk, from its message indexes.

    Args:
        file: The open file.
        span: The chunk.
        of_topic: (65536,) true for the channel ids that belong to the topic.
    """
    found = []
    for channel, (offset, messages) in span.indexes.items():
        if of_topic[channel]:
            file.seek(offset)
            found.append(np.frombuffer(file.read(16 * messages), "<i8")[1::2])
    if len(found) == 1:
        return found[0]
    return np.concatenate(found) if found else np.empty(0, np.int64)


def rows_at(
    data: bytes, offsets: IntArray, of_topic: BoolArray, dtype: np.dtype[Any]
) -> StructArray:
    """The rows of the messages at `offsets`, as raw `V{itemsize}` records.

    Args:
        data: Content of a chunk, or of several behind each other.
        offsets: (N,) where the message records begin, ascending.
        of_topic: (65536,) true for the channel ids that belong to the topic.
        dtype: What a row must be.

    Raises:
        Torn: Something else than fixed-size CDR messages of the topic stands there.
    """
    size = dtype.itemsize
    room = len(data) - MESSAGE_HEAD.itemsize - size
    if not len(offsets):
        return np.empty(0, f"V{size}")
    if offsets[0] < 0 or (offsets[1:] <= offsets[:-1]).any():
        raise Torn("a chunk whose messages overlap")
    other = Torn(f"a chunk with messages that are not little-endian CDR of {size} bytes")
    if offsets[-1] > room:
        raise other
    head = _at(data, offsets, MESSAGE_HEAD.itemsize).view(MESSAGE_HEAD)
    whole = (head["opcode"] == Opcode.MESSAGE) & (head["length"] == _LENGTH_BEFORE_ROW + size)
    if not (whole & of_topic[head["channel"]] & (head["cdr"] == _CDR)).all():
        raise other
    return _at(data, offsets + MESSAGE_HEAD.itemsize, size)


def _at(data: bytes, offsets: IntArray, size: int) -> StructArray:
    """Copies of `size` bytes from each offset: a gather over all overlapping windows."""
    windows: StructArray = np.ndarray(len(data) - size + 1, f"V{size}", data, strides=(1,))
    return windows[offsets]


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset, length of content) of every record in a chunk.

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
