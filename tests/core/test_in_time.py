"""A bound on wall time: broken it never passes, and only a busy computer makes it a skip."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.support.in_time import TIMES, InTime, TooBusy, Took, measured_again

BURNS = "import os\nos.sched_setaffinity(0, {%d})\nprint('on', flush=True)\nwhile True:\n    pass"
CPU_S = 0.2


@pytest.fixture
def rivals() -> Iterator[list[int]]:
    """The pids of two processes that want the one core that this thread may use."""
    allowed = os.sched_getaffinity(0)
    core = min(allowed)
    with ExitStack() as stack:
        processes = []
        for _ in range(2):
            command = [sys.executable, "-c", BURNS % core]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            processes.append(stack.enter_context(process))
            stack.callback(process.kill)
            assert process.stdout is not None
            assert process.stdout.readline() == "on\n"
        stack.callback(os.sched_setaffinity, 0, allowed)
        os.sched_setaffinity(0, {core})
        yield [process.pid for process in processes]


def work() -> None:
    until = time.thread_time() + CPU_S
    while time.thread_time() < until:
        pass


def test_sleeps_and_locks_count_in_full() -> None:
    taken = threading.Lock()
    taken.acquire()
    asked = InTime()
    time.sleep(0.1)
    taken.acquire(timeout=0.1)
    with pytest.raises(AssertionError, match=r"took 0\.\d+ s, not less than 0\.1 s; waited"):
        asked.require(0.1)


@pytest.mark.thorough
def test_a_sleep_counts_in_full_while_others_wait_for_a_core(rivals: list[int]) -> None:
    for slept_s in (0.12, 0.2, 0.5):
        asked = InTime(*rivals)
        time.sleep(slept_s)
        took = asked.taken()
        assert took.passed_s >= slept_s
        with pytest.raises((AssertionError, TooBusy)):
            took.require(0.1)


def test_a_sleep_of_ours_is_never_excused(rivals: list[int]) -> None:
    asked = InTime()
    time.sleep(0.12)
    with pytest.raises(AssertionError, match="not less than"):
        asked.require(0.1)


@pytest.mark.thorough
def test_who_is_kept_from_a_core_is_too_late_and_nobody_knows_why(rivals: list[int]) -> None:
    asked, worked = InTime(), time.thread_time()
    work()
    worked = time.thread_time() - worked
    took = asked.taken()
    assert took.passed_s - took.waited_s == pytest.approx(worked, rel=0.2)
    with pytest.raises(TooBusy, match=r"too busy to tell: waited \d\.\d+ s for a core; took"):
        took.require(1.3 * CPU_S)
    with pytest.raises(AssertionError, match="not less than"):
        took.require(CPU_S / 2)  # more than it waited for is its own


def test_another_process_that_has_to_do_it_counts_too_and_who_looks_on_does_not(
    rivals: list[int],
) -> None:
    ours, all_of_it, theirs = InTime(), InTime(*rivals), InTime(*rivals, ours=False)
    work()
    ours_s, theirs_s = ours.taken().waited_s, theirs.taken().waited_s
    assert theirs_s > CPU_S / 2
    assert all_of_it.taken().waited_s == pytest.approx(ours_s + theirs_s, rel=0.2)


def test_of_a_process_that_has_ended_nothing_is_known() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    assert InTime(process.pid, ours=False).taken().waited_s == 0.0


def test_somebody_elses_time_is_judged_in_its_place() -> None:
    Took(3.0, 0.0).require(0.1, 0.09)
    with pytest.raises(AssertionError, match=r"took 0\.200 s"):
        Took(0.01, 0.0).require(0.1, 0.2)


def test_a_measurement_is_made_again_and_skipped_when_it_never_tells() -> None:
    waited = [0.0]

    @measured_again
    def busy(until: int) -> None:
        waited.append(0.3)
        Took(0.2 if len(waited) <= until else 0.05, waited[-1]).require(0.1)

    busy(until=TIMES)
    assert len(waited) == 1 + TIMES
    with pytest.raises(pytest.skip.Exception, match="this computer was too busy to tell"):
        busy(until=100)
    assert len(waited) == 1 + 2 * TIMES


def test_what_was_slow_by_itself_is_not_tried_again() -> None:
    tries = []

    @measured_again
    def slow() -> None:
        tries.append(1)
        Took(0.2, 0.01).require(0.1)

    with pytest.raises(AssertionError):
        slow()
    assert len(tries) == 1
