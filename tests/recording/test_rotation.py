"""Long recordings go on in further parts: no row lost or doubled, every part whole by itself."""

from __future__ import annotations

import errno
import inspect
import threading
import time
from collections.abc import Callable
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
from hil.robot.state import STATE_TOPIC
from tests.support.recorded_rows import JOINTS, raw_topic, rows_of, six_axis_topic
from tests.support.waiting import until

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
