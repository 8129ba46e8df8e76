"""What went into a recording and what comes out again, to be compared without keeping either.

A tally keeps a count, a time range and a SHA-256 per topic, so it is as small for a day's
recording as for a second's. `tally_of` reads with mcap's own indexed reader: what it finds is what
other tools will find.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk

from hil.core import RecordingError
from hil.recording.mcap_records import RECORD_HEADER
from hil.recording.mcap_writer import RECOVERED_METADATA

if TYPE_CHECKING:
    from hashlib import _Hash

_TIMES = struct.Struct("<IQQQ")


class Definition(NamedTuple):
    """All that says how a message is to be read; equal ones are one channel."""

    topic: str
    message_encoding: str
    metadata: tuple[tuple[str, str], ...]
    schema_name: str
    schema_encoding: str
    schema_data: bytes


@dataclass(slots=True)
class Kept:
    """The messages of one channel.

    Attributes:
        messages: How many.
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
        self.digest.update(_TIMES.pack(sequence, log_ns, publish_ns, len(data)) + data)


@dataclass(slots=True)
class Tally:
    """All channels with messages, and what explains them."""

    channels: dict[Definition, Kept] = field(default_factory=dict)
    explanations: list[str] = field(default_factory=list)

    def kept(self, definition: Definition) -> Kept:
        """The messages of one channel so far."""
        return self.channels.setdefault(definition, Kept())

    def explain(self, kind: str, name: str, *parts: object) -> None:
        """Count a metadata record or an attachment."""
        digest = hashlib.sha256(repr(parts).encode("utf-8", "surrogatepass")).hexdigest()
        self.explanations.append(f"{kind} {name} {digest}")

    @property
    def messages(self) -> int:
        """Messages of all channels."""
        return sum(kept.messages for kept in self.channels.values())

    def difference(self, other: Tally) -> str:
        """The first thing in which two tallies differ, in words; empty when they are equal."""
        for definition in self.channels | other.channels:
            ours, theirs = (tally.channels.get(definition, Kept()) for tally in (self, other))
            if ours.messages != theirs.messages:
                return f"{ours.messages} and {theirs.messages} messages of {definition.topic}"
            if ours.digest.digest() != theirs.digest.digest():
                return f"the content of the messages of {definition.topic}"
        if sorted(self.explanations) != sorted(other.explanations):
            return "its metadata and attachments"
        return ""


def tally_of(path: Path) -> Tally:
    """What mcap's own reader finds in a finished file, through its index and all checksums.

    Raises:
        RecordingError: It cannot be read.
    """
    tally = Tally()
    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            for definition, message in _messages(file, reader):
                tally.kept(definition).add(
                    message.sequence, message.log_time, message.publish_time, message.data
                )
            for meta in reader.iter_metadata():
                if meta.name != RECOVERED_METADATA:
                    tally.explain("metadata", meta.name, meta.metadata)
            for item in reader.iter_attachments():
                times = (item.create_time, item.log_time)
                tally.explain("attachment", item.name, times, item.media_type, item.data)
    except (OSError, McapError, ValueError, KeyError, struct.error) as error:
        raise RecordingError(
            f"{path} cannot be read back: {error}",
            hint="hil recover FILE makes whole what is left of it",
        ) from error
    return tally


def _messages(file: IO[bytes], reader: McapReader) -> Iterator[tuple[Definition, Message]]:
    """Every message, found through the index of chunks; one chunk at a time.

    (`iter_messages(log_time_order=False)` of mcap 1.6 holds the whole file before it yields.)
    """
    summary = reader.get_summary()
    if summary is None:
        raise McapError("it has no index")
    definitions = {
        channel.id: _definition(channel, summary.schemas.get(channel.schema_id))
        for channel in summary.channels.values()
    }
    for index in summary.chunk_indexes:
        file.seek(index.chunk_start_offset + RECORD_HEADER.size)
        chunk = Chunk.read(ReadDataStream(file))
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Message):
                yield definitions[record.channel_id], record


def _definition(channel: Channel, schema: Schema | None) -> Definition:
    how = (channel.topic, channel.message_encoding, tuple(channel.metadata.items()))
    if schema is None:
        return Definition(*how, "", "", b"")
    return Definition(*how, schema.name, schema.encoding, schema.data)
