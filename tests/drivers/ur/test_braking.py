"""Stops of a UR arm: hard enough to be over before its watchdog bites, and seen to be obeyed."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import CommandRefused, SpecError
from hil.robot import Segment
from hil_drivers.ur.options import SERIES_HZ, options_of
from hil_drivers.ur.robot import UrRobot
from hil_drivers.ur.servo import Ramp

ROW = np.dtype([("timestamp", "f8"), ("target_qd", "f8", 6), ("target_TCP_speed", "f8", 6)])


def row(at, fastest, tool=0.0):
    made = np.zeros(1, ROW)
    made[0] = (at, [0, 0, 0, 0, 0, fastest], [0, 0, 0, 0, 0, tool])
    return made[0]


def options(**given):
    return options_of({"address": "192.0.2.7"} | given, "ur5")


@pytest.mark.parametrize("model", SERIES_HZ)
def test_with_the_usual_options_a_stop_out_of_full_speed_is_over_in_time(model):
    usual = options_of({"address": "192.0.2.7"}, model)
    assert 1.0 / usual.watchdog_hz <= 0.5


@pytest.mark.parametrize(
    "given", [{"watchdog_hz": 4.0}, {"stop_rad_s2": 6.0}, {"watchdog_hz": 20.0, "speed_share": 0.1}]
)
def test_a_watchdog_that_would_bite_during_a_stop_is_refused_with_what_would_do(given):
    with pytest.raises(SpecError, match="watchdog_hz") as caught:
        options(**given)
    assert "stop_rad_s2" in caught.value.hint


def test_slower_arms_and_harder_stops_may_have_a_faster_watchdog():
    assert options(watchdog_hz=4.0, speed_share=0.3).watchdog_hz == 4.0
    assert options(watchdog_hz=4.0, stop_rad_s2=30.0).watchdog_hz == 4.0


def test_an_arm_that_is_led_fast_is_stopped_harder_than_it_might_be():
    usual = options()
    assert Ramp(row(0.0, 1.0, 2.0), usual, led=True).deceleration == usual.stop_m_s2
    fast = Ramp(row(0.0, 3.0, 8.0), usual, led=True)
    assert 8.0 / fast.deceleration == pytest.approx(1.0 / usual.watchdog_hz - 0.1)
    assert Ramp(row(0.0, 3.0, 8.0), usual, led=False).deceleration == usual.stop_rad_s2


def test_an_arm_obeys_when_its_commanded_speed_falls_also_out_of_a_start():
    ramp = Ramp(row(0.0, 1.0), options(), led=False)
    assert [ramp.falls(row(0.0, speed)) for speed in (1.0, 1.2, 1.4, 1.4, 1.33)] == [
        False, False, False, False, True
    ]  # fmt: skip


def test_an_arm_that_has_not_begun_to_move_does_not_stand_before_the_stop_was_made():
    ramp = Ramp(row(0.0, 0.0), options(), led=False)
    assert not ramp.stands(row(0.0, 0.0))
    ramp.answered = True
    assert ramp.stands(row(0.0, 0.0))


def test_a_ramp_that_takes_too_long_is_told_once():
    ramp = Ramp(row(1.0, 0.8), options(), led=False)
    assert not ramp.overdue(row(1.3, 0.5))
    assert ramp.overdue(row(1.5, 0.5))
    assert not ramp.overdue(row(2.0, 0.5))


def test_a_stop_that_comes_while_a_segment_is_prepared_holds(monkeypatch):
    robot = UrRobot("arm", "ur5", address="192.0.2.7")
    zeros = np.zeros((1, 6))
    at = np.zeros(1, [("timestamp", "f8"), ("target_q", "f8", 6), ("target_qd", "f8", 6)])

    class Next:
        alive = True

        def prepare(self, segment):
            robot.stop()

        def stop(self):
            pass

        def close(self):
            pass

    monkeypatch.setattr(robot, "_motion", Next())
    monkeypatch.setattr(robot, "_connected", True)
    monkeypatch.setattr(type(robot._controller), "row", at[0])
    with pytest.raises(CommandRefused, match="stopped while"):
        robot.prepare(Segment(1, "move", zeros, zeros, zeros, 0.0, 0.0))
    with pytest.raises(CommandRefused, match="no segment"):
        robot.start()
