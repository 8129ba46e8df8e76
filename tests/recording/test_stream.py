"""Our MCAP records against mcap's own: its readers accept them, its writer writes the same."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import AttachmentIndex, ChunkIndex, Message, MessageIndex, MetadataIndex
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from hil.core.typing import StructArray
from hil.recording import read_info
from hil.recording.mcap_writer import CHUNK_BYTES, McapStream

DEFINITION = "float64 a\nfloat64[3] b\n"
METADATA = {"run": {"uid": "u-1", "name": "größe"}}


def messages(count: int, seed: int) -> StructArray:
    """CDR messages of 32 bytes behind their header."""
    random = np.random.default_rng(seed)
    made = np.zeros(count, [("cdr", "V4"), ("values", "<f8", 4)])
    made["cdr"] = np.void(b"\x00\x01\x00\x00")
    made["values"] = random.normal(size=(count, 4))
    return made


BLOCKS = [(1, 40), (2, 7), (1, 40), (3, 1), (1, 1)]
"""(channel, messages) block by block; a chunk ends after the third."""


def times(block: int, count: int) -> Any:
    return 1_800_000_000_000_000_000 + 1_000_000 * (100 * block + np.arange(count))


def ours() -> bytes:
    file = io.BytesIO()
    stream = McapStream(file, "ros2", "hil")
    for name, record in METADATA.items():
        stream.add_metadata(name, record)
    stream.add_attachment("spec.yaml", "application/yaml", b"hil: 1\n")
    channels = [stream.register(f"/t{i}", "hil/msg/T", DEFINITION, {"i": str(i)}) for i in range(3)]
    assert channels == [1, 2, 3]
    for number, (channel, count) in enumerate(BLOCKS):
        log = times(number, count)
        stream.add_messages(channel, log, log - 5, messages(count, number))
        if number == 2:
            stream.end_chunk()
    stream.finish()
    assert stream.size == len(file.getvalue())
    return file.getvalue()


def theirs() -> bytes:
    file = io.BytesIO()
    writer = Writer(file)
    writer.start("ros2", "hil")
    for name, record in METADATA.items():
        writer.add_metadata(name, record)
    writer.add_attachment(0, 0, "spec.yaml", "application/yaml", b"hil: 1\n")
    for i in range(3):
        schema = writer.register_schema("hil/msg/T", "ros2msg", DEFINITION.encode())
        writer.register_channel(f"/t{i}", "cdr", schema, {"i": str(i)})
    sequence = [0, 0, 0, 0]
    for number, (channel, count) in enumerate(BLOCKS):
        for log, message in zip(times(number, count), messages(count, number), strict=True):
            writer.add_message(
                channel, int(log), message.tobytes(), int(log) - 5, sequence[channel]
            )
            sequence[channel] += 1
        if number == 2:
            writer.flush()  # type: ignore[no-untyped-call]
    writer.finish()  # type: ignore[no-untyped-call]
    return file.getvalue()


def records(content: bytes) -> list[Any]:
    return list(StreamReader(io.BytesIO(content), validate_crcs=True).records)


def of_kind(content: bytes, *kinds: type) -> list[Any]:
    return [record for record in records(content) if type(record) in kinds]


@pytest.mark.parametrize("kind", [Message, MessageIndex], ids=["messages", "message indexes"])
def test_the_same_records_as_mcaps_writer(kind: type) -> None:
    assert of_kind(ours(), kind) == of_kind(theirs(), kind)


def test_the_same_summary_as_mcaps_writer() -> None:
    found = [make_reader(io.BytesIO(content)).get_summary() for content in (ours(), theirs())]
    own, reference = found
    assert own is not None
    assert reference is not None
    assert own.statistics == reference.statistics
    assert own.schemas == reference.schemas
    assert own.channels == reference.channels
    ranges = [[(c.message_start_time, c.message_end_time) for c in s.chunk_indexes] for s in found]  # type: ignore[union-attr]
    assert ranges[0] == ranges[1]
    assert len(ranges[0]) == 2


@pytest.mark.parametrize("kind", [ChunkIndex, AttachmentIndex, MetadataIndex])
def test_every_index_points_at_what_it_names(kind: type) -> None:
    content = ours()
    entries = of_kind(content, kind)
    assert entries
    for entry in entries:
        offset = entry.chunk_start_offset if kind is ChunkIndex else entry.offset
        length = entry.chunk_length if kind is ChunkIndex else entry.length
        stored = int.from_bytes(content[offset + 1 : offset + 9], "little")
        assert 9 + stored == length
        opcode = {ChunkIndex: 0x06, AttachmentIndex: 0x09, MetadataIndex: 0x0C}[kind]
        assert content[offset] == opcode


def test_mcaps_reader_finds_messages_by_time_and_topic_through_the_index() -> None:
    reader = make_reader(io.BytesIO(ours()), validate_crcs=True)
    start = int(times(2, 40)[10])
    found = [m.log_time for _, _, m in reader.iter_messages("/t0", starting_at=start)]
    assert found == [*times(2, 40)[10:], *times(4, 1)]


@pytest.mark.thorough
def test_chunks_stay_below_their_size_and_lose_nothing_where_blocks_are_cut() -> None:
    file = io.BytesIO()
    stream = McapStream(file, "ros2", "hil")
    channel = stream.register("/t", "hil/msg/T", DEFINITION, {})
    made = messages(100_000, 0)
    log = times(0, len(made))
    for begin in range(0, len(made), 70_000):
        block = slice(begin, begin + 70_000)
        stream.add_messages(channel, log[block], log[block], made[block])
    stream.finish()
    indexes = of_kind(file.getvalue(), ChunkIndex)
    assert all(index.uncompressed_size <= CHUNK_BYTES + 1000 for index in indexes)
    assert len(indexes) > 5
    got = of_kind(file.getvalue(), Message)
    assert b"".join(message.data for message in got) == made.tobytes()
    assert [message.sequence for message in got] == list(range(len(made)))


def test_a_torn_file_without_a_message_still_says_what_it_would_hold(tmp_path: Path) -> None:
    torn = tmp_path / "00.mcap.partial"
    with torn.open("wb") as file:
        McapStream(file, "ros2", "hil").register("/t", "hil/msg/T", DEFINITION, {"unit.a": "m"})
    topic = read_info(torn).topics["/t"]
    assert (topic.messages, topic.schema_name, dict(topic.metadata)) == (
        0,
        "hil/msg/T",
        {"unit.a": "m"},
    )
    assert topic.dtype == np.dtype([("a", "<f8"), ("b", "<f8", (3,))])
