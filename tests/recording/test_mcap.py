"""MCAP files: what is written is read, bit for bit, by us and by the readers of the field."""

from __future__ import annotations

import contextlib
import io
import json
import struct
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from lz4.frame import compress as lz4_compress
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import AttachmentIndex, ChunkIndex, Message, MessageIndex, MetadataIndex
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from hil.core.errors import DataError, HilError, RecordingError
from hil.core.typing import StructArray
from hil.recording import Attachment, McapWriter, read_info, read_topic
from hil.recording.mcap_writer import CHUNK_BYTES, McapStream
from hil.recording.recovery import recover_file
from hil.robot.state import CDR_HEADER, STATE_TOPIC, Topic, dtype_of_schema, state_topic
from tests.support.fuzzing import examples, quick_folder
from tests.support.recorded_rows import (
    EPOCH,
    JOINTS,
    raw_topic,
    record_state,
    rows_of,
    six_axis_topic,
)

# Topics: one numpy dtype is the ROS 2 message definition and the CDR layout


TIMES = [("device_time", "<f8"), ("host_time", "<f8")]


def topic_of(*fields: object, **more: object) -> Topic:
    return Topic("/t", np.dtype([*TIMES, *fields]), 100.0, "controller", **more)  # type: ignore[arg-type]


def test_definition_names_every_field_with_type_length_and_unit() -> None:
    lines = six_axis_topic().schema_text.splitlines()
    assert lines[0] == "float64 device_time  # s"
    assert "float64[6] q  # rad" in lines
    assert "float64[6] effort  # A" in lines
    assert lines[-1] == "int32 mode"


ONE_AXIS = state_topic(1, 1.0, clock="controller", effort_unit="A")


@pytest.mark.parametrize("topic", [six_axis_topic(), ONE_AXIS, raw_topic()], ids=lambda t: t.name)
def test_definition_gives_back_the_dtype(topic: Topic) -> None:
    assert dtype_of_schema(topic.schema_text) == topic.dtype


def test_integer_before_a_double_is_refused_with_the_remedy() -> None:
    with pytest.raises(RecordingError, match="'late' at byte 20 is not aligned") as caught:
        topic_of(("early", "<i4"), ("late", "<f8"))
    assert "float64 first" in caught.value.hint


def test_padded_dtype_is_refused() -> None:
    padded = np.dtype([*TIMES, ("small", "|u1"), ("count", "<i4")], align=True)
    with pytest.raises(RecordingError, match="padding bytes before field 'count'"):
        Topic("/t", padded, 100.0, "controller")


@pytest.mark.parametrize("kind", [">f8", "<c16", "<U4", "O", ("<f8", (2, 3))])
def test_field_without_a_fixed_size_ros_type_is_refused(kind: object) -> None:
    field = ("x", *kind) if isinstance(kind, tuple) else ("x", kind)
    with pytest.raises(RecordingError, match="field 'x'"):
        topic_of(field)


def test_record_must_begin_with_both_times() -> None:
    with pytest.raises(RecordingError, match="lacks time stamps"):
        Topic("/t", np.dtype([("q", "<f8")]), 100.0, "controller")


def test_unit_of_an_unknown_field_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"unknown fields \['qq'\]"):
        topic_of(("q", "<f8"), units={"qq": "rad"})


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_rate_must_be_a_rate(rate_hz: float) -> None:
    with pytest.raises(RecordingError, match="invalid rate"):
        Topic("/t", np.dtype(TIMES), rate_hz, "controller")


def test_blank_rows_say_nothing() -> None:
    blank = six_axis_topic().blank(3)
    assert np.isnan(blank["q"]).all()
    assert np.isnan(blank["device_time"]).all()
    assert (blank["status"] == 0).all()


@pytest.mark.parametrize(
    "definition",
    ["string name", "float64[] q", "float64[<=6] q", "geometry_msgs/Pose pose", "float64[0] q"],
)
def test_definition_of_varying_size_is_refused(definition: str) -> None:
    with pytest.raises(DataError):
        dtype_of_schema(f"float64 t\n{definition}\n")


# Our MCAP records against mcap's own: its readers accept them, its writer writes the same


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


# The columnar reader gives back what was written, bit for bit, from any MCAP layout


def foreign_recording(
    path: Path, fill: Callable[[Writer], None] | None = None, **options: Any
) -> Any:
    """60 state rows by mcap's own writer with unusual options."""
    topic, rows = six_axis_topic(), rows_of(six_axis_topic(), 60)
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2")
        schema = writer.register_schema(topic.schema_name, "ros2msg", topic.schema_text.encode())
        channels = [writer.register_channel(topic.name, "cdr", schema) for _ in range(2)]
        for number, row in enumerate(rows):
            data = CDR_HEADER + row.tobytes()
            writer.add_message(channels[number % 2], 10**9 + number, data, number)
        if fill is not None:
            fill(writer)
        writer.finish()  # type: ignore[no-untyped-call]
    return rows


def test_rows_come_back_bit_for_bit_from_a_file_with_other_topics_between(tmp_path: Path) -> None:
    topics = [six_axis_topic(), raw_topic()]
    rows = {topic.name: rows_of(topic, 3000) for topic in topics}
    rows[STATE_TOPIC]["q"][5] = [np.nan, np.inf, -np.inf, -0.0, 5e-324, 1.0]
    path = tmp_path / "00.mcap"
    with McapWriter(path, topics, joint_names=JOINTS) as writer:
        for begin in range(0, 3000, 11):
            for name, block in rows.items():
                writer.write(name, block[begin : begin + 11])
            if begin % 5 == 0:
                writer.flush(durable=False)
    for name, block in rows.items():
        read = read_topic(path, name)
        assert read.dtype == block.dtype
        assert read.tobytes() == block.tobytes()


def test_columnar_rows_equal_those_of_the_iterator(tmp_path: Path) -> None:
    record_state(tmp_path / "00.mcap", 500, joint_names=JOINTS)
    with (tmp_path / "00.mcap").open("rb") as file:
        messages = make_reader(file).iter_messages(topics=STATE_TOPIC, log_time_order=False)
        content = b"".join(message.data[4:] for _, _, message in messages)
    assert read_topic(tmp_path / "00.mcap").tobytes() == content


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.LZ4},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"use_chunking": False},
        {"chunk_size": 1000, "enable_crcs": False},
    ],
    ids=str,
)
def test_unusual_layouts_are_read_too(tmp_path: Path, options: dict[str, Any]) -> None:
    rows = foreign_recording(tmp_path / "foreign.mcap", **options)
    assert read_topic(tmp_path / "foreign.mcap").tobytes() == rows.tobytes()


def test_a_read_array_may_be_written_to(tmp_path: Path) -> None:
    record_state(tmp_path / "00.mcap", 20)
    assert read_topic(tmp_path / "00.mcap").flags.writeable


def test_missing_topic_is_refused_with_the_topics_there_are(tmp_path: Path) -> None:
    record_state(tmp_path / "00.mcap")
    with pytest.raises(DataError, match="has no topic /arm/state") as caught:
        read_topic(tmp_path / "00.mcap", "/arm/state")
    assert STATE_TOPIC in caught.value.hint


def test_topic_whose_messages_vary_in_size_is_refused(tmp_path: Path) -> None:
    record_state(tmp_path / "00.mcap", joint_names=JOINTS)
    with pytest.raises(DataError, match="'std_msgs/Header header' has no fixed size"):
        read_topic(tmp_path / "00.mcap", "/joint_states")


def test_messages_that_contradict_their_definition_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "00.mcap"
    foreign_recording(path, lambda writer: writer.add_message(1, 2 * 10**9, CDR_HEADER + b"x", 0))
    with pytest.raises(DataError, match="not little-endian CDR of 416 bytes"):
        read_topic(path)


def test_file_of_a_newer_format_is_refused_with_the_version_and_the_remedy(tmp_path: Path) -> None:
    record_state(tmp_path / "00.mcap", metadata={"hil": {"format_version": "2"}})
    for read in (read_topic, read_info):
        with pytest.raises(
            DataError, match="format_version is 2, the highest known version is 1"
        ) as caught:
            read(tmp_path / "00.mcap")
        assert "update hil" in caught.value.hint


def test_record_of_a_newer_schema_is_refused(tmp_path: Path) -> None:
    from dataclasses import replace

    newer = replace(six_axis_topic(), schema_version=2)
    with McapWriter(tmp_path / "00.mcap", [newer]) as writer:
        writer.write(STATE_TOPIC, rows_of(newer, 3))
    with pytest.raises(DataError, match="schema_version is 2, the highest known version is 1"):
        read_topic(tmp_path / "00.mcap")


def test_info_describes_the_file_without_its_samples(tmp_path: Path) -> None:
    spec = Attachment("spec.yaml", "application/yaml", b"hil: 1\n")
    rows = record_state(
        tmp_path / "00.mcap",
        126,
        attachments=[spec],
        joint_names=JOINTS,
        metadata={"a": {"b": "c"}},
    )
    info = read_info(tmp_path / "00.mcap")
    assert info.complete
    assert {name: topic.messages for name, topic in info.topics.items()} == {
        STATE_TOPIC: 126,
        "/joint_states": 42,
        "/events": 0,
    }
    assert info.topics[STATE_TOPIC].dtype == rows.dtype
    assert info.topics["/joint_states"].dtype is None
    assert info.metadata["a"] == {"b": "c"}
    assert info.attachments["spec.yaml"] == spec


def test_empty_recording_has_no_rows_but_is_whole(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "00.mcap", [six_axis_topic()]):
        pass
    assert len(read_topic(tmp_path / "00.mcap")) == 0
    assert read_info(tmp_path / "00.mcap").complete


# MCAP bytes of any kind: rows, a description, a recovery or a clear error; bounded in memory


MAGIC = b"\x89MCAP0\r\n"
HEADER = b"\x04\0\0\0ros2\0\0\0\0"


@cache
def whole() -> tuple[StructArray, bytes]:
    with quick_folder() as folder:
        rows = record_state(folder / "00.mcap", 24, rows_per_chunk=6, joint_names=JOINTS)
        return rows, (folder / "00.mcap").read_bytes()


def outcome(call: Callable[[], Any]) -> Any:
    """What a call gives, None when it is refused in words; every other error is the test's."""
    with contextlib.suppress(HilError):
        return call()
    return None


def look_at(content: bytes) -> StructArray | None:
    """Everything that reads a recording; the rows where there are any."""
    with quick_folder() as folder:
        path = folder / "00.mcap"
        path.write_bytes(content)
        outcome(lambda: read_info(path))
        salvaged = outcome(lambda: read_topic(path, salvage=True))
        recovered = outcome(lambda: recover_file(path, folder / "new.mcap"))
        if recovered is not None and recovered.did == "rebuilt":
            recovered.to_lines(), recovered.to_dict()
            outcome(lambda: read_topic(folder / "new.mcap"))
        assert path.read_bytes() == content
        found: StructArray | None = outcome(lambda: read_topic(path))
        return salvaged if found is None else found


@examples(60)
@given(st.binary(max_size=400))
def test_any_bytes(content: bytes) -> None:
    look_at(content)
    look_at(MAGIC + content)


opcodes = st.sampled_from([*Opcode, 0, 0x10, 0x80, 0xFF])


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    size = len(content) if length is None else length
    return struct.pack("<BQ", opcode, size % 2**64) + content


lengths = st.none() | st.sampled_from([0, 1, 9, 2**31, 2**32, 2**63, 2**64 - 1])


@pytest.mark.thorough
@examples(120)
@given(st.lists(st.tuples(opcodes, st.binary(max_size=80), lengths), max_size=8))
def test_any_records(records: list[tuple[int, bytes, int | None]]) -> None:
    body = b"".join(record(*one) for one in records)
    look_at(MAGIC + record(Opcode.HEADER, HEADER) + body + MAGIC)


@pytest.mark.thorough
@examples(60)
@given(data=st.data())
def test_records_of_a_recording_deleted_doubled_and_swapped(data: st.DataObject) -> None:
    rows, content = whole()
    parts = split(content)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(parts) - 1))
        how = data.draw(st.sampled_from(["delete", "double", "swap", "retype", "cut"]))
        if how == "delete" and len(parts) > 1:
            del parts[at]
        elif how == "double":
            parts.insert(at, parts[at])
        elif how == "swap":
            parts.append(parts.pop(at))
        elif how == "retype":
            parts[at] = bytes([data.draw(opcodes)]) + parts[at][1:]
        else:
            kept = data.draw(st.integers(9, len(parts[at])))
            parts[at] = record(parts[at][0], parts[at][9:kept])
    found = look_at(MAGIC + b"".join(parts) + MAGIC)
    if found is not None and found.dtype == rows.dtype:
        assert {row.tobytes() for row in found} <= {row.tobytes() for row in rows}


def split(content: bytes) -> list[bytes]:
    """The records of a whole file."""
    at, out = len(MAGIC), []
    while at < len(content) - len(MAGIC):
        length = struct.unpack_from("<Q", content, at + 1)[0]
        out.append(content[at : at + 9 + length])
        at += 9 + length
    return out


def chunk(compression: bytes, claimed: int, data: bytes) -> bytes:
    """A chunk without a checksum that claims to hold so many bytes."""
    head = struct.pack("<QQQI", 1, 2, claimed, 0)
    named = struct.pack("<I", len(compression)) + compression
    return record(Opcode.CHUNK, head + named + struct.pack("<Q", len(data)) + data)


ZEROS = bytes(1 << 24)
BOMBS = {
    "zstd": (b"zstd", zstandard.compress(ZEROS)),
    "zstd without its size": (
        b"zstd",
        zstandard.ZstdCompressor(write_content_size=False).compress(ZEROS),
    ),
    "lz4": (b"lz4", lz4_compress(ZEROS)),
    "unknown": (b"brotli", b"x" * 100),
}


@pytest.mark.parametrize("name", BOMBS)
@pytest.mark.parametrize("claimed", [0, 100, len(ZEROS), 1 << 30, 1 << 40, (1 << 64) - 1])
def test_compressed_bombs(name: str, claimed: int) -> None:
    compression, data = BOMBS[name]
    bomb = chunk(compression, claimed, data)
    assert look_at(MAGIC + record(Opcode.HEADER, HEADER) + bomb) is None


def test_file_that_defines_the_same_channel_anew_in_every_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.recording.salvage._MOST_CHANNELS", 1000)
    schema = struct.pack("<H", 1) + b"\x01\0\0\0a\x01\0\0\0b\0\0\0\0"
    records = [record(Opcode.SCHEMA, schema)]
    for number in range(1_001):
        topic = str(number).encode()
        channel = struct.pack("<HHI", 1, 1, len(topic)) + topic + b"\0\0\0\0" + b"\0\0\0\0"
        message = struct.pack("<HIQQ", 1, 0, number, number) + b"x"
        records += [record(Opcode.CHANNEL, channel), record(Opcode.MESSAGE, message)]
    body = b"".join(records)
    inside = chunk(b"", len(body), body)
    path = tmp_path / "many.mcap"
    path.write_bytes(MAGIC + record(Opcode.HEADER, HEADER) + inside)
    assert outcome(lambda: recover_file(path)) is None
    assert [file.name for file in tmp_path.iterdir()] == ["many.mcap"]


# What we record opens in the field's own readers, with equal values


COUNT = 100
EVENT = {"t": EPOCH + 0.25, "kind": "checkpoint", "step": 7}


@pytest.fixture(scope="module")
def rows() -> dict[str, StructArray]:
    state = rows_of(six_axis_topic(), COUNT)
    state["temperature"] = np.nan
    return {STATE_TOPIC: state, "/can/raw": rows_of(raw_topic(), COUNT)}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, rows: dict[str, StructArray]) -> Path:
    path = tmp_path_factory.mktemp("recording") / "00.mcap"
    with McapWriter(
        path,
        [six_axis_topic(), raw_topic()],
        metadata={"robot": {"serial": "2021"}},
        attachments=[Attachment("spec.yaml", "application/yaml", b"hil: 1\n")],
        joint_names=JOINTS,
    ) as writer:
        for begin in range(0, COUNT, 7):
            for topic, block in rows.items():
                writer.write(topic, block[begin : begin + 7])
        writer.write_event(EVENT)
    return path


def decoded(path: Path, topic: str) -> Iterator[Any]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        yield from (item.decoded_message for item in reader.iter_decoded_messages(topics=topic))


def with_rosbags(path: Path, topic: str) -> Iterator[Any]:
    with AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic == topic]
        for connection, _, raw in reader.messages(wanted):
            yield reader.deserialize(raw, connection.msgtype)


@pytest.mark.parametrize("read", [decoded, with_rosbags])
@pytest.mark.parametrize("topic", [STATE_TOPIC, "/can/raw"])
def test_independent_decoders_give_every_field_of_every_row(
    recording: Path, rows: dict[str, StructArray], read: Any, topic: str
) -> None:
    messages = list(read(recording, topic))
    assert len(messages) == COUNT
    for name in rows[topic].dtype.names or ():
        values = np.array([getattr(message, name) for message in messages])
        np.testing.assert_array_equal(values, rows[topic][name], err_msg=name)


@pytest.mark.parametrize("read", [decoded, with_rosbags])
def test_joint_states_are_a_copy_at_no_more_than_60_hz(
    recording: Path, rows: dict[str, StructArray], read: Any
) -> None:
    messages = list(read(recording, "/joint_states"))
    shown = rows[STATE_TOPIC][::3]  # 125 Hz / 3 = 42 Hz
    assert [list(message.name) for message in messages] == [JOINTS] * len(shown)
    for ours, theirs in (("q", "position"), ("qd", "velocity"), ("effort", "effort")):
        values = np.array([getattr(message, theirs) for message in messages])
        np.testing.assert_array_equal(values, shown[ours])
    stamps = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in messages]
    np.testing.assert_allclose(stamps, shown["host_time"], rtol=0, atol=1e-6)


@pytest.mark.parametrize("read", [decoded, with_rosbags])
def test_events_are_log_messages_with_the_event_as_json(recording: Path, read: Any) -> None:
    (message,) = read(recording, "/events")
    assert message.name == "checkpoint"
    assert json.loads(message.msg) == EVENT
    assert message.stamp.sec + message.stamp.nanosec * 1e-9 == pytest.approx(EVENT["t"], abs=1e-6)


def test_log_time_is_host_time_and_publish_time_is_device_time(
    recording: Path, rows: dict[str, StructArray]
) -> None:
    with recording.open("rb") as file:
        messages = [m for _, _, m in make_reader(file).iter_messages(topics=STATE_TOPIC)]
    state = rows[STATE_TOPIC]
    log_times = np.array([m.log_time for m in messages]) - EPOCH * 1e9
    np.testing.assert_allclose(log_times, (state["host_time"] - EPOCH) * 1e9, rtol=0, atol=256)
    publish_times = np.array([m.publish_time for m in messages])
    np.testing.assert_allclose(publish_times, state["device_time"] * 1e9, rtol=0, atol=1)
    assert [m.sequence for m in messages] == list(range(COUNT))


def test_what_explains_the_data_comes_before_it(recording: Path) -> None:
    with recording.open("rb") as file:
        kinds = [type(record).__name__ for record in StreamReader(file, emit_chunks=True).records]
    assert kinds[:4] == ["Header", "Metadata", "Metadata", "Attachment"]
    assert set(kinds[4 : kinds.index("Chunk")]) == {"Schema", "Channel"}


def test_profile_metadata_attachment_and_units_are_in_the_file(recording: Path) -> None:
    with recording.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {record.name: record.data for record in reader.iter_attachments()}
        summary = reader.get_summary()
    assert summary is not None
    state = next(c for c in summary.channels.values() if c.topic == STATE_TOPIC)
    assert metadata == {"hil": {"format_version": "1"}, "robot": {"serial": "2021"}}
    assert attachments == {"spec.yaml": b"hil: 1\n"}
    assert state.metadata["unit.q"] == "rad"
    assert state.metadata["schema_version"] == "1"
    assert float(state.metadata["rate_hz"]) == 125.0


def test_rows_without_host_time_are_logged_at_their_device_time(tmp_path: Path) -> None:
    topic = six_axis_topic()
    state = rows_of(topic, 3, first=125)
    state["host_time"] = np.nan
    with McapWriter(tmp_path / "00.mcap", [topic], joint_names=JOINTS) as writer:
        writer.write(STATE_TOPIC, state)
    with (tmp_path / "00.mcap").open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(topics=STATE_TOPIC)]
    assert times == [1_000_000_000, 1_008_000_000, 1_016_000_000]
