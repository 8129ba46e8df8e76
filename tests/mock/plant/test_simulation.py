"""The mock arm in motion: convergence, control, drives, loads, heat."""

from dataclasses import replace

import numpy as np
import pytest

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil_mock_robot.plant.model import build_plant
from hil_mock_robot.plant.records import SERVO_S, timing_of
from hil_mock_robot.plant.simulation import Setting, Simulation
from hil_mock_robot.plant.truth import draw_truth
from tests.support.mock_motions import blend, fourier, hold

UPRIGHT = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
BENT = np.radians([40.0, -60.0, 70.0, -120.0, 50.0, -80.0])
NOTHING = Payload()


def switched_on(truth, q=UPRIGHT, substep_hz=1000.0, **setting):
    simulation = Simulation(
        truth, Setting(load_arm(truth.arm).rate_hz, substep_hz, **setting), np.array(q)
    )
    simulation.settle()
    return simulation


def dwell_and_fourier(rate_hz):
    way = blend(UPRIGHT, BENT, rate_hz, 2.5)
    parts = [way, hold(way, rate_hz, 0.5)]
    parts.append(fourier(BENT, rate_hz, seed=3, peak_rad_s=1.0))
    parts.append(hold(parts[-1], rate_hz, 0.5))
    return np.concatenate(parts)


def motor_torque(truth, current):
    """Eq. 16 written out with the truth's numbers."""
    drives = [joint.drive for joint in truth.joints]
    k2, k1, k0 = (
        np.array([getattr(drive, key) for drive in drives])
        for key in ("square_nm_a2", "gain_nm_a", "constant_nm")
    )
    return k2 * current * np.abs(current) + k1 * current + k0


def static_torque(truth, q, payload=NOTHING):
    arm, zero = load_arm(truth.arm), np.zeros(6)
    plant = build_plant(arm.dh, truth.links, [1.0] * 6, payload, (0, 0, -9.81), 1e-3)
    return plant.inverse(q, zero, zero)


@pytest.mark.thorough
@pytest.mark.parametrize("profile", ["full", "ideal"])
def test_1_khz_and_4_khz_agree_within_noise(profile):
    truth = draw_truth("ur5", 7, profile)
    path = dwell_and_fourier(125)
    coarse, fine = (
        switched_on(truth, substep_hz=hz).advance(path)["current"] for hz in (1000.0, 4000.0)
    )
    noise = np.array([joint.sensor.rest_a for joint in truth.joints])
    assert (np.sqrt(np.mean((coarse - fine) ** 2, axis=0)) < 0.25 * noise).all()


@pytest.mark.parametrize("arm", ["ur5", "lab6"])
def test_servo_tracks_within_3_mrad_and_settles_to_rest(arm):
    truth = draw_truth(arm, 4)
    start = UPRIGHT if arm == "ur5" else np.zeros(6)
    rate = load_arm(arm).rate_hz
    way = blend(start, start + np.radians([60, -40, 50, -60, 60, 60]), rate, 2.0)
    path = np.concatenate((way, hold(way, rate, 1.0)))
    assert np.abs(path[:, 1]).max() > np.radians(55)
    samples = switched_on(truth, start).advance(path)
    assert samples.fault == 0
    assert np.abs(samples["q"] - path[:, 0]).max() < 3e-3
    assert np.abs(samples["qd"][-int(0.3 * rate) :]).max() < 1e-3


def test_standstill_current_remembers_the_approach_direction():
    truth = draw_truth("ur5", 6)
    coulomb = np.array([joint.friction.coulomb_nm for joint in truth.joints])
    stuck = {}
    for direction in (1, -1):
        away = BENT - direction * np.radians(25)
        simulation = switched_on(truth, away)
        way = blend(away, BENT, 125, 1.5)
        samples = simulation.advance(np.concatenate((way, hold(way, 125, 0.4))))
        torque = motor_torque(truth, samples["current"][-1])
        stuck[direction] = (torque - static_torque(truth, samples["q"][-1])) / coulomb
    # Up to 0.5 Fc apart is what a settled UR shows; every joint must lean where it came from.
    assert (stuck[1] - stuck[-1] > 0.2).all()
    assert np.abs(np.concatenate(list(stuck.values()))).max() < 1.8


@pytest.mark.thorough
def test_stuck_friction_is_spread_and_not_always_saturated():
    truth = draw_truth("ur5", 6)
    rng = np.random.default_rng(1)
    simulation, at, shares = switched_on(truth), UPRIGHT, []
    coulomb = np.array([joint.friction.coulomb_nm for joint in truth.joints])
    for _ in range(25):
        goal = UPRIGHT + rng.uniform(-1, 1, 6)
        way = blend(at, goal, 125, 2.0)
        samples = simulation.advance(np.concatenate((way, hold(way, 125, 0.3))))
        torque = motor_torque(truth, samples["current"][-1])
        stuck = torque - static_torque(truth, samples["q"][-1])
        shares.append(stuck * np.sign(goal - at) / coulomb)
        at = goal
    shares = np.array(shares)
    assert (shares.std(axis=0) > 0.04).all()
    assert (np.median(shares, axis=0) < 1.15).all()
    assert (np.abs(shares).min(axis=0) < 0.6).all()


@pytest.mark.thorough
def test_ideal_current_is_rigid_body_plus_coulomb_viscous_through_the_gain():
    truth = draw_truth("ur5", 8, "ideal")
    simulation = switched_on(truth)
    path = fourier(UPRIGHT, 125, seed=5, peak_rad_s=1.0)
    samples = simulation.advance(path)
    q, qd = samples["q"], samples["qd"]
    qdd = np.gradient(qd, 1 / 125, axis=0)
    arm = load_arm("ur5")
    rotors = [joint.drive.rotor_kgm2 for joint in truth.joints]
    plant = build_plant(arm.dh, truth.links, rotors, Payload(), (0, 0, -9.81), 1e-3)
    rigid = np.array([plant.inverse(*row) for row in zip(q, qd, qdd, strict=True)])
    laws = [joint.friction for joint in truth.joints]
    friction = np.array([f.coulomb_nm for f in laws]) * np.sign(qd)
    friction += np.array([f.viscous_nm for f in laws]) * qd
    gain = np.array([joint.drive.gain_nm_a for joint in truth.joints])
    error = samples["current"] - (rigid + friction) / gain
    steady = np.abs(qd) > 0.05
    scale = np.abs(samples["current"]).max(axis=0)
    for j in range(6):
        assert np.sqrt(np.mean(error[steady[:, j], j] ** 2)) < 0.02 * scale[j]


def test_drive_follows_eq_16_square_term_included():
    truth = draw_truth("ur5", 1, "ideal")
    bent = [replace(j, drive=replace(j.drive, square_nm_a2=-0.2)) for j in truth.joints]
    curved = replace(truth, joints=tuple(bent))
    pose = np.radians([0.0, -20.0, 30.0, -90.0, 0.0, 0.0])
    current = {}
    for name, robot in (("straight", truth), ("curved", curved)):
        simulation = switched_on(robot, pose)
        rest = np.repeat(simulation.setpoint[None], 1500, axis=0)
        samples = simulation.advance(rest)
        current[name] = samples["current"][-1]
        gravity = static_torque(robot, samples["q"][-1])
        assert motor_torque(robot, current[name]) == pytest.approx(gravity, abs=0.05)
    assert abs(current["curved"][1]) > 1.05 * abs(current["straight"][1])


def test_payload_changes_the_current_as_statics_predict():
    truth = draw_truth("ur5", 9, "ideal")
    simulation = switched_on(truth, BENT)
    rest = np.repeat(simulation.setpoint[None], 1000, axis=0)
    before = simulation.advance(rest)["current"][-1]
    load = Payload(3.0, (0.0, 0.02, 0.05))
    simulation.set_payloads(load, load)
    after = simulation.advance(rest)["current"][-1]
    added = static_torque(truth, BENT, load) - static_torque(truth, BENT)
    gain = np.array([joint.drive.gain_nm_a for joint in truth.joints])
    assert after - before == pytest.approx(added / gain, abs=0.03)


def test_wrongly_declared_payload_still_weighs_what_is_mounted():
    truth = draw_truth("ur5", 9, "ideal")
    heavy, light = Payload(3.0, (0.0, 0.02, 0.05)), Payload(1.0, (0.0, 0.02, 0.05))
    currents = []
    for declared in (heavy, light):
        simulation = switched_on(truth, BENT)
        simulation.set_payloads(heavy, declared)
        rest = np.repeat(simulation.setpoint[None], 1500, axis=0)
        currents.append(simulation.advance(rest)["current"][-1])
    assert currents[0] == pytest.approx(currents[1], abs=0.05)


@pytest.mark.thorough
def test_joints_warm_up_by_working_and_settle_20_k_above_the_room():
    truth = draw_truth("ur5", 2)
    fast = tuple(replace(j, thermal=replace(j.thermal, tau_s=20.0)) for j in truth.joints)
    simulation = switched_on(replace(truth, joints=fast))
    cold = simulation.celsius
    for seed in range(8):
        simulation.advance(fourier(UPRIGHT, 125, seed, peak_rad_s=1.0))
    rise = simulation.celsius - truth.ambient_c
    assert cold == pytest.approx(np.full(6, truth.ambient_c), abs=0.5)
    assert (rise > 8).all()
    assert (rise < 40).all()


def test_warm_arm_needs_less_current_for_the_same_motion():
    truth = draw_truth("ur5", 2)
    path = fourier(UPRIGHT, 125, 1, peak_rad_s=1.0)
    work = {}
    for celsius in (22.0, 45.0):
        samples = switched_on(truth, temperature_c=celsius).advance(path)
        work[celsius] = np.sum(motor_torque(truth, samples["current"]) * samples["qd"], axis=0)
    ratio = work[45.0] / work[22.0]
    assert (ratio > 0.6).all()
    assert (ratio < 0.95).all()


def test_cutting_the_samples_into_blocks_changes_nothing():
    truth = draw_truth("ur5", 2)
    path = fourier(UPRIGHT, 125, 4)[:100]
    whole = switched_on(truth).advance(path).values
    simulation = switched_on(truth)
    pieces = [simulation.advance(path[k : k + 7]).values for k in range(0, 100, 7)]
    assert np.array_equal(whole, np.concatenate(pieces))


def test_timing_must_be_whole():
    assert timing_of(125, 4000).substeps == 32
    assert timing_of(250, 4000).per_servo == round(4000 * SERVO_S)
    for rate, substep in ((125, 1100), (300, 1000), (125, 500)):
        with pytest.raises(SpecError, match="substep_hz"):
            timing_of(rate, substep)
