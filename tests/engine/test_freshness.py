"""When state that repeats itself counts as stale: by the wall clock, or by blocks without one."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import InterlockTripped, StaleState
from hil.engine.reading import STALE_AFTER_BLOCKS, Freshness
from tests.support.interlock_parts import rows


class Wall:
    """A clock that is set by hand [s]."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def watching(after_s: float | None = None, *, wall: bool = True) -> tuple[Freshness, Wall]:
    clock = Wall()
    watch = Freshness(after_s, wall=wall, now=clock)
    watch.check(rows(device_time=3.0))
    return watch, clock


def test_in_wall_time_rows_may_repeat_for_as_long_as_the_spec_says() -> None:
    watch, clock = watching(5.0)
    for _ in range(10 * STALE_AFTER_BLOCKS):
        clock.now += 0.009
        watch.check(rows(device_time=3.0))
    clock.now = 5.1
    with pytest.raises(
        InterlockTripped, match=r"interlock stale: .* stands still at 3\.000 s"
    ) as e:
        watch.check(rows(device_time=3.0))
    assert "nothing new for 5.1 s, limit 5 s" in e.value.message


def test_a_newer_row_begins_afresh() -> None:
    watch, clock = watching()
    for time_s in (3.1, 3.2, 3.3):
        clock.now += 0.4
        watch.check(rows(device_time=time_s))
    clock.now += 0.4
    watch.check(rows(device_time=3.3))


def test_a_virtual_clock_knows_no_wall_time_and_counts_blocks() -> None:
    watch, clock = watching(5.0, wall=False)
    clock.now = 3600.0
    for _ in range(STALE_AFTER_BLOCKS):
        watch.check(rows(device_time=3.0))
    with pytest.raises(InterlockTripped, match="51 blocks in a row brought nothing new"):
        watch.check(rows(device_time=3.0))


def test_a_clock_that_went_backwards_is_called_so() -> None:
    watch, clock = watching()
    watch.check(rows(device_time=-2.0))
    clock.now = 0.6
    told = r"the robot's clock went backwards, from 3\.000 s to -1\.900 s: nothing new for 0\.6 s"
    with pytest.raises(InterlockTripped, match=told):
        watch.check(rows(device_time=-1.9))


def test_a_time_that_is_no_number_is_the_drivers_fault() -> None:
    watch, _ = watching()
    with pytest.raises(StaleState, match="not a number"):
        watch.check(rows(device_time=np.nan))
