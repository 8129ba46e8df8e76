"""Which channel of a new file the messages of a torn one go to.

Channels and schemas are known from three places: chunks (checksummed), the summary (checksummed
when it is whole) and records outside chunks. What a chunk says replaces what the others said.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Schema
from mcap.writer import Writer

from hil.core import DataError
from hil.recording.mcap_records import Layout
from hil.recording.tally import Definition, Kept, Tally

_MOST_CHANNELS = 65535
_NO_SCHEMA = ("", "", b"")


class Route(NamedTuple):
    """Where the messages of a channel go: its number in the new file, and its count."""

    channel: int
    kept: Kept


class Routes:
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
        self._routes: dict[int, Route | None] = {}
        self._new_channels: dict[Definition, int] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {_NO_SCHEMA: 0}

    def define(self, record: Schema | Channel) -> None:
        """A definition as it stands in a chunk."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        else:
            self._channels[record.id] = record
        self._routes.clear()

    def of(self, channel: int) -> Route | None:
        """Where the messages of a channel go; None when nobody says what they are.

        Raises:
            DataError: The file defines more channels than a file can have.
        """
        if channel not in self._routes:
            definition = self._definition(channel)
            self._routes[channel] = definition and Route(
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
        how = (channel.topic, channel.message_encoding, tuple(channel.metadata.items()))
        if channel.schema_id == 0:
            return Definition(*how, *_NO_SCHEMA)
        schema = self._schemas.get(channel.schema_id)
        if schema is None:
            return None
        return Definition(*how, schema.name, schema.encoding, schema.data)

    def _register(self, definition: Definition) -> int:
        if len(self._new_channels) >= _MOST_CHANNELS:
            raise DataError(
                f"{self._path} defines more than {_MOST_CHANNELS} channels",
                hint="nothing writes such files: take it from a copy that is whole",
            )
        new = len(self._new_channels) + 1
        if self._writer is not None:
            schema = self._schema(self._writer, definition)
            topic, encoding, metadata = definition[:3]
            new = self._writer.register_channel(topic, encoding, schema, dict(metadata))
        self._new_channels[definition] = new
        return new

    def _schema(self, writer: Writer, definition: Definition) -> int:
        schema = definition[3:]
        if schema not in self._new_schemas:
            self._new_schemas[schema] = writer.register_schema(*schema)
        return self._new_schemas[schema]
