"""The columnar reader gives back what was written, bit for bit, from any MCAP layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from hil.core.errors import DataError
from hil.recording import Attachment, McapWriter, read_info, read_topic
from hil.robot.state import CDR_HEADER, STATE_TOPIC
from tests.support.recorded_rows import JOINTS, raw_topic, record_state, rows_of, six_axis_topic


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
        with pytest.raises(DataError, match="format_version is 2, known here up to 1") as caught:
            read(tmp_path / "00.mcap")
        assert "update hil" in caught.value.hint


def test_record_of_a_newer_schema_is_refused(tmp_path: Path) -> None:
    from dataclasses import replace

    newer = replace(six_axis_topic(), schema_version=2)
    with McapWriter(tmp_path / "00.mcap", [newer]) as writer:
        writer.write(STATE_TOPIC, rows_of(newer, 3))
    with pytest.raises(DataError, match="schema_version is 2, known here up to 1"):
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
