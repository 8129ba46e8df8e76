"""What is kept when the process is killed, and when the disk is slow or refuses."""

from __future__ import annotations

import errno
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from hil.core.errors import RecordingError
from hil.recording import McapWriter, Recorder, read_topic
from hil.recording.recording_files import recordings_in
from hil.robot.state import STATE_TOPIC
from tests.support.recorded_rows import rows_of, six_axis_topic
from tests.support.waiting import until

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
