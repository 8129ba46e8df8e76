"""What we record opens in the field's own readers, with equal values."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from hil.core.typing import StructArray
from hil.recording import Attachment, McapWriter
from hil.robot.state import STATE_TOPIC
from tests.support.recorded_rows import EPOCH, JOINTS, raw_topic, rows_of, six_axis_topic

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
