"""The records of an MCAP file, written in blocks.

`mcap.writer.Writer` takes messages one by one (10 µs each) and keeps an object per chunk until
the end; at ten chunks a second its index of a 1 GB recording takes 0.4 s to write, during which
a control thread gets the interpreter 6 ms late. Here a block of messages is one numpy operation
and the index lies ready in bytes (decision 0012). What is written once is left to `mcap.records`.
Format: mcap.dev/spec, version 0.
"""

from __future__ import annotations

import struct
import zlib
from collections import defaultdict
from collections.abc import Mapping
from typing import IO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
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

from hil.core import IntArray, StructArray, utf8_text

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 1 << 20
_UINT32 = 0xFFFFFFFF
_COMPRESSION = struct.pack("<I", 4) + b"zstd"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_INDEX_OFFSET = struct.Struct("<HQ")
_MESSAGE = [
    ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
    ("log_time", "<u8"), ("publish_time", "<u8"),
]  # fmt: skip
_MESSAGE_BYTES = 31


class _Entries(NamedTuple):
    """Where messages of a channel stand in the chunk: (N, 2) log time [ns] and offset."""

    channel: int
    entries: IntArray


class McapStream:
    """Writes MCAP records to a binary file that nobody else writes to.

    Args:
        file: Open for writing, empty.
        profile: What the messages keep to, such as `ros2`.
        library: Who writes.
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
        """Write a named record of text → text."""
        self.end_chunk()
        texts = {utf8_text(key): utf8_text(value) for key, value in record.items()}
        content = _bytes_of(Metadata(name=name, metadata=texts))
        self._metadata.append(MetadataIndex(offset=self.size, length=len(content), name=name))
        self._write(content)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write a file to be carried along."""
        self.end_chunk()
        content = _bytes_of(Attachment(0, 0, name, media_type, data))
        self._attachments.append(
            AttachmentIndex(self.size, len(content), 0, 0, len(data), name, media_type)
        )
        self._write(content)

    def register(
        self, topic: str, schema: str, definition: str, metadata: Mapping[str, str]
    ) -> int:
        """Announce a topic of CDR messages; returns its channel.

        Announced outside chunks, so that a file without a single message says what it would
        hold, and again in the first chunk, which is where checksums protect it.
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
        """Append N messages of one size.

        Args:
            channel: As returned by `register`.
            log_ns: (N,) log times [ns], not negative.
            publish_ns: (N,) publish times [ns], not negative.
            messages: (N,) the messages, packed, encapsulation header included.
        """
        size = messages.dtype.itemsize
        records = np.empty(len(messages), [*_MESSAGE, ("message", f"V{size}")])
        records["opcode"] = Opcode.MESSAGE
        records["length"] = records.itemsize - _RECORD.size
        records["channel"] = channel
        records["sequence"] = (self._counts[channel] + np.arange(len(records))) & _UINT32
        records["log_time"], records["publish_time"] = log_ns, publish_ns
        records["message"] = messages.view(f"V{size}")
        most = max(1, CHUNK_BYTES // records.itemsize)
        for begin in range(0, len(records), most):
            self._add(channel, log_ns[begin : begin + most], records[begin : begin + most])

    def end_chunk(self) -> None:
        """Compress and write what has been added since the last chunk, with its index."""
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
        self._chunk_index += _RECORD.pack(Opcode.CHUNK_INDEX, len(index)) + index
        self._chunks += 1
        self._first_ns, self._last_ns = min(self._first_ns, first), max(self._last_ns, last)
        self._content, self._length, self._entries = [], 0, []

    def finish(self) -> None:
        """Write what the file ends with: summary, footer, magic. The file stays open."""
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
        crc = zlib.crc32(footer[:-4], zlib.crc32(offsets, crc))
        self._write(footer[:-4] + struct.pack("<I", crc) + MAGIC)

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
        """Write the index of every channel in the chunk; returns the map channel → its place."""
        places = b""
        for channel in dict.fromkeys(channel for channel, _ in self._entries):
            found = [entries for of_channel, entries in self._entries if of_channel == channel]
            entries = np.concatenate(found).astype("<u8").tobytes()
            places += _INDEX_OFFSET.pack(channel, self.size)
            self._write_record(
                Opcode.MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)), entries
            )
        return places

    def _write_record(self, opcode: Opcode, head: bytes, rest: bytes) -> None:
        self._write(_RECORD.pack(opcode, len(head) + len(rest)) + head)
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


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]
    return content
