"""Reads recordings straight into numpy, chunk by chunk, without decoding a single message.

Only fixed-size CDR messages can be read this way: those of this package, and any other topic
whose ROS 2 definition has neither strings nor sequences.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError, StructArray
from hil.recording.columns import read_rows
from hil.recording.mcap_writer import Attachment
from hil.recording.recording import Recording
from hil.robot import STATE_TOPIC


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a recording.

    Attributes:
        name: Topic name.
        messages: How many can be read.
        schema_name: ROS 2 message name.
        dtype: The rows `read_topic` gives, None when messages differ in size.
        metadata: `schema_version`, `rate_hz`, `clock`, `unit.<field>` as text.
    """

    name: str
    messages: int
    schema_name: str
    dtype: np.dtype[Any] | None
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """What is in a recording, found without reading its samples.

    Attributes:
        path: The file.
        complete: False for a torn or spoilt file; the rest then describes what is left of it.
        tear: Where and how it is torn or spoilt, empty when complete.
        chunks: Number of whole chunks.
        topics: Topic name → what it holds.
        metadata: Named records of text → text.
        attachments: Files carried along, by name.
        start_time: Log time of the first message [s, Unix]; NaN when there is none.
        end_time: Log time of the last message [s, Unix]; NaN when there is none.
    """

    path: Path
    complete: bool
    tear: str
    chunks: int
    topics: Mapping[str, TopicInfo]
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Mapping[str, Attachment]
    start_time: float
    end_time: float


def read_topic(path: Path, topic: str = STATE_TOPIC, *, salvage: bool = False) -> StructArray:
    """All rows of a topic in the order they were written, bit for bit.

    Args:
        path: An MCAP file.
        topic: Topic name.
        salvage: Read what is whole in a torn or damaged file instead of refusing it.

    Raises:
        DataError: The file is missing, no MCAP, torn, damaged, or from a newer hil; or the topic
            is missing or not of fixed size.
    """
    with _opened(path) as recording:
        return read_rows(recording, topic, salvage=salvage)


def read_info(path: Path) -> RecordingInfo:
    """What is in a recording; torn files are described as far as they go.

    Raises:
        DataError: The file is missing, no MCAP, or from a newer hil.
    """
    with _opened(path) as recording:
        layout = recording.layout
        names = sorted({channel.topic for channel in layout.channels.values()})
        spans = [span for span in layout.chunks if span.last_ns]
        return RecordingInfo(
            path=recording.path,
            complete=not recording.tear,
            tear=recording.tear,
            chunks=len(layout.chunks),
            topics={name: _topic_info(recording, name) for name in names},
            metadata=layout.metadata,
            attachments={
                item.name: Attachment(item.name, item.media_type, item.data)
                for item in layout.attachments
            },
            start_time=min((span.first_ns for span in spans), default=np.nan) * 1e-9,
            end_time=max((span.last_ns for span in spans), default=np.nan) * 1e-9,
        )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Recording]:
    try:
        with Path(path).open("rb") as file:
            yield Recording(file, Path(path))
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}",
            hint="see whether it exists and may be read",
        ) from error
    except MemoryError:
        raise DataError(
            f"{path} asks for more memory than there is",
            hint="the file is damaged: hil recover FILE makes whole what is left",
        ) from None


def _topic_info(recording: Recording, topic: str) -> TopicInfo:
    channels = recording.channels_of(topic)
    first = channels[0]
    dtype = None
    with contextlib.suppress(DataError):
        dtype = recording.dtype_of(first)
    schema = recording.layout.schemas.get(first.schema_id)
    return TopicInfo(
        name=topic,
        messages=recording.count(channels),
        schema_name=schema.name if schema else "",
        dtype=dtype,
        metadata=first.metadata,
    )
