"""Modes of operation of the mock drives: who follows what, and what the statusword says of it."""

import math

import numpy as np
import pytest

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import wrapped
from hil_mock_robot.cia402.body import STEP_S
from hil_mock_robot.cia402.power import State
from tests.support.can_drive_parts import ARM, CSP, CST, CSV, HM, PP, OneDrive

LIMIT, FOLLOWS, BIT_13, REACHED = 0x0800, 0x1000, 0x2000, 0x0400
PERIOD_S = 4e-3


def aim(one, q):
    one.set(keys.TARGET_POSITION, round(q * one.counts))


def test_the_display_follows_the_mode_that_is_supported():
    one = OneDrive().on()
    for mode in (PP, HM, CSP, CSV, CST):
        one.set(keys.MODE, mode)
        assert one.registers[keys.MODE_DISPLAY] == mode


@pytest.mark.parametrize("mode", [2, 3, 4, 7, -1, 0])
def test_the_display_stays_when_the_mode_is_not_built(mode):
    one = OneDrive().on()
    one.set(keys.MODE, CSP)
    one.set(keys.MODE, mode)
    one.cycles(3)
    assert one.registers[keys.MODE_DISPLAY] == CSP


def test_a_mode_that_6502h_lacks_is_not_taken():
    one = OneDrive().on()
    one.registers[keys.SUPPORTED_MODES] &= ~(1 << 9)
    one.set(keys.MODE, CST)
    assert one.registers[keys.MODE_DISPLAY] == 0


def test_a_refused_mode_is_taken_once_it_is_refused_no_more():
    one = OneDrive().on()
    one.drive.operation.refused.add(CSP)
    one.set(keys.MODE, CSP)
    one.cycles(2)
    assert one.registers[keys.MODE_DISPLAY] == 0
    one.drive.operation.refused.clear()
    one.cycles(1)
    assert one.registers[keys.MODE_DISPLAY] == CSP


def test_csp_is_at_the_target_when_the_next_sync_comes():
    one = OneDrive().enabled(CSP)
    for k in range(1, 50):
        target = 0.3 + 0.1 * (1 - math.cos(3.0 * k * PERIOD_S))
        aim(one, target)
        one.cycles(1)
        assert one.q == pytest.approx(target, abs=1e-7)


def test_csp_set_points_between_targets_have_the_speed_and_acceleration_of_the_motion():
    one = OneDrive().enabled(CSP)
    amplitude, omega = 0.5, 2 * math.pi * 0.5
    for k in range(1, 400):
        aim(one, 0.3 + amplitude * (1 - math.cos(omega * k * PERIOD_S)))
        one.cycles(1)
    rows = np.concatenate([demand.setpoints for demand in one.demands[-300:]])
    t = PERIOD_S * 99 + STEP_S * np.arange(1, len(rows) + 1)
    phase = omega * t
    truth = (
        0.3 + amplitude * (1 - np.cos(phase)),
        amplitude * omega * np.sin(phase),
        amplitude * omega**2 * np.cos(phase),
    )
    deviations = [float(np.abs(rows[:, i] - truth[i]).max()) for i in range(3)]
    assert deviations[0] < 1e-6
    assert deviations[1] < 1e-3
    assert deviations[2] < 0.03 * amplitude * omega**2 + 0.05


def test_csp_cuts_targets_to_the_position_limits_and_says_so():
    one = OneDrive().enabled(CSP)
    one.set(keys.POSITION_LIMIT_MAX, round(0.31 * one.counts))
    aim(one, 0.309)
    one.cycles(2)
    assert not one.status & LIMIT
    aim(one, 0.32)
    one.cycles(2)
    assert one.status & LIMIT
    assert one.q == pytest.approx(0.31, abs=1e-7)
    aim(one, 0.305)
    one.cycles(2)
    assert not one.status & LIMIT


def test_csp_adds_the_position_offset():
    one = OneDrive().enabled(CSP)
    one.set(keys.POSITION_OFFSET, round(0.001 * one.counts))
    one.cycles(2)
    assert one.q == pytest.approx(0.301, abs=1e-7)


def test_the_torque_offset_is_handed_on_in_newton_metres():
    one = OneDrive().enabled(CSP)
    one.set(keys.TORQUE_OFFSET, 250)
    rated_nm = one.registers[keys.RATED_TORQUE] * 1e-3 * ARM.gear_ratio[1]
    assert one.cycles(1).offset == pytest.approx(0.25 * rated_nm)
    assert rated_nm == pytest.approx(ARM.effort_max[1] / 2.1, rel=1e-3)


def test_the_interpolation_period_may_be_other_than_4_ms():
    one = OneDrive().enabled(CSP)
    one.set(keys.INTERPOLATION_VALUE, 80)
    one.set(keys.INTERPOLATION_INDEX, -4)
    aim(one, 0.31)
    one.cycles(1)
    assert 0.3 < one.q < 0.31
    one.cycles(1, synced=False)
    assert one.q == pytest.approx(0.31, abs=1e-7)


def test_a_following_drive_says_so_by_bit_12():
    for mode in (CSP, CSV, CST):
        one = OneDrive().enabled(mode)
        assert one.status & FOLLOWS
        one.tell(0x07)
        one.until(State.SWITCHED_ON)
        assert not one.status & FOLLOWS


@pytest.mark.parametrize("mode", [CSP, CSV])
def test_a_deaf_drive_stays_and_has_bit_12_low(mode):
    one = OneDrive().enabled(mode)
    one.drive.operation.deaf = True
    aim(one, 0.35)
    one.set(keys.TARGET_VELOCITY, round(0.5 * one.counts))
    one.cycles(10)
    assert not one.status & FOLLOWS
    assert one.q == pytest.approx(0.3, abs=1e-6)


def test_csv_integrates_the_velocity():
    one = OneDrive().enabled(CSV)
    one.set(keys.TARGET_VELOCITY, round(0.5 * one.counts))
    one.set(keys.VELOCITY_OFFSET, round(0.1 * one.counts))
    one.cycles(100)
    assert one.qd == pytest.approx(0.6, abs=1e-6)
    assert one.q == pytest.approx(0.3 + 0.6 * 0.398, abs=1e-5)


def test_csv_goes_to_a_velocity_within_its_period_however_the_steps_come():
    one = OneDrive().enabled(CSV)
    one.set(keys.TARGET_VELOCITY, round(0.5 * one.counts))
    speeds = one.cycles(1, steps=8).setpoints[:, 1]
    assert speeds == pytest.approx([0.125, 0.25, 0.375, *[0.5] * 5], abs=1e-6)
    one.set(keys.TARGET_VELOCITY, round(0.1 * one.counts))
    assert one.cycles(1, steps=2).setpoints[:, 1] == pytest.approx([0.4, 0.3], abs=1e-6)
    unsynced = one.cycles(1, synced=False, steps=2).setpoints[:, 1]
    assert unsynced == pytest.approx([0.2, 0.1], abs=1e-6)


def test_csv_does_not_leave_the_position_limits_and_comes_back():
    one = OneDrive().enabled(CSV)
    one.set(keys.POSITION_LIMIT_MAX, round(0.4 * one.counts))
    one.set(keys.TARGET_VELOCITY, round(0.5 * one.counts))
    one.cycles(100)
    assert one.status & LIMIT
    assert one.q == pytest.approx(0.4, abs=0.01)
    one.set(keys.TARGET_VELOCITY, round(-0.5 * one.counts))
    one.cycles(10)
    assert one.qd == pytest.approx(-0.5, abs=1e-6)


def test_cst_gives_target_and_offset_in_thousandths_of_rated_torque():
    one = OneDrive().enabled(CST)
    one.set(keys.TARGET_TORQUE, 300)
    one.set(keys.TORQUE_OFFSET, -100)
    rated_nm = one.registers[keys.RATED_TORQUE] * 1e-3 * ARM.gear_ratio[1]
    assert one.cycles(1).torque == pytest.approx(0.2 * rated_nm)


@pytest.mark.parametrize(
    "where", [keys.MAX_TORQUE, keys.POSITIVE_TORQUE_LIMIT, keys.NEGATIVE_TORQUE_LIMIT]
)
def test_cst_cuts_the_torque_to_its_limits_and_says_so(where):
    one = OneDrive(inertia=1000.0).enabled(CST)
    one.set(where, 150)
    one.set(keys.TARGET_TORQUE, -300)
    rated_nm = one.registers[keys.RATED_TORQUE] * 1e-3 * ARM.gear_ratio[1]
    assert one.cycles(1).torque == pytest.approx(-0.15 * rated_nm)
    assert one.status & LIMIT


def test_a_drive_at_its_torque_limit_says_so():
    one = OneDrive().enabled(CSP)
    one.set(keys.MAX_TORQUE, 500)
    one.limited = True
    rated_nm = one.registers[keys.RATED_TORQUE] * 1e-3 * ARM.gear_ratio[1]
    assert one.cycles(1).limit == pytest.approx(0.5 * rated_nm)
    assert one.status & LIMIT


def test_a_mode_may_change_while_enabled_at_rest():
    one = OneDrive().enabled(CSP)
    one.set(keys.MODE, CSV)
    one.cycles(3)
    assert one.registers[keys.MODE_DISPLAY] == CSV
    assert one.q == pytest.approx(0.3, abs=1e-6)
    assert one.status & FOLLOWS


def test_polarity_turns_position_velocity_and_torque_round():
    straight, turned = OneDrive().on(), OneDrive()
    turned.registers[keys.POLARITY] = 0xE0
    turned.drive.written(keys.POLARITY)
    turned.on()
    assert turned.registers[keys.POSITION] == -straight.registers[keys.POSITION] != 0
    turned.enabled(CSV)
    turned.set(keys.TARGET_VELOCITY, round(0.5 * turned.counts))
    turned.cycles(3)
    assert turned.qd == pytest.approx(-0.5, abs=1e-6)
    assert turned.registers[keys.VELOCITY] == round(0.5 * turned.counts)
    turned.set(keys.MODE, CST)
    turned.set(keys.TARGET_TORQUE, 100)
    assert turned.cycles(1).torque < 0.0
    assert turned.registers[keys.TORQUE] == 100


def test_a_position_that_runs_over_32_bits_goes_on_at_the_other_end():
    one = OneDrive()
    one.q = 2.0**31 / one.counts + 0.001
    one.on()
    assert one.registers[keys.POSITION] == wrapped(round(one.q * one.counts)) < 0


def pp(one, q, word=0x1F, cycles=1):
    aim(one, q)
    one.tell(word, cycles)


def test_pp_goes_to_its_target_along_a_trapezoid():
    one = OneDrive().enabled(PP)
    for where, value in (
        (keys.PROFILE_VELOCITY, 0.5), (keys.PROFILE_ACCELERATION, 2.0),
        (keys.PROFILE_DECELERATION, 4.0),
    ):  # fmt: skip
        one.set(where, round(value * one.counts))
    one.speeds.clear()
    pp(one, 0.8)
    assert one.status & FOLLOWS
    assert not one.status & REACHED
    one.tell(0x0F)
    assert not one.status & FOLLOWS
    one.cycles(400)
    assert one.status & REACHED
    assert one.q == pytest.approx(0.8, abs=1e-7)
    speed = np.array([0.0, *one.speeds])
    change = np.diff(speed) / STEP_S
    assert speed.max() == pytest.approx(0.5, rel=1e-6)
    assert change.max() == pytest.approx(2.0, rel=1e-3)
    assert change.min() >= -2 * 4.0
    assert np.sum(change < -4.01) <= 1
    taken = len(np.flatnonzero(speed)) * STEP_S
    assert taken == pytest.approx(0.5 / 0.5 + 0.5 / 2 / 2.0 + 0.5 / 2 / 4.0, abs=0.01)


def test_pp_takes_no_target_without_an_edge_of_bit_4():
    one = OneDrive().enabled(PP)
    pp(one, 0.5, word=0x0F, cycles=10)
    assert one.q == pytest.approx(0.3)
    pp(one, 0.4, word=0x1F, cycles=1)
    pp(one, 0.5, word=0x1F, cycles=300)
    assert one.q == pytest.approx(0.4, abs=1e-7)


def test_pp_finishes_one_target_before_the_next_unless_told_otherwise():
    one = OneDrive().enabled(PP)
    pp(one, 0.6)
    one.tell(0x0F)
    pp(one, 0.2)
    one.tell(0x0F)
    one.cycles(500)
    assert max(demand.setpoints[:, 0].max() for demand in one.demands) == pytest.approx(0.6)
    assert one.q == pytest.approx(0.2, abs=1e-7)
    pp(one, 0.6)
    one.tell(0x0F, cycles=3)
    one.demands.clear()
    pp(one, 0.2, word=0x3F)
    one.cycles(500)
    assert max(demand.setpoints[:, 0].max() for demand in one.demands) < 0.5
    assert one.q == pytest.approx(0.2, abs=1e-7)


def test_pp_relative_targets_count_from_the_last_target():
    one = OneDrive().enabled(PP)
    for _ in range(2):
        pp(one, 0.05, word=0x5F)
        one.tell(0x0F, cycles=200)
    assert one.q == pytest.approx(0.4, abs=1e-6)


def test_pp_relative_targets_count_from_the_last_target_on_the_way_there_too():
    one = OneDrive().enabled(PP)
    pp(one, 0.5)
    one.tell(0x0F, cycles=10)
    assert 0.3 < one.q < 0.45
    pp(one, 0.1, word=0x7F)
    one.tell(0x0F, cycles=500)
    assert one.q == pytest.approx(0.6, abs=1e-6)


@pytest.mark.parametrize("mode", [CSP, CSV])
def test_after_a_halt_the_demand_goes_on_from_where_it_came_to_rest(mode):
    one = OneDrive().enabled(mode)
    one.set(keys.TARGET_VELOCITY, round(0.5 * one.counts))
    for k in range(20):
        aim(one, 0.3 + 0.5 * PERIOD_S * (k + 1))
        one.cycles(1)
    one.tell(0x10F, cycles=100)
    rests = one.q
    assert one.qd == 0.0
    aim(one, rests)
    one.set(keys.TARGET_VELOCITY, 0)
    one.tell(0x0F)
    demand = one.demands[-1]
    assert demand.setpoints[:, 0] == pytest.approx(rests, abs=1e-7)
    assert demand.setpoints[:, 1] == pytest.approx(0.0, abs=1e-4)


def test_current_has_the_sign_of_torque():
    for polarity, sign in ((0, 1), (0x20, -1), (0xC0, 1)):
        one = OneDrive(inertia=1000.0)
        one.registers[keys.POLARITY] = polarity
        one.drive.written(keys.POLARITY)
        one.enabled(CST)
        one.set(keys.TARGET_TORQUE, 100)
        turned = one.cycles(1).torque
        assert math.copysign(1, turned) == sign
        assert one.registers[keys.TORQUE] == 100
        assert one.registers[keys.CURRENT] > 50


def test_pp_goes_on_after_a_halt():
    one = OneDrive().enabled(PP)
    pp(one, 0.8)
    one.tell(0x11F, cycles=200)
    assert one.qd == 0.0
    assert one.q < 0.75
    one.tell(0x1F, cycles=400)
    assert one.q == pytest.approx(0.8, abs=1e-7)


def test_pp_needs_no_sync():
    one = OneDrive().enabled(PP)
    aim(one, 0.5)
    one.registers[keys.CONTROLWORD] = 0x1F
    one.cycles(60, synced=False, steps=10)
    assert one.q == pytest.approx(0.5, abs=1e-7)
    assert one.state is State.OPERATION_ENABLED


@pytest.mark.parametrize("method", [35, 37])
def test_homing_makes_the_present_position_the_home_offset(method):
    one = OneDrive().enabled(HM)
    one.set(keys.HOMING_METHOD, method)
    one.set(keys.HOME_OFFSET, 1234)
    assert not one.status & FOLLOWS
    one.tell(0x1F)
    one.cycles(1)
    assert one.registers[keys.POSITION] == 1234
    assert one.status & (FOLLOWS | REACHED) == FOLLOWS | REACHED
    assert one.q == pytest.approx(0.3)
    one.set(keys.MODE, PP)
    one.set(keys.TARGET_POSITION, 1234 + round(0.1 * one.counts))
    one.tell(0x0F)
    one.tell(0x1F, cycles=300)
    assert one.q == pytest.approx(0.4, abs=1e-6)


def test_homing_by_a_method_that_is_not_built_ends_in_a_homing_error():
    one = OneDrive().enabled(HM)
    one.set(keys.HOMING_METHOD, 1)
    one.tell(0x1F)
    assert one.status & BIT_13
    assert not one.status & FOLLOWS
