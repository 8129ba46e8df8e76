"""An open recording: which messages of which topic stand where, and how to lift them out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.records import Channel

from hil.errors import DataError
from hil.record.cdr import dtype_of_schema
from hil.record.chunks import indexed_offsets, read_chunk, rows_at, walk
from hil.record.files import require_known_version
from hil.record.scan import RECORD_HEADER, ChunkSpan, Torn, scan
from hil.record.topic import STATE_TOPIC
from hil.record.writer import FILE_FORMAT_VERSION, FILE_METADATA
from hil.robot.state import STATE_SCHEMA_VERSION
from hil.typing import BoolArray, StructArray

_KNOWN_VERSIONS = {STATE_TOPIC: STATE_SCHEMA_VERSION}
_LOOSE = -1
_Offsets = dict[int, list[int]]


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
        self._file = file
        own = self.layout.metadata.get(FILE_METADATA)
        if own is not None:
            require_known_version(path, own, "format_version", FILE_FORMAT_VERSION)
        self._walked: dict[int, _Offsets] = {}
        self._damage: dict[int, str] = {}
        for number, span in enumerate(self.layout.chunks):
            if not span.indexed or not span.indexes.keys() <= self.layout.channels.keys():
                self._walk(number)
        if self.layout.loose:
            self._walk(_LOOSE)

    @property
    def tear(self) -> str:
        """Where and why the file ends too early, empty when it does not."""
        layout = self.layout
        if layout.complete:
            return ""
        return f"torn at byte {layout.good_bytes} of {layout.size}: {layout.tear}"

    def channels_of(self, topic: str) -> list[Channel]:
        """The channels of a topic. Raises `DataError` when there is none."""
        channels = self.layout.channels.values()
        found = [channel for channel in channels if channel.topic == topic]
        if not found:
            names = sorted({channel.topic for channel in channels})
            raise DataError(
                f"{self.path} has no topic {topic}" + (f" ({self.tear})" if self.tear else ""),
                hint=f"it has {', '.join(names)}" if names else "not one message of it is whole",
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
            raise DataError(f"{self.path}: {channel.topic} is not CDR with a ROS 2 definition")
        try:
            return dtype_of_schema(schema.data.decode("utf-8", "replace"))
        except DataError as error:
            raise DataError(
                f"{self.path}: {channel.topic} cannot be read as rows: {error.message}",
                hint="`hil import` converts ROS 2 bags with messages of any kind",
            ) from None

    def rows(self, topic: str, *, salvage: bool) -> StructArray:
        """All rows of a topic, in file order; `salvage` skips what is torn or damaged.

        Raises:
            DataError: The topic is missing or no rows, or the file is torn or damaged.
        """
        channels = self.channels_of(topic)
        dtype = self.dtype_of(channels[0])
        if any(self.dtype_of(channel) != dtype for channel in channels):
            raise DataError(f"{self.path}: the messages of {topic} are of several kinds")
        if not salvage:
            self._require_whole(topic, channels)
        out, filled = np.empty(self.count(channels), dtype), 0
        for block in self._blocks(channels, dtype, salvage=salvage):
            if (excess := filled + len(block) - len(out)) > 0:
                out = np.append(out, np.empty(excess, dtype))
            out[filled : filled + len(block)] = block.view(dtype)
            filled += len(block)
        return out[:filled]

    def _require_whole(self, topic: str, channels: Sequence[Channel]) -> None:
        if self.layout.complete:
            return
        raise DataError(
            f"{self.path} is {self.tear}; {len(self.layout.chunks)} complete chunks with "
            f"{self.count(channels)} messages of {topic} can be read",
            hint="hil.record.read_topic(path, topic, salvage=True) reads them",
        )

    def _blocks(
        self, channels: Sequence[Channel], dtype: np.dtype[Any], *, salvage: bool
    ) -> Iterator[StructArray]:
        of_topic = np.zeros(1 << 16, np.bool_)
        of_topic[[channel.id for channel in channels]] = True
        for number in [*range(len(self.layout.chunks)), *([_LOOSE] if self.layout.loose else [])]:
            try:
                yield self._block(number, of_topic, dtype)
            except Torn as tear:
                if not salvage:
                    raise self._damaged(number, tear) from tear

    def _block(self, number: int, of_topic: BoolArray, dtype: np.dtype[Any]) -> StructArray:
        if number in self._damage:
            raise Torn(self._damage[number])
        data = self._content(number)
        if number not in self._walked:
            span = self.layout.chunks[number]
            try:
                return rows_at(data, indexed_offsets(self._file, span, of_topic), of_topic, dtype)
            except Torn:
                # The index is not covered by the chunk's checksum: look for ourselves.
                self._walk(number)
        found = self._walked.get(number, {})
        offsets = sorted(offset for i, where in found.items() if of_topic[i] for offset in where)
        return rows_at(data, np.array(offsets, np.int64), of_topic, dtype)

    def _walk(self, number: int) -> None:
        try:
            content = walk(self._content(number))
        except Torn as tear:
            self._damage[number] = str(tear)
            return
        self._walked[number] = content.offsets
        self.layout.schemas.update((schema.id, schema) for schema in content.schemas)
        self.layout.channels.update((channel.id, channel) for channel in content.channels)

    def _content(self, number: int) -> bytes:
        """The records of a chunk, or of the messages outside chunks, behind each other."""
        if number != _LOOSE:
            return read_chunk(self._file, self.layout.chunks[number])
        return b"".join(self._loose_record(*where) for where in self.layout.loose)

    def _loose_record(self, offset: int, length: int) -> bytes:
        self._file.seek(offset - RECORD_HEADER.size)
        return self._file.read(RECORD_HEADER.size + length)

    def _damaged(self, number: int, tear: Torn) -> DataError:
        span: ChunkSpan | None = self.layout.chunks[number] if number != _LOOSE else None
        where = f"chunk {number} at byte {span.offset}" if span else "a message outside chunks"
        return DataError(
            f"{self.path} is damaged: {where} is {tear}",
            hint="hil.record.read_topic(path, topic, salvage=True) reads the rest",
        )
