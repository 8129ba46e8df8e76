"""Copies every whole record of a torn or damaged MCAP file into a new, indexed one.

Works for files of any writer. One chunk is in memory at a time. A chunk is taken as a whole or not
at all: one whose checksum is wrong, that does not decompress or that ends within a record is left
out and reported. Message indexes and chunk headers are not believed but made anew.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TypeAlias

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.writer import Writer

from hil.recording.index_check import IndexCheck
from hil.recording.mcap_records import (
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
from hil.recording.mcap_writer import RECOVERED_METADATA
from hil.recording.routes import Routes
from hil.recording.tally import Tally

_CHUNK_BYTES = 1024 * 1024
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK_TIMES = struct.Struct("<QQ")
_MOST_NAMED = 1000
_DATA_END_BYTES = 4
_EXPLANATIONS = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.METADATA,
    Opcode.ATTACHMENT,
)

_Message: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel, sequence, log time, publish time, data."""


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
        damaged: How many things were left out in all.
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
    writer = Writer(out, chunk_size=_CHUNK_BYTES)
    writer.start(profile=layout.header.profile if layout.header else "")
    copy = _Copy(source, path, layout, writer)
    copy.run()
    found = copy.salvage
    lost = {"damaged_records": str(found.damaged), "orphaned_messages": str(found.orphans)}
    writer.add_metadata(RECOVERED_METADATA, note | lost)
    writer.finish()  # type: ignore[no-untyped-call]
    return found


def survey(source: IO[bytes], path: Path, layout: Layout) -> Salvage:
    """What `rebuild` would keep and leave out, without writing anything."""
    copy = _Copy(source, path, layout, None)
    copy.run()
    return copy.salvage


class _Copy:
    """One pass over the data of a file; what is known of channels grows as it goes."""

    def __init__(
        self, source: IO[bytes], path: Path, layout: Layout, writer: Writer | None
    ) -> None:
        self.salvage = Salvage()
        self._source, self._layout, self._writer = source, layout, writer
        self._zstd = zstandard.ZstdDecompressor()
        self._routes = Routes(path, layout, self.salvage.tally, writer)
        self._indexed = IndexCheck()

    def run(self) -> None:
        """Copy everything."""
        for opcode, offset, length in whole_records(self._source, self._layout):
            if opcode == Opcode.CHUNK:
                self._chunk(offset, length)
            elif opcode == Opcode.MESSAGE_INDEX:
                self._indexed.see(self._source, offset, length)
            elif opcode == Opcode.MESSAGE:
                self._loose(offset, length)
            elif opcode == Opcode.DATA_END and length == _DATA_END_BYTES:
                self.salvage.ended = True
            elif self.salvage.ended:
                continue  # the summary is made anew
            elif opcode in _EXPLANATIONS:
                self._explanation(opcode, offset, length)
            else:
                what = f"a record of the unknown kind {opcode:#04x}"
                self.salvage.lose(Damage(offset, length, what))
        if self.salvage.ended:  # else the tear cut the indexes of the last chunk off
            self._indexed.end_chunk()
        self.salvage.misindexed = self._indexed.wrong
        self._routes.finish()

    def _read(self, offset: int, length: int) -> bytes:
        self._source.seek(offset)
        return self._source.read(length)

    def _chunk(self, offset: int, length: int) -> None:
        self._indexed.end_chunk()
        try:
            data = read_chunk(self._source, ChunkSpan(offset, length, 0, 0), self._zstd)
            records = _opened(data)
        except Torn as damage:
            times = _CHUNK_TIMES.unpack(self._read(offset, _CHUNK_TIMES.size))
            self.salvage.lose(Damage(offset, length, str(damage), *times))
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
            self.salvage.lose(Damage(offset, length, "a message without a head"))
            return
        content = self._read(offset, length)
        self._message((*_MESSAGE.unpack_from(content), content[_MESSAGE.size :]))

    def _message(self, message: _Message) -> None:
        channel, sequence, log_ns, publish_ns, data = message
        route = self._routes.of(channel)
        if route is None:
            self.salvage.orphans += 1
            return
        route.kept.add(sequence, log_ns, publish_ns, data)
        if self._writer is not None:
            self._writer.add_message(route.channel, log_ns, data, publish_ns, sequence)

    def _explanation(self, opcode: int, offset: int, length: int) -> None:
        try:
            record = read_explanation(opcode, self._read(offset, length))
        except Torn as spoilt:
            self.salvage.lose(Damage(offset, length, str(spoilt)))
            return
        if isinstance(record, Metadata):
            self._metadata(record)
        elif isinstance(record, Attachment):
            self._attachment(record)

    def _metadata(self, record: Metadata) -> None:
        if record.name != RECOVERED_METADATA:
            self.salvage.tally.explain("metadata", record.name, record.metadata)
        if self._writer is not None:
            self._writer.add_metadata(record.name, record.metadata)

    def _attachment(self, item: Attachment) -> None:
        times = (item.create_time, item.log_time)
        self.salvage.tally.explain("attachment", item.name, times, item.media_type, item.data)
        if self._writer is not None:
            self._writer.add_attachment(*times, item.name, item.media_type, item.data)


def _opened(data: bytes) -> list[tuple[int, Schema | Channel | _Message]]:
    """(offset, record) of everything in a chunk, parsed before any of it is used."""
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
        elif opcode == Opcode.CHANNEL:
            out.append((offset, parse(Channel.read, data[start : start + length])))
    return out
