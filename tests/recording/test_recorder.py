"""The recorder thread: nothing is dropped, failures surface, falling behind shows."""

from __future__ import annotations

import errno
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hil.core.errors import RecordingError
from hil.core.typing import StructArray
from hil.recording import McapWriter, Recorder, read_info, read_topic
from hil.robot.state import STATE_TOPIC, Topic
from tests.support.recorded_rows import JOINTS, raw_topic, rows_of, six_axis_topic
from tests.support.waiting import until


class SlowDisk(McapWriter):
    """A writer that waits for permission before it writes."""

    def __init__(self, path: Path, topics: list[Topic]) -> None:
        super().__init__(path, topics)
        self.go_on = threading.Event()

    def write(self, topic: str, rows: StructArray) -> None:
        self.go_on.wait(10)
        super().write(topic, rows)


class FullDisk(McapWriter):
    """A writer whose disk is full from the second flush with data on."""

    full = False

    def flush(self, *, durable: bool) -> None:
        if self.full:
            with self._refusal_named():
                raise OSError(errno.ENOSPC, "No space left on device")
        super().flush(durable=durable)


@pytest.fixture
def slow(tmp_path: Path) -> Iterator[SlowDisk]:
    writer = SlowDisk(tmp_path / "00.mcap", [six_axis_topic(100.0)])
    yield writer
    writer.go_on.set()


def test_blocks_of_several_topics_arrive_complete_and_in_order(tmp_path: Path) -> None:
    topics = [six_axis_topic(), raw_topic()]
    rows = {topic.name: rows_of(topic, 1000) for topic in topics}
    writer = McapWriter(tmp_path / "00.mcap", topics, joint_names=JOINTS)
    with Recorder(writer, flush_interval_s=0.005) as recorder:
        for begin in range(0, 1000, 3):
            for name, block in rows.items():
                recorder.put(name, block[begin : begin + 3])
            recorder.put_event({"t": 1.0, "kind": "progress", "row": begin})
    for name, block in rows.items():
        assert read_topic(tmp_path / "00.mcap", name).tobytes() == block.tobytes()
    assert read_info(tmp_path / "00.mcap").topics["/events"].messages == 334


def test_a_driver_may_reuse_its_buffer_after_put(tmp_path: Path) -> None:
    topic = six_axis_topic()
    block = rows_of(topic, 5)
    expected = block.copy()
    with Recorder(McapWriter(tmp_path / "00.mcap", [topic])) as recorder:
        recorder.put(STATE_TOPIC, block)
        block["q"] = 0.0
    assert read_topic(tmp_path / "00.mcap").tobytes() == expected.tobytes()


def test_the_file_is_partial_until_it_is_closed(tmp_path: Path) -> None:
    topic = six_axis_topic()
    final, partial = tmp_path / "00.mcap", tmp_path / "00.mcap.partial"
    recorder = Recorder(McapWriter(final, [topic]))
    recorder.put(STATE_TOPIC, rows_of(topic, 5))
    assert partial.exists()
    assert not final.exists()
    recorder.close()
    assert final.exists()
    assert not partial.exists()


@pytest.mark.parametrize("name", ["00.mcap", "00.mcap.partial"])
def test_an_existing_recording_is_never_written_to(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"precious")
    with pytest.raises(RecordingError, match="exists already"):
        McapWriter(tmp_path / "00.mcap", [six_axis_topic()])
    assert (tmp_path / name).read_bytes() == b"precious"


def test_a_disk_that_falls_behind_raises_and_still_keeps_every_row(slow: SlowDisk) -> None:
    rows = rows_of(six_axis_topic(100.0), 300)
    recorder = Recorder(slow, backlog_limit_s=1.0)
    recorder.put(STATE_TOPIC, rows[:100])
    with pytest.raises(RecordingError, match="fallen behind by 101 rows"):
        recorder.put(STATE_TOPIC, rows[100:101])
    slow.go_on.set()
    recorder.close()
    assert read_topic(slow.path).tobytes() == rows[:101].tobytes()


def test_a_virtual_clock_waits_for_the_disk_instead(slow: SlowDisk) -> None:
    rows = rows_of(six_axis_topic(100.0), 150)
    recorder = Recorder(slow, backlog_limit_s=1.0, on_backlog="wait", flush_interval_s=0.01)
    threading.Timer(0.1, slow.go_on.set).start()
    recorder.put(STATE_TOPIC, rows)
    assert slow.go_on.is_set()
    assert recorder.backlog <= 100
    recorder.close()
    assert read_topic(slow.path).tobytes() == rows.tobytes()


def test_behind_is_how_long_the_oldest_unwritten_row_has_been_waiting(slow: SlowDisk) -> None:
    rows = rows_of(six_axis_topic(100.0), 20)
    recorder = Recorder(slow, flush_interval_s=0.01)
    assert recorder.behind_s == 0.0
    put_at = time.monotonic()
    recorder.put(STATE_TOPIC, rows[:10])
    time.sleep(0.15)
    recorder.put(STATE_TOPIC, rows[10:])
    assert 0.15 <= recorder.behind_s <= time.monotonic() - put_at
    slow.go_on.set()
    until(lambda: recorder.behind_s == 0.0)
    assert recorder.backlog == 0
    recorder.close()


def test_a_full_disk_surfaces_in_the_next_put_and_keeps_what_was_flushed(tmp_path: Path) -> None:
    topic = six_axis_topic()
    rows = rows_of(topic, 20)
    writer = FullDisk(tmp_path / "00.mcap", [topic])
    recorder = Recorder(writer, flush_interval_s=0.01)
    recorder.put(STATE_TOPIC, rows[:10])
    until(lambda: recorder.backlog == 0)
    time.sleep(0.05)
    writer.full = True
    recorder.put(STATE_TOPIC, rows[10:])
    with pytest.raises(RecordingError, match="No space left on device") as caught:
        until(lambda: recorder.put(STATE_TOPIC, rows[:0]))
    assert "free the disk" in caught.value.hint
    with pytest.raises(RecordingError, match="No space left on device"):
        recorder.close()
    assert read_topic(writer.partial_path, salvage=True).tobytes()[: rows[:10].nbytes] == (
        rows[:10].tobytes()
    )


def test_a_recorder_that_died_of_anything_says_so(tmp_path: Path) -> None:
    topic = six_axis_topic()
    writer = McapWriter(tmp_path / "00.mcap", [topic])
    recorder = Recorder(writer, flush_interval_s=0.01)
    writer.write_event = None  # type: ignore[method-assign, assignment]
    recorder.put_event({"t": 0.0, "kind": "state"})
    with pytest.raises(RecordingError, match="died: TypeError"):
        until(lambda: recorder.put(STATE_TOPIC, rows_of(topic, 0)))


def test_the_put_after_the_death_of_the_recorder_raises(tmp_path: Path) -> None:
    topic = six_axis_topic()
    writer = McapWriter(tmp_path / "00.mcap", [topic])
    recorder = Recorder(writer, flush_interval_s=0.01)
    writer.flush = lambda durable: sys.exit("killed")  # type: ignore[method-assign]
    recorder.put(STATE_TOPIC, rows_of(topic, 1))
    until(lambda: "hil-recorder" not in {thread.name for thread in threading.enumerate()})
    with pytest.raises(RecordingError, match="died: SystemExit"):
        recorder.put(STATE_TOPIC, rows_of(topic, 1))
    with pytest.raises(RecordingError, match="died: SystemExit"):
        recorder.close()


def test_a_put_that_waits_for_the_disk_hears_of_its_death(tmp_path: Path) -> None:
    topic = six_axis_topic(100.0)
    writer = FullDisk(tmp_path / "00.mcap", [topic])
    recorder = Recorder(writer, backlog_limit_s=1.0, on_backlog="wait", flush_interval_s=0.01)
    writer.full = True
    with pytest.raises(RecordingError, match="No space left on device"):
        recorder.put(STATE_TOPIC, rows_of(topic, 200))


def test_rows_of_another_dtype_or_topic_are_refused_at_once(tmp_path: Path) -> None:
    with Recorder(McapWriter(tmp_path / "00.mcap", [six_axis_topic()])) as recorder:
        with pytest.raises(RecordingError, match="rows of /robot/state are"):
            recorder.put(STATE_TOPIC, rows_of(raw_topic(), 1))
        with pytest.raises(RecordingError, match="no topic /can/raw"):
            recorder.put("/can/raw", rows_of(raw_topic(), 1))


def test_closing_twice_is_harmless_and_nothing_can_be_put_afterwards(tmp_path: Path) -> None:
    topic = six_axis_topic()
    recorder = Recorder(McapWriter(tmp_path / "00.mcap", [topic]))
    recorder.put(STATE_TOPIC, rows_of(topic, 4))
    assert recorder.close()[STATE_TOPIC].samples == 4
    assert recorder.close()[STATE_TOPIC].samples == 4
    with pytest.raises(RecordingError, match="is closed"):
        recorder.put(STATE_TOPIC, rows_of(topic, 1))


def counts_of(tmp_path: Path, rows: StructArray, rows_per_block: int) -> object:
    with Recorder(McapWriter(tmp_path / "00.mcap", [six_axis_topic()])) as recorder:
        for begin in range(0, len(rows), rows_per_block):
            recorder.put(STATE_TOPIC, rows[begin : begin + rows_per_block])
    counts = recorder.counts[STATE_TOPIC]
    names = ("samples", "gaps", "missing", "duplicates", "overruns")
    return tuple(getattr(counts, name) for name in names)


@pytest.mark.parametrize("rows_per_block", [1, 7, 100])
def test_gaps_and_duplicates_are_judged_by_the_device_clock(
    tmp_path: Path, rows_per_block: int
) -> None:
    rows = rows_of(six_axis_topic(), 100)
    rows = np.delete(rows, [20, 50, 51, 52])
    rows = np.insert(rows, 70, rows[70])
    assert counts_of(tmp_path, rows, rows_per_block) == (97, 2, 4, 1, 0)


def test_a_clock_that_goes_back_is_a_duplicate(tmp_path: Path) -> None:
    rows = rows_of(six_axis_topic(), 10)
    rows["device_time"][5] = rows["device_time"][3]
    assert counts_of(tmp_path, rows, 4) == (10, 1, 2, 1, 0)


def test_late_reception_without_loss_is_an_overrun(tmp_path: Path) -> None:
    rows = rows_of(six_axis_topic(), 30)
    rows["host_time"][12:] += 0.1
    assert counts_of(tmp_path, rows, 7) == (30, 0, 0, 0, 1)


def test_jitter_of_a_third_of_a_period_is_neither(tmp_path: Path) -> None:
    rows = rows_of(six_axis_topic(), 200)
    rows["device_time"] += np.random.default_rng(1).uniform(-0.16, 0.16, 200) / 125
    assert counts_of(tmp_path, rows, 9)[1:4] == (0, 0, 0)  # type: ignore[index]
