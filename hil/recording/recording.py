"""An open recording: which messages of which topic stand where."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from mcap.records import Channel

from hil.core import BoolArray, DataError, IntArray, require_known_version
from hil.recording.chunks import indexed_offsets, read_chunk, walk
from hil.recording.mcap_records import RECORD_HEADER, Torn, scan
from hil.recording.mcap_writer import FILE_FORMAT_VERSION, FILE_METADATA
from hil.recording.recording_files import hint_of_lost
from hil.robot import STATE_SCHEMA_VERSION, STATE_TOPIC, dtype_of_schema

_KNOWN_VERSIONS = {STATE_TOPIC: STATE_SCHEMA_VERSION}
_LOOSE = -1


class Recording:
    """An MCAP file whose records have been found; torn files are known up to the tear.

    Args:
        file: The open file.
        path: Its name, for messages.

    Raises:
        DataError: It is no MCAP file, or was written by a newer hil.
    """

    def __init__(self, file: IO[bytes], path: Path) -> None:
        self.path = path
        self.layout = scan(file, path)
        self._file, self._zstd = file, zstandard.ZstdDecompressor()
        own = self.layout.metadata.get(FILE_METADATA)
        if own is not None:
            require_known_version(path, own, "format_version", FILE_FORMAT_VERSION)
        self._walked: dict[int, dict[int, IntArray]] = {}
        self._damage: dict[int, str] = {}
        for number, span in enumerate(self.layout.chunks):
            if not span.indexed or not span.indexes.keys() <= self.layout.channels.keys():
                self._walk(number)
        if self.layout.loose:
            self._walk(_LOOSE)

    @property
    def tear(self) -> str:
        """Where and why the file ends too early or is spoilt, empty when it is neither."""
        return self.layout.problem

    def channels_of(self, topic: str) -> list[Channel]:
        """The channels of a topic. Raises `DataError` when there is none."""
        channels = self.layout.channels.values()
        found = [channel for channel in channels if channel.topic == topic]
        if not found:
            names = sorted({channel.topic for channel in channels})
            raise DataError(
                f"{self.path} has no topic {topic}" + (f" ({self.tear})" if self.tear else ""),
                hint=f"it has {', '.join(names)}" if names else hint_of_lost(self.path),
            )
        return found

    def count(self, channels: Sequence[Channel]) -> int:
        """How many messages of these channels stand in whole chunks."""
        ids = [channel.id for channel in channels]
        walked = sum(len(found[i]) for found in self._walked.values() for i in ids if i in found)
        indexed = (
            span.indexes[i][1]
            for number, span in enumerate(self.layout.chunks)
            if number not in self._walked and number not in self._damage
            for i in ids
            if i in span.indexes
        )
        return walked + sum(indexed)

    def promised(self, channels: Sequence[Channel]) -> int | None:
        """How many messages of these channels the summary counts; None where it says nothing."""
        counts = self.layout.counts
        return None if counts is None else sum(counts.get(c.id, 0) for c in channels)

    def dtype_of(self, channel: Channel) -> np.dtype[Any]:
        """The dtype of a channel's messages.

        Raises:
            DataError: They are not fixed-size CDR, or of a newer schema version.
        """
        known = _KNOWN_VERSIONS.get(channel.topic)
        if known is not None and "schema_version" in channel.metadata:
            where = Path(f"{self.path}:{channel.topic}")
            require_known_version(where, channel.metadata, "schema_version", known)
        schema = self.layout.schemas.get(channel.schema_id)
        if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
            raise DataError(
                f"{self.path}: {channel.topic} is not CDR with a ROS 2 definition",
                hint="hil reads recordings of its own; import others: hil import",
            )
        try:
            return dtype_of_schema(schema.data.decode("utf-8", "replace"))
        except DataError as error:
            raise DataError(
                f"{self.path}: {channel.topic} cannot be read as rows: {error.message}",
                hint="`hil import` converts ROS 2 bags with messages of any kind",
            ) from None

    @property
    def units(self) -> list[int]:
        """What can be read on its own: the chunks, and all messages outside them together."""
        return [*range(len(self.layout.chunks)), *([_LOOSE] if self.layout.loose else [])]

    def content(self, unit: int) -> bytes:
        """The records of a unit, decompressed. Raises `Torn` when it is damaged."""
        if unit in self._damage:
            raise Torn(self._damage[unit])
        if unit != _LOOSE:
            return read_chunk(self._file, self.layout.chunks[unit], self._zstd)
        return b"".join(self._loose_record(*where) for where in self.layout.loose)

    def offsets(self, unit: int, of_topic: BoolArray) -> IntArray:
        """Where a topic's messages are in a unit's content, in any order.

        Args:
            unit: One of `units`.
            of_topic: (65536,) true for the channel ids that belong to the topic.
        """
        if unit not in self._walked:
            return indexed_offsets(self._file, self.layout.chunks[unit], of_topic)
        walked = [found for i, found in self._walked[unit].items() if of_topic[i]]
        return np.concatenate(walked) if walked else np.empty(0, np.int64)

    def distrust_index(self, unit: int) -> None:
        """Find a unit's messages by walking through it: checksums do not cover indexes."""
        if unit not in self._walked:
            self._walk(unit)

    def distrust_indexes(self) -> None:
        """The same for every unit that is whole."""
        for unit in self.units:
            if unit not in self._damage:
                self.distrust_index(unit)

    def place_of(self, unit: int) -> str:
        """Where a unit is, for messages."""
        if unit == _LOOSE:
            return "a message outside chunks"
        return f"chunk {unit} at byte {self.layout.chunks[unit].offset}"

    def _walk(self, unit: int) -> None:
        try:
            content = walk(self.content(unit))
        except Torn as tear:
            self._damage[unit] = str(tear)
            return
        self._walked[unit] = {i: np.array(o, np.int64) for i, o in content.offsets.items()}
        self.layout.schemas.update((schema.id, schema) for schema in content.schemas)
        self.layout.channels.update((channel.id, channel) for channel in content.channels)

    def _loose_record(self, offset: int, length: int) -> bytes:
        self._file.seek(offset - RECORD_HEADER.size)
        return self._file.read(RECORD_HEADER.size + length)
