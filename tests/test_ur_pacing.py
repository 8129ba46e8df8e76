"""How the mock controller's time passes."""

import pytest

from hil_mock_robot.ur import pacing


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(pacing.time, "monotonic", lambda: now[0])
    return now


def test_a_late_tick_is_caught_up_at_twice_the_pace_so_that_no_two_packages_wait_together(clock):
    pacer = pacing.RealTime(0.002)
    clock[0] += 0.005  # nobody gave us the processor
    made = []
    for _ in range(8):
        clock[0] += pacer.wait_s()
        made.append(clock[0] - 100.0)
        pacer.ticked()
    assert made == pytest.approx([0.005, 0.006, 0.007, 0.008, 0.009, 0.010, 0.012, 0.014])


def test_what_was_missed_for_long_is_not_raced_after(clock):
    pacer = pacing.RealTime(0.002)
    clock[0] += 1.0
    pacer.ticked()
    assert pacer.slips == 1
    assert pacer.wait_s() == pytest.approx(0.001)
