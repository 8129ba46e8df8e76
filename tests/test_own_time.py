"""What is taken off a wall time: waiting for a core, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest
from own_time import OwnTime

BURNS = "import os\nos.sched_setaffinity(0, {%d})\nprint('on', flush=True)\nwhile True:\n    pass"
CPU_S = 0.2


@pytest.fixture
def rival() -> Iterator[int]:
    """The pid of a process that wants the one core that this thread may use."""
    allowed = os.sched_getaffinity(0)
    core = min(allowed)
    command = [sys.executable, "-c", BURNS % core]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "on\n"
        os.sched_setaffinity(0, {core})
        try:
            yield process.pid
        finally:
            os.sched_setaffinity(0, allowed)
            process.kill()


def work() -> None:
    until = time.thread_time() + CPU_S
    while time.thread_time() < until:
        pass


def test_sleeps_and_locks_count_in_full() -> None:
    taken = threading.Lock()
    taken.acquire()
    own = OwnTime()
    time.sleep(0.1)
    taken.acquire(timeout=0.1)
    assert own.passed_s > 0.19


def test_time_that_another_had_the_core_does_not_count(rival: int) -> None:
    own, worked = OwnTime(), time.thread_time()
    work()
    worked = time.thread_time() - worked
    assert time.monotonic() - own.at > 1.3 * CPU_S
    assert own.passed_s == pytest.approx(worked, rel=0.1)


def test_of_another_process_that_is_waited_for_it_does_not_count_either(rival: int) -> None:
    ours, all_of_it = OwnTime(), OwnTime(rival)
    work()
    assert all_of_it.hindered_s > ours.hindered_s + CPU_S / 2


def test_of_a_process_that_has_ended_nothing_is_taken_off() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    own = OwnTime(process.pid)
    time.sleep(0.05)
    assert own.passed_s > 0.045
