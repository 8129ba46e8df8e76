"""Absolute deadlines by a clock that the test moves."""

from __future__ import annotations

import itertools

import pytest

from hil_drivers.cia402.timing import FREE_IMPATIENCE_S, FREE_PATIENCE_S, Histogram, Schedule

PERIOD_S = 0.004


class Clock:
    """Time goes on when somebody waits, or works."""

    def __init__(self) -> None:
        self.now, self.wakes_late = 100.0, 0.0

    def __call__(self) -> float:
        return self.now

    def idle(self, until_s: float) -> None:
        self.now = max(self.now, until_s) + self.wakes_late


def begun(clock: Clock, schedule: Schedule, works: list[float]) -> list[float]:
    """When cycles that last so long have begun, relative to the first."""
    times = []
    for work in works:
        schedule.wait(clock.idle)
        times.append(clock.now)
        clock.now += work
        schedule.done()
    return [time - times[0] for time in times]


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_cycles_begin_at_multiples_of_the_period_whatever_they_last(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    times = begun(clock, schedule, [0.001, 0.0035, 0.0002, 0.001])
    assert times == pytest.approx([0, 0.004, 0.008, 0.012])
    assert (schedule.cycles, schedule.overrun, schedule.late) == (4, 0, 0)


def test_waking_late_does_not_add_up(clock: Clock) -> None:
    clock.wakes_late = 0.0002
    times = begun(clock, Schedule(PERIOD_S, clock=clock), [0.001] * 500)
    assert times[-1] == pytest.approx(499 * PERIOD_S)


def test_cycle_that_is_not_over_in_time_is_an_overrun(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    times = begun(clock, schedule, [0.001, 0.0045, 0.001, 0.001])
    assert times == pytest.approx([0, 0.004, 0.0085, 0.012])
    assert (schedule.overrun, schedule.late) == (1, 0)


def test_lost_time_is_not_caught_up_by_a_burst(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    times = begun(clock, schedule, [0.001, 0.05, 0.001, 0.001, 0.001])
    assert times[2:] == pytest.approx([0.054, 0.058, 0.062])
    assert schedule.overrun == 2
    assert schedule.late == 1


def test_two_cycles_are_never_closer_than_three_quarters_of_the_period(clock: Clock) -> None:
    works = [0.001, 0.0047, 0.001, 0.0053, 0.001, 0.009, 0.001, 0.0049, 0.001]
    times = begun(clock, Schedule(PERIOD_S, clock=clock), works)
    assert min(b - a for a, b in itertools.pairwise(times)) >= 0.75 * PERIOD_S - 1e-9


def test_answers_are_given_up_before_the_next_cycle(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    clock.wakes_late = 0.0005
    schedule.wait(clock.idle)
    schedule.wait(clock.idle)
    assert clock.now < schedule.give_up < schedule.deadline + PERIOD_S


def test_free_cycles_follow_each_other_at_once_and_are_never_late(clock: Clock) -> None:
    schedule = Schedule(0.0, clock=clock)
    times = begun(clock, schedule, [0.01, 0.5, 0.02])
    assert times == pytest.approx([0, 0.01, 0.51])
    assert (schedule.overrun, schedule.late) == (0, 0)
    schedule.wait(clock.idle)
    assert schedule.give_up == pytest.approx(clock.now + FREE_PATIENCE_S)


def test_restart_forgets_what_was_counted(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    begun(clock, schedule, [0.05, 0.05])
    clock.now += 10.0
    schedule.restart()
    begun(clock, schedule, [0.001, 0.001])
    assert (schedule.cycles, schedule.overrun, schedule.late) == (2, 0, 0)


def test_lateness_and_durations_are_told_by_percentile(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    clock.wakes_late = 0.0001
    begun(clock, schedule, [0.001] * 98 + [0.003] * 2)
    assert schedule.lateness.percentile(50) == pytest.approx(0.0001, abs=2e-6)
    assert schedule.lasting.percentile(50) == pytest.approx(0.001, abs=2e-6)
    assert schedule.lasting.percentile(99) == pytest.approx(0.003, abs=2e-6)


def test_histogram_keeps_the_longest_beyond_its_bins() -> None:
    times = Histogram(most_s=0.001)
    for time_s in (0.0, 0.0005, 2.5):
        times.add(time_s)
    assert len(times) == 3
    assert times.longest_s == 2.5
    assert times.percentile(50) == pytest.approx(0.0005)
    assert times.percentile(100) == pytest.approx(0.001)


def test_empty_histogram_says_zero() -> None:
    assert Histogram().percentile(99) == 0.0


def test_without_deadlines_who_has_not_answered_for_long_is_not_waited_for(clock: Clock) -> None:
    schedule = Schedule(0.0, clock=clock)
    waited = []
    for all_came in (False, False, False, True, False):
        schedule.wait(clock.idle)
        waited.append(schedule.give_up - clock.now)
        schedule.answered(all_came)
    patient, impatient = FREE_PATIENCE_S, FREE_IMPATIENCE_S
    assert waited == pytest.approx([patient] * 2 + [impatient] * 2 + [patient])


def test_with_deadlines_answers_are_waited_for_as_ever(clock: Clock) -> None:
    schedule = Schedule(PERIOD_S, clock=clock)
    for _ in range(10):
        schedule.wait(clock.idle)
        schedule.answered(False)
    assert schedule.give_up - schedule.deadline == pytest.approx(0.9 * PERIOD_S)
