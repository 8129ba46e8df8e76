"""A recording that is being written is nobody's torn file, whether a run holds it or not."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import DataError, RecordingError
from hil.recording import McapWriter, Recorder, RunDirectory, read_info, read_topic
from hil.recording.recovery import recover, recover_file
from hil.robot.state import STATE_TOPIC
from tests.support.paths import ROOT
from tests.support.recorded_rows import rows_of, six_axis_topic

TOPIC = six_axis_topic()
ROWS = rows_of(TOPIC, 200)

RECORDING = """
import subprocess, sys
from pathlib import Path
from tests.support.recorded_rows import rows_of, six_axis_topic
from hil.recording import McapWriter
from hil.robot import STATE_TOPIC
writer = McapWriter(Path(sys.argv[1]), [six_axis_topic()])
writer.write(STATE_TOPIC, rows_of(six_axis_topic(), 200))
writer.flush(durable=False)
child = [sys.executable, "-c", "import sys; sys.stdin.read()"]  # lives on until the pipe closes
subprocess.Popen(child, close_fds=False, stdout=subprocess.DEVNULL)
print("recording", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("discard", [False, True])
def test_recording_that_goes_on_is_refused_and_loses_nothing(tmp_path: Path, discard: bool) -> None:
    with Recorder(McapWriter(tmp_path / "x.mcap", [TOPIC]), flush_interval_s=0.005) as recorder:
        recorder.put(STATE_TOPIC, ROWS[:100])
        while recorder.backlog:
            time.sleep(0.002)
        with pytest.raises(DataError, match=r"x.mcap.partial is not torn: it is being written"):
            recover(tmp_path / "x.mcap.partial", discard=discard)
        recorder.put(STATE_TOPIC, ROWS[100:])
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]
    assert read_topic(tmp_path / "x.mcap").tobytes() == ROWS.tobytes()


def test_recording_that_was_given_up_can_be_recovered_at_once(tmp_path: Path) -> None:
    writer = McapWriter(tmp_path / "x.mcap", [TOPIC])
    writer.write(STATE_TOPIC, ROWS)
    writer.flush(durable=False)
    writer.abandon()
    assert recover(writer.partial_path).files[0].did == "rebuilt"


@pytest.mark.wire
def test_recording_of_another_process_is_refused_until_that_is_dead(tmp_path: Path) -> None:
    """Whatever programs it has started live on."""
    path = tmp_path / "x.mcap"
    command = [sys.executable, "-c", RECORDING, str(path)]
    tests = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "env": tests}
    with subprocess.Popen(command, **pipes) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"recording\n"
        with pytest.raises(DataError, match="being written"):
            recover(path.with_name("x.mcap.partial"))
        child.kill()
        child.wait()
        assert recover(path.with_name("x.mcap.partial")).files[0].did == "rebuilt"
    assert read_topic(path).tobytes() == ROWS.tobytes()


def test_file_systems_without_locks_are_recorded_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with McapWriter(tmp_path / "x.mcap", [TOPIC]) as writer:
        writer.write(STATE_TOPIC, ROWS)
    assert read_info(tmp_path / "x.mcap").complete


def test_recording_finished_in_the_instant_it_was_looked_at_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = McapWriter(tmp_path / "x.mcap", [TOPIC])
    writer.write(STATE_TOPIC, ROWS)
    lock = fcntl.flock

    def finished_just_before(*arguments: Any) -> None:
        monkeypatch.setattr(fcntl, "flock", lock)
        writer.finish()
        lock(*arguments)

    monkeypatch.setattr(fcntl, "flock", finished_just_before)
    with pytest.raises(DataError):
        recover_file(writer.partial_path, discard=True)
    assert [path.name for path in tmp_path.iterdir()] == ["x.mcap"]


def test_checksums_leave_out_what_a_hanging_disk_has_not_let_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "test")
    run.write_start({"uid": "u"})
    fsync, go_on = os.fsync, threading.Event()

    def hanging(descriptor: int) -> None:
        if threading.current_thread().name == "hil-disk":
            go_on.wait(20)
        fsync(descriptor)

    recorder = Recorder(McapWriter(run.part_path(0), [TOPIC]), fsync_interval_s=0.01)
    monkeypatch.setattr(os, "fsync", hanging)
    recorder.put(STATE_TOPIC, ROWS)
    with pytest.raises(RecordingError, match="could not be finished"):
        recorder.close(timeout_s=0.3)
    run.write_stop("failed", "the disk hangs")
    go_on.set()
    recorder.close(timeout_s=10)
    assert [path.name for path in run.recordings] == ["00.mcap"]
    assert list((run.stop or {})["sha256"]) == ["start.json"]
    assert run.verify() == []


def test_checksums_have_what_was_given_up(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "test")
    run.write_start({"uid": "u"})
    McapWriter(run.part_path(0), [TOPIC]).abandon()
    run.write_stop("failed", "the disk was full")
    assert list((run.stop or {})["sha256"]) == ["recording/00.mcap.partial", "start.json"]
