"""The PC's heartbeat: what ends it, and what does not."""

from __future__ import annotations

import threading
import time

from hil.core.errors import HilError, RobotConnectionError, RobotTimeout
from hil_drivers.twincat.controller import Beat


def beaten(*problems: HilError | None, wanted: int) -> tuple[Beat, list[int]]:
    """A beat whose writes fail in turn with these; it is ended after so many of them, or 10 s."""
    counts, enough, left = [], threading.Event(), list(problems)

    def write(session: int, count: int) -> None:
        counts.append(count)
        if len(counts) >= wanted:
            enough.set()
        if left and (problem := left.pop(0)) is not None:
            raise problem

    beat = Beat(write, 7)
    beat.start()
    assert enough.wait(10.0)
    time.sleep(0.01)
    return beat, counts


def test_every_beat_has_another_count() -> None:
    beat, counts = beaten(wanted=3)
    assert beat.alive
    beat.end()
    assert counts[:3] == [1, 2, 3]
    assert not beat.alive


def test_a_beat_without_an_answer_is_followed_by_the_next() -> None:
    late = RobotTimeout("the PLC is busy")
    beat, counts = beaten(late, wanted=2)
    assert beat.alive
    assert beat.problem is late
    beat.end()
    assert len(counts) >= 2


def test_a_lost_connection_ends_the_heartbeat_and_is_kept_as_the_reason() -> None:
    lost = RobotConnectionError("the cable is out")
    beat, counts = beaten(None, lost, wanted=2)
    beat._thread.join(10.0)
    assert not beat.alive
    assert beat.problem is lost
    assert len(counts) == 2


def test_a_hushed_heartbeat_writes_nothing_more() -> None:
    beat, counts = beaten(wanted=1)
    beat.silence()
    beat._thread.join(10.0)
    told = len(counts)
    assert not beat.alive
    time.sleep(0.06)
    assert len(counts) == told
