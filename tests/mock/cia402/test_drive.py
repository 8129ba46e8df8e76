"""How mock drives come to rest, what they take for a fault, and what brings them back."""

import math

import numpy as np
import pytest

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.power import State
from tests.support.can_drive_parts import ARM, CSP, CST, CSV, OneDrive

SPEED = 1.0
PROFILE, QUICK = 2.0, 8.0
"""Decelerations of 6084h and 6085h in here [rad/s²]."""
MOST = float(ARM.qdd_max[1])
DISABLED, ENABLED, FAULT = State.SWITCH_ON_DISABLED, State.OPERATION_ENABLED, State.FAULT


def moving(speed=SPEED, mode=CSV):
    one = OneDrive().moving(speed, mode)
    one.set(keys.PROFILE_DECELERATION, round(PROFILE * one.counts))
    one.set(keys.QUICK_STOP_DECELERATION, round(QUICK * one.counts))
    one.speeds.clear()
    one.demands.clear()
    return one


def decelerations(one):
    """What the set-points did on the way down, the last step before rest left out [rad/s²]."""
    speed = np.array([SPEED, *one.speeds])
    down = -np.diff(speed[: np.flatnonzero(speed == 0.0)[0]]) / 1e-3
    return down


@pytest.mark.parametrize(
    ("option", "deceleration"), [(1, PROFILE), (2, QUICK), (3, MOST), (4, MOST)]
)
def test_a_quick_stop_ramps_as_605ah_says_and_ends_disabled(option, deceleration):
    one = moving()
    one.set(keys.QUICK_STOP_OPTION, option)
    one.tell(0x02)
    assert one.state is State.QUICK_STOP_ACTIVE
    assert not one.status & 0x20
    one.until(DISABLED)
    assert decelerations(one) == pytest.approx(deceleration, rel=1e-4)
    assert one.cycles(1).braked


@pytest.mark.parametrize(("option", "deceleration"), [(5, PROFILE), (6, QUICK), (7, MOST)])
def test_options_5_to_8_of_605ah_stay_in_quick_stop_and_hold(option, deceleration):
    one = moving()
    one.set(keys.QUICK_STOP_OPTION, option)
    one.tell(0x02, cycles=400)
    assert one.state is State.QUICK_STOP_ACTIVE
    assert decelerations(one) == pytest.approx(deceleration, rel=1e-4)
    assert one.status & 0x0400
    assert not one.cycles(1).braked
    one.set(keys.TARGET_VELOCITY, 0)
    one.tell(0x0F)
    assert one.state is ENABLED


def test_605ah_0_takes_the_current_away_at_once():
    one = moving()
    one.set(keys.QUICK_STOP_OPTION, 0)
    one.tell(0x02)
    assert one.state is DISABLED
    assert one.cycles(1).torque == 0.0


def test_the_negative_direction_stops_the_same():
    one = moving(-SPEED)
    one.tell(0x02)
    one.until(DISABLED)
    assert min(one.speeds) >= -SPEED
    assert one.speeds[-1] == 0.0
    assert max(one.speeds) <= 0.0


@pytest.mark.parametrize(
    ("option_key", "word", "then"),
    [
        (keys.SHUTDOWN_OPTION, 0x06, State.READY_TO_SWITCH_ON),
        (keys.DISABLE_OPTION, 0x07, State.SWITCHED_ON),
    ],
)
def test_605bh_and_605ch_ramp_before_the_state_changes(option_key, word, then):
    one = moving()
    one.set(option_key, 1)
    one.tell(word, cycles=20)
    assert one.state is ENABLED
    assert not one.status & 0x1000
    one.until(then)
    assert decelerations(one) == pytest.approx(PROFILE, rel=1e-4)
    assert one.cycles(1).braked


@pytest.mark.parametrize(
    ("option_key", "word", "then"),
    [
        (keys.SHUTDOWN_OPTION, 0x06, State.READY_TO_SWITCH_ON),
        (keys.DISABLE_OPTION, 0x07, State.SWITCHED_ON),
    ],
)
def test_605bh_and_605ch_coast_with_option_0(option_key, word, then):
    one = moving()
    one.set(option_key, 0)
    one.tell(word)
    assert one.state is then
    assert one.demands[-1].torque == 0.0


def test_disable_voltage_coasts_and_then_the_brake_takes_the_joint():
    one = moving()
    one.tell(0x00, cycles=12)
    assert one.qd == pytest.approx(SPEED)
    assert not one.demands[-1].braked
    one.cycles(3)
    assert one.demands[-1].braked
    assert one.qd == 0.0


def test_a_quick_stop_does_not_wait_for_a_slower_ramp():
    one = moving()
    one.set(keys.DISABLE_OPTION, 1)
    one.tell(0x07, cycles=5)
    one.tell(0x02)
    assert one.state is State.QUICK_STOP_ACTIVE
    one.until(DISABLED)
    assert decelerations(one)[-5:] == pytest.approx(QUICK, rel=1e-4)


def test_a_ramp_that_has_begun_is_finished_before_the_next_command():
    one = moving()
    one.tell(0x07, cycles=5)
    one.tell(0x0F, cycles=5)
    assert one.speeds[-1] < one.speeds[19]
    one.until(State.SWITCHED_ON)


@pytest.mark.parametrize(("option", "deceleration"), [(1, PROFILE), (2, QUICK), (3, MOST)])
def test_halt_ramps_as_605dh_says_and_stays_enabled(option, deceleration):
    one = moving()
    one.set(keys.HALT_OPTION, option)
    one.tell(0x10F, cycles=400)
    assert one.state is ENABLED
    assert decelerations(one) == pytest.approx(deceleration, rel=1e-4)
    assert one.status & 0x0400
    assert not one.status & 0x1000
    one.tell(0x0F, cycles=5)
    assert one.qd == pytest.approx(SPEED)


@pytest.mark.parametrize(("option", "deceleration"), [(1, PROFILE), (2, QUICK), (4, MOST)])
def test_a_fault_reaction_ramps_as_605eh_says(option, deceleration):
    one = moving()
    one.set(keys.FAULT_REACTION_OPTION, option)
    one.drive.fault(0xFF01)
    assert one.state is State.FAULT_REACTION_ACTIVE
    one.until(FAULT)
    assert decelerations(one) == pytest.approx(deceleration, rel=1e-4)


def test_605eh_0_takes_the_current_away_at_once():
    one = moving()
    one.set(keys.FAULT_REACTION_OPTION, 0)
    one.drive.fault(0xFF01)
    assert one.state is FAULT
    assert one.cycles(1).torque == 0.0


def test_a_ramp_begins_where_torque_has_led_the_joint():
    one = OneDrive().enabled(CST)
    one.set(keys.TARGET_TORQUE, 500)
    one.cycles(10)
    q, qd = one.q, one.qd
    one.tell(0x02)
    first = one.demands[-1].setpoints[0]
    assert qd > 0.1
    assert first[0] == pytest.approx(q + 1e-3 * qd, abs=1e-4)
    assert first[1] == pytest.approx(qd - 1e-3 * one.drive._axis.deceleration(2))


def test_a_disabled_joint_is_on_its_brake():
    one = OneDrive().on()
    for word in (0x00, 0x06, 0x07):
        one.tell(word)
        assert one.demands[-1].braked
    one.set(keys.MODE, CSP)
    one.tell(0x0F)
    assert not one.demands[-1].braked


@pytest.mark.parametrize(
    ("option", "after", "torque_is_gone"),
    [
        (0, ENABLED, False),
        (1, State.FAULT_REACTION_ACTIVE, False),
        (2, DISABLED, True),
        (3, State.QUICK_STOP_ACTIVE, False),
    ],
)
def test_a_lost_master_has_the_effect_that_6007h_says(option, after, torque_is_gone):
    one = moving()
    one.set(keys.ABORT_CONNECTION_OPTION, option)
    one.drive.connection.lost(0x8130)
    assert one.state is after
    demand = one.cycles(1, synced=False)
    assert (demand.torque == 0.0) == torque_is_gone
    assert math.isnan(demand.torque) != torque_is_gone


def test_what_a_lost_master_left_in_the_controlword_enables_nothing():
    one = moving()
    one.set(keys.QUICK_STOP_OPTION, 6)
    one.set(keys.ABORT_CONNECTION_OPTION, 3)
    one.drive.connection.lost(0x8130)
    one.cycles(300, synced=False)
    assert one.state is State.QUICK_STOP_ACTIVE
    assert one.qd == 0.0
    one.set(keys.TARGET_VELOCITY, 0)
    one.tell(0x00)
    assert one.state is DISABLED


def test_enabled_again_from_a_quick_stop_the_axis_goes_on_from_its_set_point():
    one = moving()
    one.set(keys.QUICK_STOP_OPTION, 6)
    one.tell(0x02, cycles=200)
    one.lag = 0.01
    one.cycles(1)
    one.set(keys.TARGET_VELOCITY, 0)
    held = one.demands[-1].setpoints[-1, 0]
    one.tell(0x0F)
    assert one.state is ENABLED
    assert one.demands[-1].setpoints[:, 0] == pytest.approx(held, abs=1e-9)


# What the mock drives take for a fault, what they say then, and what brings them back.


BIT_13 = 0x2000


def lagging(lag, timeout_ms=50):
    one = OneDrive().enabled(CSP)
    one.set(keys.FOLLOWING_ERROR_WINDOW, round(0.1 * one.counts))
    one.set(keys.FOLLOWING_ERROR_TIMEOUT, timeout_ms)
    one.lag = lag
    return one


def test_a_following_error_trips_after_its_time_out():
    one = lagging(0.11)
    one.cycles(12)
    assert one.state is ENABLED
    assert one.status & BIT_13
    one.cycles(1)
    assert one.emergencies == [(0x8611, 0x21)]
    one.until(FAULT)
    assert one.status & BIT_13


def test_a_following_error_inside_its_window_is_none():
    one = lagging(0.09)
    one.cycles(100)
    assert one.state is ENABLED
    assert not one.status & BIT_13


def test_a_following_error_that_goes_away_in_time_trips_nothing():
    one = lagging(0.11)
    for _ in range(5):
        one.lag = 0.11
        one.cycles(10)
        assert one.status & BIT_13
        one.lag = 0.0
        one.cycles(1)
    assert one.state is ENABLED
    assert one.emergencies == []


def test_no_window_means_no_watch():
    one = lagging(0.5)
    one.set(keys.FOLLOWING_ERROR_WINDOW, 0xFFFF_FFFF)
    one.cycles(100)
    assert one.state is ENABLED


def test_a_target_that_is_not_preloaded_is_a_following_error():
    one = OneDrive().on()
    one.set(keys.MODE, CSP)
    one.lag = 0.0
    one.set(keys.TARGET_POSITION, one.registers[keys.POSITION] + round(0.5 * one.counts))
    one.inertia = 1.0
    for word in (0x06, 0x07):
        one.tell(word)
    one.registers[keys.CONTROLWORD] = 0x0F
    for _ in range(14):  # the joint does not jump, however the set-point does
        one.drive.advance(4)
        one.drive.measured(one._measured(0.0), 4)
    assert one.emergencies == [(0x8611, 0x21)]


def test_a_reaction_to_a_following_error_begins_where_the_joint_is():
    one = lagging(0.15, timeout_ms=0)
    one.cycles(1)
    at = one.q
    one.lag = 0.0
    assert one.cycles(1).setpoints[0, 0] == pytest.approx(at)


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_a_cyclic_mode_without_sync_trips_after_100_ms(mode):
    one = OneDrive().enabled(mode)
    one.cycles(25, synced=False)
    assert one.state is ENABLED
    one.cycles(1, synced=False)
    assert one.state is FAULT
    assert [code for code, _ in one.emergencies] == [0x8700]


def test_a_set_point_comes_to_rest_when_sync_stays_away():
    one = OneDrive().enabled(CSP)
    for _ in range(19):
        one.set(
            keys.TARGET_POSITION, one.registers[keys.TARGET_POSITION] + round(4e-3 * one.counts)
        )
        one.cycles(1)
    assert one.qd == pytest.approx(1.0, rel=1e-3)
    one.speeds.clear()
    one.cycles(26, synced=False)
    assert max(one.speeds) <= 1.0 + 1e-3
    assert one.speeds[-1] == 0.0
    assert min(one.speeds) >= 0.0


def test_a_hot_motor_warns_and_then_trips():
    one = OneDrive().enabled(CSP)
    one.celsius = 85.0
    one.cycles(1)
    assert one.status & 0x0080
    assert one.state is ENABLED
    one.celsius = 115.0
    one.cycles(1)
    assert one.emergencies == [(0x4310, 0x09)]
    assert one.state is FAULT


def test_a_fault_is_not_reset_while_the_motor_is_too_hot():
    one = OneDrive().enabled(CSP)
    one.celsius = 115.0
    one.until(FAULT)
    one.tell(0x00)
    one.tell(0x80, cycles=3)
    assert one.state is FAULT
    assert one.status & 0x0080
    one.celsius = 105.0
    one.tell(0x80, cycles=3)
    assert one.state is FAULT  # no edge
    one.tell(0x00)
    one.tell(0x80)
    assert one.state is State.SWITCH_ON_DISABLED
    assert [code for code, _ in one.emergencies] == [0x4310, 0]


def test_a_reset_begins_the_watch_on_the_following_error_anew():
    one = lagging(0.15)
    one.until(FAULT)
    one.lag = 0.0
    one.tell(0x00)
    one.tell(0x80)
    assert not one.status & BIT_13


def test_a_following_error_stays_told_while_the_reaction_takes_its_time():
    one = lagging(0.0, timeout_ms=0)
    for k in range(30):
        one.lag = 0.15 * (k == 29)
        target = one.registers[keys.TARGET_POSITION] + round(4e-3 * one.counts)
        one.set(keys.TARGET_POSITION, target)
        one.cycles(1)
    one.cycles(3)
    assert one.state is State.FAULT_REACTION_ACTIVE
    assert one.status & BIT_13


@pytest.mark.parametrize("window_rad", [0.1, 0.5, None])
def test_an_injected_following_error_is_one_until_it_is_reset(window_rad):
    one = OneDrive().enabled(CSP)
    window = 0xFFFF_FFFF if window_rad is None else round(window_rad * one.counts)
    one.set(keys.FOLLOWING_ERROR_WINDOW, window)
    at = one.registers[keys.POSITION]
    one.drive.slip()
    one.cycles(2)
    assert one.emergencies == [(0x8611, 0x21)]
    assert one.state is FAULT
    assert one.status & BIT_13
    error = one.registers[keys.FOLLOWING_ERROR]
    assert error > (window_rad or 0.0) * one.counts
    assert one.registers[keys.POSITION_DEMAND] - one.registers[keys.POSITION] == error
    assert one.registers[keys.POSITION] == at
    one.tell(0x00)
    one.tell(0x80, cycles=2)
    assert one.registers[keys.FOLLOWING_ERROR] == 0
    assert not one.status & BIT_13


def test_a_joint_that_runs_away_by_torque_is_too_fast():
    one = OneDrive(inertia=1.0).enabled(CST)
    one.set(keys.TARGET_TORQUE, 1000)
    one.cycles(100)
    assert [code for code, _ in one.emergencies] == [0x8400]
    one.until(FAULT)
    assert max(one.speeds) < 1.6 * ARM.qd_max[1]


def test_only_the_first_fault_counts():
    one = OneDrive().on()
    one.drive.fault(0x3210)
    one.drive.fault(0x2310)
    assert one.emergencies == [(0x3210, 0x05)]


def test_a_reset_says_that_there_is_no_error_any_more():
    one = OneDrive().on()
    one.drive.fault(0xFF01)
    one.tell(0x00)
    one.tell(0x80)
    assert one.emergencies == [(0xFF01, 0x81), (0, 0)]
