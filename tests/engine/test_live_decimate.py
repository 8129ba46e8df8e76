"""Which rows a viewer is shown."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.typing import StructArray
from hil.engine.live_view import AT_ONCE, Decimation
from hil.robot import state_dtype


class Wall:
    """A wall clock that goes on when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def block(begin: float, n: int, rate_hz: float) -> StructArray:
    rows = np.zeros(n, state_dtype(6))
    rows["device_time"] = begin + np.arange(n) / rate_hz
    return rows


@pytest.mark.parametrize(
    ("every_s", "rows", "rate_hz"),
    [(0.008, 1, 125), (0.032, 16, 500), (0.2, 100, 500), (0.0005, 16, 125), (1.0, 8000, 8000)],
)
def test_at_most_60_rows_a_second_of_wall_time(every_s: float, rows: int, rate_hz: float) -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    shown = 0
    for i in range(int(10 / every_s)):
        wall.now += every_s
        shown += len(decimation.select(block(i * rows / rate_hz, rows, rate_hz))[0])
    assert shown <= 60 * 10 + AT_ONCE
    # As many as there may be: fewer only where blocks come too seldom, or bring too few rows.
    assert shown >= 0.8 * min(60 * 10, AT_ONCE * 10 / every_s, rows * 10 / every_s)


def test_the_newest_row_is_shown_and_the_others_are_evenly_spread() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 0.1
    rows = block(5.0, 50, 500)
    chosen, _ = decimation.select(rows)
    assert chosen["device_time"][-1] == rows["device_time"][-1]
    assert np.ptp(np.diff(chosen["device_time"])) < 1e-9
    assert 4 <= len(chosen) <= 7


def test_ages_follow_the_device_clock_of_a_real_robot() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 0.1
    chosen, age = decimation.select(block(0.0, 12, 125))
    assert age == pytest.approx(chosen["device_time"][-1] - chosen["device_time"])


def test_a_clock_that_runs_ahead_is_squeezed_into_the_time_that_has_passed() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 0.1
    _, age = decimation.select(block(0.0, 1250, 125))  # 10 s at once
    assert 0.08 < age[0] < 0.1  # after what was shown before
    assert (np.diff(age) < 0).all()
    assert age[-1] == 0


def test_nothing_is_due_at_once_again() -> None:
    wall = Wall()
    decimation = Decimation(clock=wall)
    wall.now += 1.0
    decimation.select(block(0.0, 100, 500))
    assert decimation.due() == 0
    assert len(decimation.select(block(1.0, 100, 500))[0]) == 0
