"""Run locks: one process holds a run, and death lets it go."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from hil.core import lock_file
from hil.core.errors import DataError, RecordingError
from hil.core.lock_file import hold_run, is_live, run_holder
from hil.recording.run_directory import RunDirectory
from hil.runs.listing import describe_run, run_listings
from tests.support.other_process import holding_run, other_process
from tests.support.waiting import until


def dead_within(run: Path, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while is_live(run) and time.monotonic() < deadline:
        time.sleep(0.005)
    return not is_live(run)


def lock_of_another_host(run: Path, age_s: float) -> None:
    (run / ".lock").write_text(json.dumps({"pid": 1, "host": "another-host"}))
    os.utime(run / ".lock", (time.time() - age_s,) * 2)


def no_locks(*arguments: Any) -> None:
    raise OSError(errno.ENOLCK, "No locks available")


def test_a_run_is_live_while_it_is_held_and_leaves_nothing(tmp_path: Path) -> None:
    with hold_run(tmp_path):
        assert is_live(tmp_path)
        held = json.loads((tmp_path / ".lock").read_text())
        assert held["pid"] == os.getpid()
        assert {"host", "since", "command", "user"} <= held.keys()
    assert not is_live(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_asking_makes_no_file(tmp_path: Path) -> None:
    assert not is_live(tmp_path)
    assert not is_live(tmp_path / "nowhere")
    assert list(tmp_path.iterdir()) == []


def test_nobody_holds_a_run_twice(tmp_path: Path) -> None:
    with (
        hold_run(tmp_path),
        pytest.raises(DataError, match=f"is active: it belongs to pid {os.getpid()}") as caught,
        hold_run(tmp_path),
    ):
        pass
    assert caught.value.hint == f"follow it with: hil watch {tmp_path}"


@pytest.mark.thorough
def test_those_who_look_keep_nobody_from_taking(tmp_path: Path) -> None:
    over = threading.Event()

    def look() -> None:
        while not over.is_set():
            is_live(tmp_path)

    lookers = [threading.Thread(target=look) for _ in range(2)]
    for looker in lookers:
        looker.start()
    try:
        for _ in range(100):
            with hold_run(tmp_path):
                pass
    finally:
        over.set()
        for looker in lookers:
            looker.join()


def test_a_run_that_cannot_be_locked_says_why(tmp_path: Path) -> None:
    with (
        pytest.raises(RecordingError, match=r"cannot lock .*: No such file"),
        hold_run(tmp_path / "gone"),
    ):
        pass


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", "\x00\x00"])
def test_what_a_crash_left_of_a_lock_holds_nothing(content: str, tmp_path: Path) -> None:
    (tmp_path / ".lock").write_text(content)
    assert not is_live(tmp_path)
    with hold_run(tmp_path):
        assert is_live(tmp_path)


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / ".lock").symlink_to(victim)
    with pytest.raises(RecordingError), hold_run(tmp_path):
        pass
    assert victim.read_text() == "precious"


def test_of_another_host_the_heartbeat_tells(tmp_path: Path) -> None:
    lock_of_another_host(tmp_path, age_s=2.0)
    holder = run_holder(tmp_path)
    assert holder is not None
    assert str(holder) == "pid 1 on another-host"
    with pytest.raises(DataError, match="another-host"), hold_run(tmp_path):
        pass
    lock_of_another_host(tmp_path, age_s=60.0)
    assert not is_live(tmp_path)
    with hold_run(tmp_path):
        assert is_live(tmp_path)


def test_heartbeat_from_the_future_is_no_sign_of_life(tmp_path: Path) -> None:
    """A clock that was wrong must not keep a run until its time comes true."""
    lock_of_another_host(tmp_path, age_s=-3600.0)
    assert not is_live(tmp_path)
    lock_of_another_host(tmp_path, age_s=-2.0)  # clocks of two hosts are never quite the same
    assert is_live(tmp_path)


def test_without_locks_the_heartbeat_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fcntl, "flock", no_locks)
    monkeypatch.setattr(lock_file, "HEARTBEAT_S", 0.02)
    with hold_run(tmp_path):
        os.utime(tmp_path / ".lock", (0, 0))
        until(lambda: is_live(tmp_path))
        with pytest.raises(DataError), hold_run(tmp_path):
            pass
    assert not is_live(tmp_path)
    with hold_run(tmp_path):
        pass


def test_a_live_run_is_listed_as_running_before_and_after_it_has_a_start_document(
    tmp_path: Path,
) -> None:
    run = RunDirectory.create(tmp_path, "ur5", "dwell")
    with hold_run(run.path):
        (begun,) = run_listings(tmp_path)
        run.write_start({"uid": "u-1"})
        (going,) = run_listings(tmp_path)
        assert describe_run(run.path)["status"] == "running"
    (over,) = run_listings(tmp_path)
    assert (begun.status, begun.uid, begun.problem) == ("running", "", "")
    assert (going.status, going.uid) == ("running", "u-1")
    assert over.status == "interrupted"


@pytest.mark.wire
def test_kill_9_lets_a_run_go_at_once(tmp_path: Path) -> None:
    with other_process(holding_run(tmp_path)) as process:
        holder = run_holder(tmp_path)
        assert holder is not None
        assert holder.pid == process.pid
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert dead_within(tmp_path, 0.1)
        with hold_run(tmp_path):
            pass


CHILDREN = """
import multiprocessing, subprocess, sys, time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from hil.core.parallel import processes
from hil.core.lock_file import hold_run

if __name__ == "__main__":
    with hold_run(Path(sys.argv[1])):
        sleeper = subprocess.Popen(["sleep", "20"])
        forked = multiprocessing.get_context("fork").Process(target=time.sleep, args=(20,))
        forked.start()
        pool = processes(1)
        spawned = pool.submit(abs, -1)
        spawned.result()
        (worker,) = pool._processes
        print(sleeper.pid, forked.pid, worker, flush=True)
        time.sleep(20)
"""


@pytest.mark.wire
def test_children_that_outlive_the_holder_do_not_hold_its_run(tmp_path: Path) -> None:
    script, run = tmp_path / "children.py", tmp_path / "run"
    script.write_text(CHILDREN)
    run.mkdir()
    with subprocess.Popen(
        [sys.executable, script, run], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        children = [int(pid) for pid in process.stdout.readline().split()]
        assert len(children) == 3
        assert is_live(run)
        process.kill()
        process.wait()
        try:
            assert dead_within(run, 0.1)
            for child in children[:2]:
                os.kill(child, 0)  # still there, and without the lock
        finally:
            for child in children:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)


FORKED = """
import os
from pathlib import Path
from hil.core.lock_file import hold
held = hold(Path({path!r}), {{"host": "here"}})
if os.fork() == 0:
    held.release()
    os._exit(0)
os.wait()
print("ready", flush=True)
input()
"""


@pytest.mark.wire
def test_a_forked_child_does_not_free_what_its_parent_holds(tmp_path: Path) -> None:
    with other_process(FORKED.format(path=str(tmp_path / ".lock"))):
        assert is_live(tmp_path)
        assert (tmp_path / ".lock").exists()
