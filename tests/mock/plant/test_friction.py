"""The mock's friction law on its own: memory, dissipation, and what it depends on."""

from dataclasses import replace

import numpy as np
import pytest

from hil_mock_robot.plant.friction import friction_laws, friction_torque, slip_elements
from hil_mock_robot.plant.truth import draw_truth

DT = 1e-3
WARM_C = 60.0
"""Above every Stribeck effect, so that only the slip elements have memory."""


class Joint:
    """One joint's friction driven by a prescribed speed."""

    def __init__(self, j=1, profile="full", **changes):
        truth = draw_truth("ur5", 2, profile)
        friction = replace(truth.joints[j].friction, offset_nm=0.0, **changes)
        drive = replace(truth.joints[j].drive, ripple_nm=0.0)
        joint = replace(truth.joints[j], friction=friction, drive=drive)
        one = replace(truth, joints=(joint,))
        self.friction, self.thermal = friction, joint.thermal
        self.law = friction_laws(one, DT)[0]
        self.shares, self.stiffness = slip_elements(one)[:, 0, :]
        self.forces = np.zeros_like(self.shares)
        self.reference_c = truth.reference_c

    def run(self, speeds, load=0.0, celsius=WARM_C, wear=1.0):
        return np.array(
            [
                friction_torque(
                    self.law, self.shares, self.stiffness, self.forces,
                    0.0, float(v), load, celsius, wear, DT,
                )
                for v in speeds
            ]
        )  # fmt: skip

    def steady(self, speed, **conditions):
        return self.run(np.full(800, speed), **conditions)[-1]

    def dry(self):
        return self.forces.sum()


def slow_cycle(amplitude, steps=2000):
    """Speeds of one sine period of position, slow enough for viscous friction not to matter."""
    position = amplitude * (1 - np.cos(np.linspace(0, 2 * np.pi, steps + 1)))
    return np.diff(position) / DT


@pytest.mark.thorough
def test_hysteresis_loop_closes():
    joint = Joint(viscous_nm=0.0, creep_s=1e9)
    joint.run(slow_cycle(5e-4))
    start = joint.dry()
    joint.run(slow_cycle(5e-4))
    assert joint.dry() == pytest.approx(start, rel=1e-3)


def test_small_inner_loop_returns_to_where_the_joint_turned_back():
    joint = Joint(viscous_nm=0.0, creep_s=1e9)
    joint.run(slow_cycle(5e-4)[:700])
    turned_at = joint.dry()
    joint.run(np.full(100, -1e-4 / 0.1))
    inside = joint.dry()
    joint.run(np.full(100, 1e-4 / 0.1))
    assert abs(inside - turned_at) > 0.3
    assert joint.dry() == pytest.approx(turned_at, rel=1e-3)


def test_force_at_a_position_depends_on_where_the_joint_turned_back():
    far, near = (Joint(viscous_nm=0.0, creep_s=1e9) for _ in range(2))
    far.run(np.r_[np.full(100, 8e-3), np.full(50, -8e-3)])
    near.run(np.r_[np.full(50, 8e-3), np.zeros(100)])
    assert abs(far.dry() - near.dry()) > 0.2 * far.friction.coulomb_nm


def test_dissipates_energy_over_every_closed_cycle():
    rng = np.random.default_rng(0)
    for amplitude in (5e-5, 3e-4, 2e-3, 0.2):
        joint = Joint(j=int(rng.integers(6)))
        cycle = slow_cycle(amplitude)
        joint.run(cycle, celsius=25.0)
        torque = joint.run(cycle, celsius=25.0)
        assert float(torque @ cycle) * DT > 0


@pytest.mark.parametrize("direction", [1, -1])
def test_stuck_joint_keeps_the_friction_its_approach_left(direction):
    joint = Joint()
    joint.run(np.full(300, direction * 0.1))
    stuck = joint.run(np.zeros(50))[-1]
    assert 0.5 < direction * stuck / joint.friction.coulomb_nm < 1.5


def test_stuck_friction_creeps_at_rest_but_not_to_zero():
    joint = Joint()
    joint.run(np.full(300, 0.1))
    at_first = joint.dry()
    joint.run(np.zeros(6000))
    assert 0.6 * at_first < joint.dry() < 0.95 * at_first


def test_breakaway_lies_between_2e_4_and_7e_4_rad():
    for j in range(6):
        joint = Joint(j=j, creep_s=1e9, viscous_nm=0.0, asymmetry=0.0)
        speed = 1e-3
        forces = joint.run(np.full(900, speed))
        travel = speed * DT * (1 + np.argmax(forces > 0.999 * forces[-1]))
        assert 2e-4 < travel < 7e-4


def test_sliding_friction_is_coulomb_plus_power_law_viscous():
    joint = Joint(asymmetry=0.0)
    f = joint.friction
    at_reference = {"celsius": joint.reference_c}
    joint.law["stribeck"] = 0.0
    for speed in (0.2, 1.0, 3.0):
        expected = f.coulomb_nm + f.viscous_nm * speed**f.viscous_power
        assert joint.steady(speed, **at_reference) == pytest.approx(expected, rel=1e-3)


def test_cold_joint_has_a_stribeck_peak_and_a_warm_one_has_none():
    cold = Joint(viscous_nm=0.0)
    assert cold.steady(0.005, celsius=22.0) > 1.05 * cold.steady(1.0, celsius=22.0)
    assert cold.steady(0.005) == pytest.approx(cold.steady(1.0), rel=1e-3)


def test_warming_thins_viscous_friction_more_than_coulomb_friction():
    joint = Joint(asymmetry=0.0)
    joint.law["stribeck"] = 0.0
    change = {}
    for speed in (1e-2, 3.0):
        cold, warm = (joint.steady(speed, celsius=c) for c in (30.0, 40.0))
        change[speed] = (warm - cold) / cold
    assert -0.06 < change[1e-2] < -0.02
    assert -0.14 < change[3.0] < change[1e-2]


def test_transmitted_torque_adds_its_share_of_friction():
    joint = Joint(asymmetry=0.0)
    added = joint.steady(0.5, load=-40.0) - joint.steady(0.5)
    assert added == pytest.approx(40.0 * joint.friction.load_share, rel=1e-3)


def test_forward_and_backward_friction_differ_by_the_asymmetry():
    joint = Joint(asymmetry=0.05)
    forward, backward = joint.steady(0.5), -joint.steady(-0.5)
    assert forward / backward == pytest.approx(1.05 / 0.95, rel=1e-3)


def test_wear_scales_friction():
    joint = Joint()
    assert joint.steady(0.5, wear=1.5) == pytest.approx(1.5 * joint.steady(0.5), rel=1e-6)


def test_ideal_friction_is_coulomb_viscous_at_any_temperature_load_and_history():
    joint = Joint(profile="ideal")
    f = joint.friction
    speeds = np.array([-1.5, 0.8, -0.1, 0.05, 2.0])
    expected = f.coulomb_nm * np.tanh(speeds / f.smooth_rad_s) + f.viscous_nm * speeds
    assert joint.run(speeds, load=50.0, celsius=20.0) == pytest.approx(expected, rel=1e-12)
