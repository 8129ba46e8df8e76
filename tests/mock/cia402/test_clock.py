"""Device time of the mock drives: by SYNC while there is one, by the drives' own timer else."""

import pytest

from hil_mock_robot.cia402.station import DeviceClock


def test_every_sync_is_a_period_however_long_it_took_on_the_wall() -> None:
    clock = DeviceClock(0.0)
    assert [clock.sync(now, 0.004) for now in (0.0, 0.0001, 0.019, 0.0192)] == [4, 4, 4, 4]
    assert clock.device_s == pytest.approx(0.016)


def test_periods_of_no_whole_millisecond_add_up() -> None:
    clock = DeviceClock(0.0)
    steps = [clock.sync(0.002 * k, 0.0025) for k in range(1, 9)]
    assert sum(steps) == 20
    assert max(steps) == 3
    assert sum(clock.sync(1.0, 0.0001) for _ in range(100)) == 10


def test_the_own_timer_waits_for_two_periods_and_its_patience() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    assert clock.own(1.1999) == 0
    assert clock.synced
    assert clock.own(1.2051) == 5
    assert not clock.synced
    slow = DeviceClock(0.0)
    slow.sync(1.0, 0.2)
    assert slow.own(1.399) == 0
    assert slow.own(1.4031) == 3


def test_time_in_which_nobody_looked_for_sync_does_not_count() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    clock.slept(0.5)
    assert clock.own(1.6999) == 0
    assert clock.own(1.7021) == 2


def test_the_own_timer_takes_over_soon_when_no_drive_is_operational() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    clock.idle()
    assert clock.own(1.0199) == 0
    assert clock.own(1.0251) == 5


def test_a_clock_that_never_saw_a_sync_goes_as_the_wall() -> None:
    clock = DeviceClock(5.0)
    assert sum(clock.own(5.0 + 0.0007 * k) for k in range(1, 101)) == 70
    assert clock.device_s == pytest.approx(0.07)


def test_sync_takes_over_again_and_the_silence_is_not_made_up_for() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    clock.own(1.2101)
    assert clock.steps == 4 + 10
    assert clock.sync(1.211, 0.004) == 4
    assert clock.synced
    assert clock.own(1.4) == 0


def test_a_computer_that_slept_does_not_let_time_race() -> None:
    clock = DeviceClock(0.0)
    assert clock.own(100.0) == 100
    assert clock.own(100.0) == 0
    assert clock.own(100.003) == 3


def test_the_wait_is_until_the_own_timer_has_work() -> None:
    clock = DeviceClock(0.0)
    assert clock.wait_s(0.001, 4) == pytest.approx(0.003)
    clock.sync(1.0, 0.004)
    assert clock.wait_s(1.0, 1) == pytest.approx(0.201)
    assert clock.wait_s(3.0, 1) == 0.0
