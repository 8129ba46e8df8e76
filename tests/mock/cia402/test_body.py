"""Six mock drives on the plant: what they do to the arm, and whether they report what is so."""

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.body import STEP_S
from hil_mock_robot.cia402.power import State
from hil_mock_robot.plant.model import build_plant
from hil_mock_robot.plant.truth import draw_truth
from tests.support.can_drive_parts import ARM, CSP, CST, STEPS, SixDrives

BENT = np.radians([20.0, 30.0, -20.0, 40.0, 50.0, -30.0])
CYCLE_S = STEPS * STEP_S
OMEGA = 2 * np.pi * np.array([0.4, 0.35, 0.45, 0.5, 0.55, 0.6])
SWING = np.radians(20.0)


def sine(start, seconds):
    return start + SWING * (1 - np.cos(OMEGA * seconds))


def swinging(arm, cycles):
    """Follow a sine from where it is; (N, 6) how far the joints are from their targets [rad]."""
    start, away = arm.q, []
    for k in range(1, cycles + 1):
        target = sine(start, k * arm.steps * STEP_S)
        arm.aim(target)
        arm.cycles(1)
        away.append(arm.q - target)
    return np.array(away)


def static_torque(q, payload=None):
    """(6,) gravity at rest by MuJoCo's own inverse dynamics of the true links [N·m]."""
    truth = draw_truth("lab6", 0)
    plant = build_plant(ARM.dh, truth.links, [1.0] * 6, payload or Payload(), (0, 0, -9.81), STEP_S)
    return plant.inverse(np.array(q), np.zeros(6), np.zeros(6))


def reported_torque(arm):
    """(6,) joint torque by 6077h, 6076h and 6091h [N·m]."""
    rated = np.array(arm.raw(keys.RATED_TORQUE)) * 1e-3
    return np.array(arm.raw(keys.TORQUE)) / 1000 * rated * ARM.gear_ratio


def reported_current(arm):
    """(6,) motor current by 6078h and 6075h [A]."""
    return np.array(arm.raw(keys.CURRENT)) / 1000 * np.array(arm.raw(keys.RATED_CURRENT)) * 1e-3


def test_the_arm_follows_a_sine_in_csp():
    arm = SixDrives(BENT).enabled(CSP)
    away = np.degrees(swinging(arm, 500))
    assert arm.states == {State.OPERATION_ENABLED}
    assert np.abs(away).max() < 0.5
    assert np.sqrt((away[125:] ** 2).mean(axis=0)).max() < 0.2


def test_the_arm_follows_a_sine_at_a_kilohertz():
    arm = SixDrives(BENT)
    arm.steps = 1
    arm.set(keys.INTERPOLATION_VALUE, [1] * 6)
    arm.enabled(CSP)
    away = np.degrees(swinging(arm, 1200))
    assert np.abs(away).max() < 0.5
    assert np.sqrt((away[300:] ** 2).mean(axis=0)).max() < 0.2


def test_position_and_speed_are_reported_as_they_are():
    arm = SixDrives(BENT).enabled(CSP)
    swinging(arm, 100)
    assert np.array(arm.raw(keys.POSITION)) / arm.counts == pytest.approx(arm.q, abs=1e-4)
    assert np.array(arm.raw(keys.VELOCITY)) / arm.counts == pytest.approx(arm.qd, abs=0.02)


def test_the_arm_does_not_drop_when_its_brakes_open():
    arm = SixDrives(BENT)
    before = arm.q
    arm.enabled(CSP)
    arm.cycles(250)
    assert np.degrees(np.abs(arm.q - before).max()) < 0.05


def test_a_torque_offset_that_is_there_when_brakes_open_counts_once():
    arm = SixDrives(BENT)
    before = arm.q
    rated = np.array(arm.raw(keys.RATED_TORQUE)) * 1e-3 * ARM.gear_ratio
    arm.set(keys.TORQUE_OFFSET, np.round(1000 * static_torque(before) / rated).astype(int))
    arm.enabled(CSP)
    away = []
    for _ in range(100):
        arm.cycles(1)
        away.append(np.degrees(np.abs(arm.q - before).max()))
    assert max(away) < 0.05


def test_csp_after_cst_goes_on_with_the_torque_that_held_the_arm():
    arm = SixDrives(BENT)
    rated = np.array(arm.raw(keys.RATED_TORQUE)) * 1e-3 * ARM.gear_ratio
    arm.set(keys.TARGET_TORQUE, np.round(1000 * static_torque(arm.q) / rated).astype(int))
    arm.enabled(CST)
    arm.cycles(5)
    before = arm.q
    arm.set(keys.TARGET_POSITION, arm.raw(keys.POSITION))
    arm.set(keys.MODE, [CSP] * 6)
    arm.cycles(25)
    assert np.degrees(np.abs(arm.q - before).max()) < 0.05


def test_on_its_brakes_the_arm_neither_moves_nor_takes_current():
    arm = SixDrives(BENT)
    before = arm.q
    arm.body.push(np.full(6, 20.0))
    arm.cycles(100)
    assert arm.q == pytest.approx(before, abs=1e-12)
    assert arm.raw(keys.CURRENT) == arm.raw(keys.TORQUE) == [0] * 6


def test_one_disabled_joint_stays_while_the_others_move():
    arm = SixDrives(BENT).enabled(CSP)
    arm.registers[2][keys.CONTROLWORD] = 0x00
    arm.cycles(50)
    still = arm.q[2]
    swinging(arm, 200)
    assert np.degrees(abs(arm.q[2] - still)) < 0.2
    assert arm.registers[2][keys.CURRENT] == 0
    assert np.abs(arm.qd[[0, 1, 3]]).min() > 0.05


def test_gravity_torque_in_cst_holds_the_arm():
    arm = SixDrives(BENT)
    start = arm.q
    rated = np.array(arm.raw(keys.RATED_TORQUE)) * 1e-3 * ARM.gear_ratio
    arm.set(keys.TARGET_TORQUE, np.round(1000 * static_torque(start) / rated).astype(int))
    arm.enabled(CST)
    arm.cycles(125)
    assert np.degrees(np.abs(arm.q - start).max()) < 2.0
    assert np.abs(arm.qd).max() < 0.1


def test_without_torque_in_cst_the_arm_falls():
    arm = SixDrives(BENT)
    start = arm.q
    arm.enabled(CST)
    arm.cycles(60)
    assert np.degrees(np.abs(arm.q - start)[1]) > 3.0


def test_reported_torque_at_rest_is_gravity_within_friction():
    """Independent: MuJoCo's inverse dynamics of the true links, not the servo."""
    arm = SixDrives(BENT).enabled(CSP)
    arm.cycles(125)
    away = reported_torque(arm) - static_torque(arm.q)
    assert (np.abs(away) < 0.15 * ARM.effort_max).all()
    assert np.abs(static_torque(arm.q)).max() > 60.0


def test_a_payload_shows_in_the_torque_by_as_much_as_it_weighs():
    arm = SixDrives(BENT).enabled(CSP)
    arm.cycles(125)
    without = reported_torque(arm)
    load = Payload(5.0, (0.0, 0.0, 0.1))
    arm.body.mount(load)
    arm.cycles(250)
    more = reported_torque(arm) - without
    expected = static_torque(arm.q, load) - static_torque(arm.q)
    gain = np.array([j.drive.gain_nm_a for j in draw_truth("lab6", 0).joints]) / ARM.drive_gains
    assert expected[1] < -20.0 or expected[1] > 20.0
    assert more[[1, 2]] * gain[[1, 2]] == pytest.approx(expected[[1, 2]], rel=0.25, abs=5.0)


def test_the_current_is_what_the_drive_takes_for_that_torque():
    arm = SixDrives(BENT).enabled(CSP)
    swinging(arm, 100)
    seen = arm.body.seen
    assert reported_current(arm) == pytest.approx([s.current for s in seen], abs=0.01)
    assert reported_torque(arm) == pytest.approx(
        np.array([s.current for s in seen]) * ARM.drive_gains, abs=0.6
    )


@pytest.mark.thorough
def test_true_motor_torque_by_eq_16_moves_the_arm_as_inverse_dynamics_says():
    """Constant speed: motor torque of the true drive minus gravity is friction, and no more."""
    arm = SixDrives(BENT).enabled(CSP)
    start = arm.q
    gaps = []
    for k in range(1, 400):
        way = 0.2 * max(0.0, k - 20) * CYCLE_S
        arm.aim(start + np.array([0.0, way, 0.0, 0.0, 0.0, 0.0]))
        arm.cycles(1)
        if k > 150:
            current = arm.body._plant.joints.states["current"][1]
            drive = draw_truth("lab6", 0).joints[1].drive
            motor = (
                drive.square_nm_a2 * abs(current) * current
                + drive.gain_nm_a * current
                + drive.constant_nm
            )
            gaps.append(motor - static_torque(arm.q)[1] - arm.body._plant.friction[1])
    assert np.mean(gaps) == pytest.approx(0.0, abs=1.0)


def test_a_quick_stop_slows_the_joints_down_as_6085h_says():
    arm = SixDrives(BENT).enabled(CSP)
    deceleration = 4.0
    arm.set(keys.QUICK_STOP_DECELERATION, np.round(deceleration * arm.counts).astype(int))
    swinging(arm, 150)
    speed = arm.qd
    fastest = int(np.abs(speed).argmax())
    arm.tell(0x02)
    cycles, speeds = 1, [arm.qd[fastest]]
    while arm.states != {State.SWITCH_ON_DISABLED}:
        arm.cycles(1)
        speeds.append(arm.qd[fastest])
        cycles += 1
    ramp = np.abs(speeds[5 : int(0.8 * np.abs(speed).max() / deceleration / CYCLE_S)])
    slope = np.polyfit(CYCLE_S * np.arange(len(ramp)), ramp, 1)[0]
    assert slope == pytest.approx(-deceleration, rel=0.05)
    assert cycles * CYCLE_S == pytest.approx(np.abs(speed).max() / deceleration, abs=0.06)
    arm.cycles(30)
    assert np.abs(arm.qd).max() == 0.0
    assert arm.emergencies == []


def test_a_moving_joint_without_voltage_coasts_and_is_caught_by_its_brake():
    arm = SixDrives(BENT).enabled(CSP)
    swinging(arm, 150)
    arm.tell(0x00, cycles=2)
    assert np.abs(arm.qd).max() > 0.5
    arm.cycles(13)
    arm.cycles(75)
    assert np.abs(arm.qd).max() == 0.0
    rested = arm.q
    arm.cycles(100)
    assert arm.q == pytest.approx(rested, abs=1e-9)


def test_a_push_that_is_too_strong_is_an_over_current_of_that_axis():
    arm = SixDrives(BENT).enabled(CSP)
    arm.body.push(np.array([0.0, 0.0, 0.0, 70.0, 0.0, 0.0]))
    arm.cycles(60)
    assert arm.emergencies[0][0] == 3
    assert arm.emergencies[0][1] in (0x2310, 0x8611)
    assert arm.drives[3].state in (State.FAULT_REACTION_ACTIVE, State.FAULT)
    assert arm.drives[0].state is State.OPERATION_ENABLED


def test_a_torque_limit_lets_a_joint_fall_behind_instead_of_pulling_harder():
    arm = SixDrives(BENT).enabled(CSP)
    arm.cycles(50)
    arm.registers[1][keys.MAX_TORQUE] = 100
    arm.cycles(3)
    rated = arm.registers[1][keys.RATED_TORQUE] * 1e-3 * ARM.gear_ratio[1]
    assert abs(reported_torque(arm)[1]) < 0.13 * rated
    assert arm.registers[1][keys.STATUSWORD] & 0x0800
    arm.cycles(200)
    assert (1, 0x8611) in arm.emergencies


def test_feed_forward_by_60b2h_takes_the_place_of_the_integrator():
    plain, helped = SixDrives(BENT).enabled(CSP), SixDrives(BENT).enabled(CSP)
    load = Payload(7.0, (0.0, 0.0, 0.2))
    rated = np.array(helped.raw(keys.RATED_TORQUE)) * 1e-3 * ARM.gear_ratio
    more = static_torque(BENT, load) - static_torque(BENT)
    start = plain.q
    worst = []
    for arm, share in ((plain, 0.0), (helped, 1.0)):
        arm.set(keys.TORQUE_OFFSET, np.round(share * 1000 * more / rated).astype(int))
        arm.body.mount(load)
        sag = []
        for _ in range(25):
            arm.cycles(1)
            sag.append(np.abs(arm.q - start))
        worst.append(np.max(sag, axis=0)[1])
    assert worst[1] < 0.4 * worst[0]


def test_an_arm_that_was_hung_onto_while_braked_still_stands_where_it_was():
    arm = SixDrives(BENT)
    before = arm.q
    arm.body.mount(Payload(5.0, (0.0, 0.0, 0.1)))
    arm.cycles(50)
    assert arm.q == pytest.approx(before, abs=1e-12)
    arm.enabled(CSP)
    arm.cycles(25)
    assert np.degrees(np.abs(arm.q - before).max()) < 0.1


def test_temperature_is_reported_in_tenths_of_a_degree():
    arm = SixDrives(BENT, temperature_c=41.5)
    arm.cycles(1)
    assert arm.raw(keys.MOTOR_TEMPERATURE) == pytest.approx([415] * 6, abs=3)
    arm.body.heat(2, 95.0)
    arm.cycles(1)
    assert arm.raw(keys.MOTOR_TEMPERATURE)[2] == pytest.approx(950, abs=3)


def test_the_same_seed_gives_the_same_registers():
    one, two = (SixDrives(BENT, seed=3).enabled(CSP) for _ in range(2))
    for arm in (one, two):
        swinging(arm, 50)
    assert one.registers == two.registers


def test_an_arm_whose_simulation_has_gone_wrong_is_back_where_it_was():
    arm = SixDrives(BENT).enabled(CSP)
    arm.cycles(20)
    before = arm.q
    arm.body._plant.plant.data.qvel[3] = 500.0
    arm.cycles(1)
    assert arm.emergencies == [(3, 0x8611)]
    assert arm.q == pytest.approx(before, abs=1e-3)
    arm.cycles(100)
    assert np.isfinite(arm.raw(keys.POSITION)).all()
    assert np.degrees(np.abs(arm.q - before).max()) < 3.0


def test_a_jump_of_all_targets_faults_within_the_cycle_and_moves_the_arm_little():
    arm = SixDrives(BENT)
    before = arm.q
    arm.set(keys.MODE, [CSP] * 6)
    arm.aim(before + 1.0)
    for word in (0x06, 0x07, 0x0F):
        arm.tell(word)
    assert sorted(arm.emergencies) == [(axis, 0x8611) for axis in range(6)]
    arm.cycles(125)
    assert np.degrees(np.abs(arm.q - before).max()) < 25.0
    assert arm.states == {State.FAULT}
