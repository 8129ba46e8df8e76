"""All messages of one topic as one structured array.

Recordings that are flushed ten times a second have small chunks, so chunks are put together
until the work in numpy is worth its calls. When something in such a batch is not as it should
be, its chunks are looked at one by one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mcap.records import Channel

from hil.core import BoolArray, DataError, IntArray, StructArray
from hil.recording.chunks import rows_at
from hil.recording.mcap_records import Torn
from hil.recording.recording import Recording

_BATCH_BYTES = 1 << 20
_HINT = "hil recover {} makes a whole file of what is left; read_topic(…, salvage=True) reads it"


def read_rows(recording: Recording, topic: str, *, salvage: bool) -> StructArray:
    """All rows of a topic, in file order; `salvage` skips what is torn or damaged.

    Raises:
        DataError: The topic is missing or has no fixed size, or the file is torn or damaged.
    """
    if salvage and not recording.layout.complete:
        recording.distrust_indexes()  # and find what the chunks say about channels
    named = recording.channels_of(topic)
    # A channel without messages may be one whose definition was spoilt outside the chunks.
    channels = [channel for channel in named if recording.count([channel])] or named
    dtype = recording.dtype_of(channels[0])
    if any(recording.dtype_of(channel) != dtype for channel in channels):
        raise DataError(
            f"{recording.path}: the messages of {topic} are of several kinds",
            hint="the recording is damaged, or several were put into one file",
        )
    if not salvage:
        _require_whole(recording, topic, channels)
    of_topic = np.zeros(1 << 16, np.bool_)
    of_topic[[channel.id for channel in channels]] = True
    lift = _Lift(recording, of_topic, dtype, salvage)
    rows = _filled(recording.count(channels), dtype, lift.blocks())
    promised = recording.promised(channels)
    if promised is None or len(rows) == promised:
        return rows
    if not salvage:
        raise _miscounted(recording, topic, len(rows), promised)
    recording.distrust_indexes()
    return _filled(recording.count(channels), dtype, lift.blocks())


@dataclass(frozen=True)
class _Lift:
    recording: Recording
    of_topic: BoolArray
    dtype: np.dtype[Any]
    salvage: bool

    def blocks(self) -> Iterator[StructArray]:
        batch: list[tuple[int, bytes, IntArray]] = []
        size = 0
        for unit in self.recording.units:
            try:
                data = self.recording.content(unit)
            except Torn as tear:
                self._skip_or_raise(unit, tear)
                continue
            batch.append((unit, data, self.recording.offsets(unit, self.of_topic)))
            size += len(data)
            if size > _BATCH_BYTES:
                yield from self._lifted(batch)
                batch, size = [], 0
        if batch:
            yield from self._lifted(batch)

    def _lifted(self, batch: list[tuple[int, bytes, IntArray]]) -> Iterator[StructArray]:
        try:
            yield self._rows(batch)
        except Torn:
            for unit, data, _ in batch:
                yield from self._lifted_after_a_walk(unit, data)

    def _lifted_after_a_walk(self, unit: int, data: bytes) -> Iterator[StructArray]:
        try:
            self.recording.distrust_index(unit)
            yield self._rows([(unit, data, self.recording.offsets(unit, self.of_topic))])
        except Torn as tear:
            self._skip_or_raise(unit, tear)

    def _rows(self, batch: list[tuple[int, bytes, IntArray]]) -> StructArray:
        starts = np.cumsum([0, *(len(data) for _, data, _ in batch)])
        shifted = [
            start + offsets for start, (_, _, offsets) in zip(starts[:-1], batch, strict=True)
        ]
        data = b"".join(data for _, data, _ in batch)
        return rows_at(data, np.sort(np.concatenate(shifted)), self.of_topic, self.dtype)

    def _skip_or_raise(self, unit: int, tear: Torn) -> None:
        if not self.salvage:
            recording = self.recording
            raise DataError(
                f"{recording.path} is damaged: {recording.place_of(unit)} is {tear}",
                hint=_HINT.format(recording.path),
            ) from tear


def _filled(expected: int, dtype: np.dtype[Any], blocks: Iterator[StructArray]) -> StructArray:
    out, filled = np.empty(expected, dtype), 0
    for block in blocks:
        if (excess := filled + len(block) - len(out)) > 0:
            out = np.append(out, np.empty(excess, dtype))
        out[filled : filled + len(block)].view(block.dtype)[:] = block
        filled += len(block)
    return out[:filled]


def _require_whole(recording: Recording, topic: str, channels: Sequence[Channel]) -> None:
    if recording.tear:
        raise DataError(
            f"{recording.path} is {recording.tear}; {len(recording.layout.chunks)} complete "
            f"chunks with {recording.count(channels)} messages of {topic} can be read",
            hint=_HINT.format(recording.path),
        )


def _miscounted(recording: Recording, topic: str, found: int, promised: int) -> DataError:
    """Message indexes have no checksum: a wrong one hides messages without any other sign."""
    return DataError(
        f"{recording.path} is damaged: its summary counts {promised} messages of {topic}, "
        f"its message indexes {found}",
        hint=_HINT.format(recording.path),
    )
