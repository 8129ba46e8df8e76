"""Interlocks on the recording: a recorder that falls behind, a disk that fills up or hangs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hil.engine.interlocks import Backlog, FreeSpace, InterlockContext, interlocks_from_spec
from hil.planning import load
from hil.workflow.interlocks import RunInterlocks
from hil.workflow.preview import planned
from tests.support.interlock_parts import NAMES, made, rows, spec_of
from tests.support.waiting import until

BLOCK = rows()
HERE = Path
MB = 1_000_000


class Clock:
    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def disk() -> Iterator[Callable[..., FreeSpace]]:
    """Makes disk interlocks that look every 5 ms, and ends them."""
    made: list[FreeSpace] = []

    def make(free: Callable[[Path], int], **more: Any) -> FreeSpace:
        made.append(FreeSpace(HERE, 500.0, free=free, poll_s=0.005, **more))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_recorder_that_falls_behind_trips_and_is_clear_when_it_has_caught_up() -> None:
    behind = [0.1]
    interlock = Backlog(lambda: behind[0], 2.0, action="pause")
    assert interlock.check(BLOCK) is None
    behind[0] = 2.5
    trip = interlock.check(BLOCK)
    assert trip is not None
    assert trip.text(NAMES).startswith(
        "interlock recorder: backlog of the recorder at 2.5 s, limit 2 s"
    )
    assert trip.joint == -1
    behind[0] = 1.5
    assert not interlock.clear(BLOCK)
    behind[0] = 0.9
    assert interlock.clear(BLOCK)


def test_a_robot_that_waits_for_the_recorder_needs_no_watch_over_it() -> None:
    for context in (
        InterlockContext(behind_s=lambda: 9.0, clock="virtual"),
        InterlockContext(behind_s=None, clock="wall"),
    ):
        interlocks = interlocks_from_spec([spec_of(kind="recorder")], context)
        assert [off.name for off in interlocks.off] == ["recorder"]
    wall = InterlockContext(behind_s=lambda: 9.0, clock="wall")
    assert made(wall, kind="recorder", behind_s=1).check(BLOCK) is not None


def test_a_disk_that_fills_up_trips_within_a_poll(disk: Any) -> None:
    free = [501 * MB]
    interlock = disk(lambda folder: free[0])
    assert interlock.check(BLOCK) is None
    free[0] = 499 * MB
    until(lambda: interlock.check(BLOCK))
    trip = interlock.check(BLOCK)
    assert trip is not None
    assert "free space for . at 499 MB, at least 500 MB" in trip.text(NAMES)


def test_a_full_disk_trips_with_the_first_check(disk: Any) -> None:
    assert disk(lambda folder: 10 * MB).check(BLOCK) is not None


def test_a_disk_is_clear_again_with_a_fifth_more_than_the_least(disk: Any) -> None:
    free = [550 * MB]
    interlock = disk(lambda folder: free[0], action="pause")
    assert not interlock.clear(BLOCK)
    free[0] = 601 * MB
    until(lambda: interlock.clear(BLOCK))


def test_a_disk_that_hangs_is_never_waited_for_and_trips_after_ten_seconds(disk: Any) -> None:
    hang, clock = threading.Event(), Clock()

    def hanging(folder: Path) -> int:
        hang.wait(20.0)
        return 900 * MB

    interlock = disk(hanging, now=clock)
    begin = time.monotonic()
    for seconds in (0.0, 4.0, 5.9):
        clock.time += seconds
        assert interlock.check(BLOCK) is None
    clock.time += 0.2
    trip = interlock.check(BLOCK)
    assert time.monotonic() - begin < 1.0
    assert trip is not None
    assert "free space for . not measured" in trip.text(NAMES)
    hang.set()
    until(lambda: interlock.check(BLOCK) is None)


def test_a_disk_that_refuses_to_answer_trips_too(disk: Any) -> None:
    clock = Clock()

    def gone(folder: Path) -> int:
        raise OSError("stale file handle")

    interlock = disk(gone, now=clock)
    assert interlock.check(BLOCK) is None
    clock.time += 10.1
    assert interlock.check(BLOCK) is not None


def test_the_control_thread_never_asks_the_disk(disk: Any) -> None:
    threads: set[str] = set()

    def noting(folder: Path) -> int:
        threads.add(threading.current_thread().name)
        return 900 * MB

    interlock = disk(noting)
    for _ in range(20):
        interlock.check(BLOCK)
        time.sleep(0.001)
    assert threads == {"hil-free-space"}


def test_the_disk_is_asked_about_once_a_second() -> None:
    asked = 0

    def counting(folder: Path) -> int:
        nonlocal asked
        asked += 1
        return 900 * MB

    interlock = FreeSpace(HERE, 500.0, free=counting)
    end = time.monotonic() + 0.3
    while time.monotonic() < end:
        interlock.check(BLOCK)
    interlock.close()
    assert asked == 1


def test_closing_ends_the_thread_and_nothing_begins_before_the_first_check() -> None:
    def threads() -> int:
        return sum(t.name == "hil-free-space" for t in threading.enumerate())

    before = threads()
    interlocks = interlocks_from_spec(
        [spec_of(kind="disk", free_mb=0.001)], InterlockContext(folder=HERE)
    )
    assert threads() == before
    (interlock,) = interlocks
    assert interlock.check(BLOCK) is None
    assert threads() == before + 1
    interlocks.close()
    interlocks.close()
    assert threads() == before


@pytest.mark.thorough
def test_the_interlocks_of_a_run_watch_its_own_folder_and_recorder(tmp_path: Path) -> None:
    """Made before the motion is confirmed, they get both when the recording begins."""
    spec, station = tmp_path / "spec.yaml", tmp_path / "station.yaml"
    spec.write_text(
        "hil: 1\nname: short\nrobot: ur5\nexcitation: {kind: dwell, waypoints: 20, seed: 7}\n"
        "interlocks: [{kind: recorder, behind_s: 2}, {kind: disk, free_mb: 1.0e+12}]\n"
    )
    station.write_text(
        "hil_station: 1\nrobots: {ur5: {driver: mock, model: ur5, options: {clock: wall}}}\n"
    )
    with planned(load(spec, station)) as (robot, plan, _):
        interlocks = RunInterlocks(load(spec, station), robot, plan)
    backlog, disk = (one for one in interlocks.all if one.name in ("recorder", "disk"))
    for one in (backlog, disk):
        with pytest.raises(RuntimeError, match="before the recording has begun"):
            one.check(BLOCK)
    recorder: Any = SimpleNamespace(behind_s=1.0)
    interlocks.watch_recording(tmp_path, recorder)
    assert backlog.check(BLOCK) is None
    recorder.behind_s = 3.0
    assert backlog.check(BLOCK) is not None
    trip = disk.check(BLOCK)
    interlocks.all.close()
    assert trip is not None
    assert f"free space for {tmp_path}" in trip.text(NAMES)
