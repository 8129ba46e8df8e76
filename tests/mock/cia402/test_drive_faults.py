"""What the mock drives take for a fault, what they say then, and what brings them back."""

import pytest

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.power import State
from tests.support.can_drive_parts import ARM, CSP, CST, CSV, OneDrive

ENABLED, FAULT = State.OPERATION_ENABLED, State.FAULT
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
