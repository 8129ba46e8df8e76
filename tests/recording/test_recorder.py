"""The recorder: nothing is dropped, parts follow each other, and death loses nothing flushed."""

from __future__ import annotations

import errno
import inspect
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, cast
from unittest.mock import create_autospec

import numpy as np
import pytest

from hil.core.errors import RecordingError
from hil.core.typing import StructArray
from hil.recording import Attachment, McapWriter, Recorder, read_info, read_topic
from hil.recording.recorder import DiskThread
from hil.recording.recording_files import part_name, recordings_in
from hil.robot.state import STATE_TOPIC, Topic
from tests.support.recorded_rows import JOINTS, raw_topic, rows_of, six_axis_topic
from tests.support.waiting import until

# The recorder thread: nothing is dropped, failures surface, falling behind shows


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
    assert "free space on the disk" in caught.value.hint
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


# What is kept when the process is killed, and when the disk is slow or refuses


CHILD = """
import mmap, os, struct, sys, time
from pathlib import Path
from hil.recording import McapWriter, Recorder
from hil.robot import STATE_TOPIC, state_topic
from hil.recording.recording_files import part_name

folder, slow, rotate = Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3])
topic = state_topic(6, 500.0, clock="host", effort_unit="A")

def open_part(part):
    return McapWriter(folder / part_name(0, part), [topic], joint_names=list("abcdef"))

writer = open_part(0)
if slow:
    fsync = os.fsync
    os.fsync = lambda descriptor: (time.sleep(slow), fsync(descriptor))
recorder = Recorder(writer, next_part=open_part, rotate_bytes=rotate)
with open(folder / "last_put", "r+b") as file:
    last_put = mmap.mmap(file.fileno(), 8)
number = 0
while True:
    block = topic.blank(1)
    block["device_time"] = block["host_time"] = now = time.time()
    block["segment"] = number
    recorder.put(STATE_TOPIC, block)
    last_put[:] = struct.pack("d", now)
    number += 1
    time.sleep(0.002)
"""


@pytest.mark.wire
@pytest.mark.parametrize(
    ("seconds", "fsync_s", "rotate_bytes"),
    [(0.83, 0.0, 1e9), (1.2, 0.5, 1e9), (1.47, 0.5, 1e9), (2.3, 0.0, 1e4), (3.1, 0.5, 1e4)],
    ids=["early", "slow disk", "slow disk, later", "many parts", "parts on a slow disk"],
)
def test_kill_9_loses_a_quarter_second_at_most(
    tmp_path: Path, seconds: float, fsync_s: float, rotate_bytes: float
) -> None:
    last_put = tmp_path / "last_put"
    last_put.write_bytes(bytes(8))
    arguments = [str(tmp_path), str(fsync_s), str(rotate_bytes)]
    with subprocess.Popen([sys.executable, "-c", CHILD, *arguments]) as child:
        until(lambda: any(last_put.read_bytes()), within_s=30)
        time.sleep(seconds)
        os.kill(child.pid, signal.SIGKILL)
    parts = recordings_in(tmp_path)
    rows = np.concatenate([read_topic(path, salvage=True) for path in parts])
    assert rows["segment"].tolist() == list(range(len(rows)))
    (put_until,) = struct.unpack("d", last_put.read_bytes())
    assert put_until - rows["host_time"][-1] <= 0.25
    assert len(parts) > 1 or rotate_bytes == 1e9


def test_rows_reach_the_kernel_while_an_fsync_does_not_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = six_axis_topic()
    writer = McapWriter(tmp_path / "00.mcap", [topic])
    fsync, calls, go_on = os.fsync, [], threading.Event()  # type: ignore[var-annotated]

    def hanging(descriptor: int) -> None:
        calls.append(descriptor)
        go_on.wait(10)
        fsync(descriptor)

    monkeypatch.setattr("os.fsync", hanging)
    rows = rows_of(topic, 30)
    with Recorder(writer, flush_interval_s=0.01, fsync_interval_s=0.01) as recorder:
        recorder.put(STATE_TOPIC, rows[:10])
        until(lambda: calls)
        recorder.put(STATE_TOPIC, rows[10:])
        until(lambda: recorder.behind_s == 0.0)
        assert read_topic(writer.partial_path, salvage=True).tobytes() == rows.tobytes()
        go_on.set()


def test_an_fsync_that_fails_reaches_put_and_close_and_every_row_is_still_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = six_axis_topic()
    writer = McapWriter(tmp_path / "00.mcap", [topic])
    recorder = Recorder(writer, flush_interval_s=0.01, fsync_interval_s=0.01)

    def broken(descriptor: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("os.fsync", broken)
    rows = rows_of(topic, 30)
    recorder.put(STATE_TOPIC, rows[:10])
    with pytest.raises(RecordingError, match="Input/output error"):
        until(lambda: recorder.put(STATE_TOPIC, rows[:0]))
    with pytest.raises(RecordingError, match="Input/output error"):
        recorder.put(STATE_TOPIC, rows[10:])
    with pytest.raises(RecordingError, match="Input/output error"):
        recorder.close()
    assert read_topic(writer.partial_path, salvage=True).tobytes() == rows.tobytes()


def test_close_waits_until_the_disk_has_the_whole_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = six_axis_topic()
    writer = McapWriter(tmp_path / "00.mcap", [topic])
    fsync, synced = os.fsync, {}  # type: ignore[var-annotated]

    def slow(descriptor: int) -> None:
        status = os.fstat(descriptor)
        time.sleep(0.1)
        fsync(descriptor)
        synced[status.st_ino] = status.st_size

    monkeypatch.setattr("os.fsync", slow)
    recorder = Recorder(writer, fsync_interval_s=float("inf"))
    recorder.put(STATE_TOPIC, rows_of(topic, 100))
    recorder.close()
    status = (tmp_path / "00.mcap").stat()
    assert synced[status.st_ino] == status.st_size


def test_a_disk_that_hangs_ends_closing_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    topic = six_axis_topic()
    writer = McapWriter(tmp_path / "00.mcap", [topic])
    go_on = threading.Event()
    monkeypatch.setattr("os.fsync", lambda descriptor: go_on.wait(10))
    recorder = Recorder(writer, flush_interval_s=0.01)
    recorder.put(STATE_TOPIC, rows_of(topic, 10))
    with pytest.raises(RecordingError, match=r"could not be finished within 0\.1 s"):
        recorder.close(timeout_s=0.1)
    assert len(read_topic(writer.partial_path, salvage=True)) == 10
    go_on.set()
    assert len(recorder.close()) == 1


# Long recordings go on in further parts: no row lost or doubled, every part whole by itself


TOPICS = [six_axis_topic(), raw_topic()]
PLAN = Attachment("plan.json", "application/json", b"{}")


def opener(folder: Path) -> Callable[[int], McapWriter]:
    def open_part(part: int) -> McapWriter:
        return McapWriter(
            folder / part_name(0, part),
            TOPICS,
            metadata={"part": {"attempt": "0", "part": str(part)}},
            attachments=[PLAN],
            joint_names=JOINTS,
        )

    return open_part


def rotating(folder: Path, **more: object) -> Recorder:
    open_part = opener(folder)
    options = {"next_part": open_part, "rotate_bytes": 60_000.0, "flush_interval_s": 0.005} | more
    return Recorder(open_part(0), **options)  # type: ignore[arg-type]


def record_parts(folder: Path, rows: StructArray) -> Recorder:
    """Put all rows, slowly enough that several parts come to be."""
    with rotating(folder) as recorder:
        for begin in range(0, len(rows), 50):
            recorder.put(STATE_TOPIC, rows[begin : begin + 50])
            recorder.put_event({"t": 1.0, "kind": "progress", "row": begin})
            until(lambda: recorder.backlog == 0)
    return recorder


def test_parts_together_hold_every_row_once_and_in_order(tmp_path: Path) -> None:
    rows = rows_of(TOPICS[0], 5000)
    record_parts(tmp_path, rows)
    parts = recordings_in(tmp_path)
    assert len(parts) >= 4
    assert [path.name for path in parts] == [part_name(0, part) for part in range(len(parts))]
    together = b"".join(read_topic(path).tobytes() for path in parts)
    assert together == rows.tobytes()
    assert sum(read_info(path).topics["/events"].messages for path in parts) == 100


def test_every_part_is_complete_and_says_what_it_is_and_which(tmp_path: Path) -> None:
    record_parts(tmp_path, rows_of(TOPICS[0], 5000))
    for number, path in enumerate(recordings_in(tmp_path)):
        info = read_info(path)
        assert info.complete
        assert info.metadata["part"] == {"attempt": "0", "part": str(number)}
        assert info.attachments["plan.json"].data == PLAN.data
        assert {STATE_TOPIC, "/can/raw", "/events", "/joint_states"} <= info.topics.keys()


def test_counts_go_on_over_the_seams(tmp_path: Path) -> None:
    rows = np.delete(rows_of(TOPICS[0], 5000), [700, 3200, 3201])
    counts = record_parts(tmp_path, rows).counts[STATE_TOPIC]
    assert len(recordings_in(tmp_path)) >= 4
    assert (counts.samples, counts.gaps, counts.missing, counts.duplicates) == (4997, 2, 3, 0)
    assert counts.first_time == rows["device_time"][0]


def test_a_part_ends_soon_after_it_is_full(tmp_path: Path) -> None:
    record_parts(tmp_path, rows_of(TOPICS[0], 5000))
    sizes = [path.stat().st_size for path in recordings_in(tmp_path)]
    assert min(sizes[:-1]) >= 60_000


def test_without_a_limit_there_is_one_part(tmp_path: Path) -> None:
    with rotating(tmp_path, rotate_bytes=None) as recorder:
        for _ in range(20):
            recorder.put(STATE_TOPIC, rows_of(TOPICS[0], 100))
            time.sleep(0.006)
    assert [path.name for path in recordings_in(tmp_path)] == ["00.mcap"]


def test_writing_goes_on_while_the_next_part_is_slow_to_open(tmp_path: Path) -> None:
    open_part, go_on = opener(tmp_path), threading.Event()

    def slowly(part: int) -> McapWriter:
        go_on.wait(10)
        return open_part(part)

    rows = rows_of(TOPICS[0], 2000)
    with rotating(tmp_path, next_part=slowly, rotate_bytes=1.0) as recorder:
        recorder.put(STATE_TOPIC, rows[:1000])
        until(lambda: recorder.backlog == 0)
        recorder.put(STATE_TOPIC, rows[1000:])
        until(lambda: recorder.backlog == 0)
        assert [path.name for path in recordings_in(tmp_path)] == ["00.mcap.partial"]
        go_on.set()
    assert read_topic(tmp_path / "00.mcap").tobytes() == rows.tobytes()


def test_writing_goes_on_while_a_part_is_slow_to_finish(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish, go_on = McapWriter.finish, threading.Event()

    def slowly(writer: McapWriter) -> None:
        go_on.wait(10)
        finish(writer)

    monkeypatch.setattr(McapWriter, "finish", slowly)
    rows = rows_of(TOPICS[0], 2000)
    with rotating(tmp_path, rotate_bytes=200_000.0) as recorder:
        recorder.put(STATE_TOPIC, rows[:1000])
        until(lambda: len(recordings_in(tmp_path)) == 2)
        recorder.put(STATE_TOPIC, rows[1000:])
        until(lambda: recorder.backlog == 0)
        names = {path.name for path in recordings_in(tmp_path)}
        assert {"00.mcap.partial", "00.001.mcap.partial"} <= names
        go_on.set()
    together = b"".join(read_topic(path).tobytes() for path in recordings_in(tmp_path))
    assert together == rows.tobytes()


def test_a_part_that_cannot_be_opened_stops_the_run_and_keeps_every_row(tmp_path: Path) -> None:
    (tmp_path / "00.001.mcap").write_bytes(b"precious")
    rows = rows_of(TOPICS[0], 1000)
    recorder = rotating(tmp_path, rotate_bytes=1.0)
    recorder.put(STATE_TOPIC, rows)
    with pytest.raises(RecordingError, match="exists already"):
        until(lambda: recorder.put(STATE_TOPIC, rows[:0]))
    with pytest.raises(RecordingError, match="exists already"):
        recorder.put(STATE_TOPIC, rows[:10])  # what is put while the robot comes to rest is kept
    with pytest.raises(RecordingError, match="exists already"):
        recorder.close()
    assert (tmp_path / "00.001.mcap").read_bytes() == b"precious"
    kept = read_topic(tmp_path / "00.mcap.partial", salvage=True)
    assert kept.tobytes() == rows.tobytes() + rows[:10].tobytes()


def test_a_part_that_was_opened_in_vain_is_removed(tmp_path: Path) -> None:
    open_part, problems = opener(tmp_path), []  # type: ignore[var-annotated]
    writer = open_part(0)
    disk = DiskThread(writer, open_part, 0.1, problems.append)
    assert disk.part_after(writer) is None
    until(lambda: (tmp_path / "00.001.mcap.partial").exists())
    disk.finish()
    assert disk.join(10)
    assert problems == []
    assert [path.name for path in tmp_path.iterdir()] == ["00.mcap"]


def test_no_part_is_opened_in_vain_whenever_the_last_one_is_taken() -> None:
    """A part is taken after every possible number of the disk thread's own steps."""
    first = create_autospec(McapWriter, instance=True)
    opened: list[int] = []
    taken = steps = 0

    def open_part(part: int) -> McapWriter:
        opened.append(part)
        return cast("McapWriter", first)

    def take(frame: FrameType, event: str, _: object) -> Any:
        nonlocal taken, steps
        if frame.f_code.co_filename != inspect.getfile(DiskThread):
            return None
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if event == "opcode" and len(opened) > taken:
            steps += 1
            if steps > taken and disk.part_after(first) is not None:
                taken, steps = taken + 1, 0
        return take

    before = threading.gettrace()
    threading.settrace(take)
    try:
        disk = DiskThread(first, open_part, 0.0005, opened.append)  # type: ignore[arg-type]
    finally:
        threading.settrace(before)  # type: ignore[arg-type]
    for wish in range(1, 150):
        disk.part_after(first)
        until(lambda wish=wish: taken >= wish)  # type: ignore[misc]
        time.sleep(0.002)
        assert opened == list(range(1, wish + 1))
    disk.abandon()
    assert disk.join(10)


def test_a_part_has_its_explanations_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    rename = Path.rename

    def looked_at(path: Path, target: Path) -> Path:
        seen.append((read_info(path).attachments.keys(), Path(target).name, Path(target).exists()))
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", looked_at)
    opener(tmp_path)(3).abandon()
    assert seen == [({"plan.json"}, "00.003.mcap.partial", False)]


def test_a_disk_that_refuses_the_explanations_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(RecordingError, match="No space left on device"):
        opener(tmp_path)(0)
    assert list(tmp_path.iterdir()) == []
