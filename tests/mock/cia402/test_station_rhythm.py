"""What sets the pace: periods as clients have told them, and set-points that stay away."""

from __future__ import annotations

import numpy as np
import pytest

from hil_mock_robot.cia402.axis import hermite
from tests.support.can_station_parts import PERIOD_S, RESET_NODE, START, Desk


def per_sync(desk: Desk) -> int:
    """Steps [ms] that one SYNC brings."""
    before = desk.station.clock.steps
    desk.sync()
    return desk.station.clock.steps - before


def test_a_sync_is_4_ms_until_somebody_says_otherwise() -> None:
    assert per_sync(Desk()) == 4


def test_any_one_drive_may_be_told_the_period() -> None:
    desk = Desk()
    desk.write(3, 0x60C2, 1, "B", 10)
    assert per_sync(desk) == 10


def test_a_drive_that_is_operational_is_believed_first() -> None:
    desk = Desk()
    desk.write(1, 0x60C2, 1, "B", 10)
    desk.write(2, 0x60C2, 1, "B", 8)
    assert per_sync(desk) == 10
    desk.command(START, 2)
    assert per_sync(desk) == 8


def test_after_a_reset_the_period_is_the_default_again() -> None:
    desk = Desk()
    desk.write(1, 0x60C2, 1, "B", 1)
    assert per_sync(desk) == 1
    desk.command(RESET_NODE)
    assert per_sync(desk) == 4


def test_1006h_counts_where_60c2h_was_never_written() -> None:
    desk = Desk()
    desk.write(1, 0x1006, 0, "I", 10_000)
    assert per_sync(desk) == 10
    assert desk.unit(1).drive._axis.period_steps == 10
    desk.write(1, 0x60C2, 1, "B", 2)
    assert per_sync(desk) == 2
    assert desk.unit(1).drive._axis.period_steps == 2


@pytest.mark.thorough
def test_each_axis_interpolates_over_its_own_period() -> None:
    desk = Desk()
    desk.write(1, 0x60C2, 1, "B", 4)
    desk.write(2, 0x60C2, 1, "B", 8)
    assert [desk.unit(n).drive._axis.period_steps for n in (1, 2, 3)] == [4, 8, 4]


def test_what_is_kept_of_periods_is_bounded() -> None:
    for steps in range(1, 60):
        hermite(steps)
    assert hermite.cache_info().currsize < 30


def demands(desk: Desk, lost: int, back: int = 3) -> list[float]:
    """Demanded speeds [rad/s] after each SYNC of a motion at 1 rad/s that misses some RPDOs."""
    target = float(desk.turning(1, 1.0))
    axis, speeds = desk.unit(1).drive._axis, []
    for k in range(lost + back):
        target += axis.counts * PERIOD_S
        if k >= lost:
            desk.rpdo(1, 0x0F, round(target))
        desk.sync()
        speeds.append(axis.demand_qd)
    return speeds


@pytest.fixture
def moving() -> Desk:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    return desk


@pytest.mark.parametrize("lost", [1, 2])
def test_an_axis_goes_on_at_its_speed_where_a_set_point_or_two_are_missing(
    moving: Desk, lost: int
) -> None:
    assert demands(moving, lost) == pytest.approx([1.0] * (lost + 3), abs=0.02)


def test_it_comes_to_rest_where_more_are_missing() -> None:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    speeds = np.array(demands(desk, 60, back=0))
    assert speeds[:2] == pytest.approx(1.0, abs=0.02)
    assert (np.diff(speeds[1:]) <= 1e-9).all()
    assert speeds[-1] == 0.0
    assert desk.state(1) == "OPERATION_ENABLED"


def test_it_does_not_leave_the_position_limits_on_its_own(moving: Desk) -> None:
    target = moving.turning(1, 1.0)
    registers = moving.unit(1).registers
    registers[0x607D << 8 | 2] = target
    moving.sync(2)
    axis = moving.unit(1).drive._axis
    assert axis.raw_position(axis.demand_q) <= target + 1


def test_targets_by_sdo_are_followed_without_rpdos(moving: Desk) -> None:
    moving.sync(20)
    target = moving.position(1) + round(0.01 * moving.unit(1).drive._axis.counts)
    moving.write(1, 0x607A, 0, "i", target)
    moving.sync(100)
    axis = moving.unit(1).drive._axis
    assert axis.raw_position(axis.demand_q) == pytest.approx(target, abs=1)


def test_an_rpdo_that_waits_for_timeouts_makes_silence_an_error() -> None:
    desk = Desk()
    assert desk.write(1, 0x1400, 5, "H", 50) == 0
    desk.map(1)
    desk.enable(1)
    desk.turning(1)
    desk.sent.clear()
    desk.sync(30)
    assert 0x8250 in desk.emergencies(1)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"
