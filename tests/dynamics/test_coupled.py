"""An arm in its motors' coordinates: the joints' energy, and rotors that stay the motors'."""

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil.dynamics import RobotModel, base_parameters, load_model
from tests.support.dynamics_arms import motion

ROTORS = np.array([0.36, 0.36, 0.1, 0.03, 0.05, 0.01])
LOAD = Payload(1.5, (0.02, -0.01, 0.05))


def joints(motors):
    """By hand: motor 6 counts q5 + q6."""
    out = np.array(motors)
    out[:, 5] -= out[:, 4]
    return out


@pytest.fixture(scope="module")
def robots():
    return load_model("tx40@motors", ROTORS), load_model("tx40")


@pytest.mark.parametrize("loaded", [False, True], ids=["bare", "loaded"])
@pytest.mark.parametrize("samples", [400, 4000], ids=["few", "many"])
def test_power_of_the_motors_is_the_change_of_energy(robots, loaded, samples) -> None:
    coupled, serial = (one.with_payload(LOAD) if loaded else one for one in robots)
    t, dt = np.linspace(0.0, samples * 5e-4, samples, retstep=True)
    phase = np.arange(1, 7)
    s, sd = np.sin(np.outer(t, phase)), phase * np.cos(np.outer(t, phase))
    sdd = -(phase**2) * s
    q, qd = joints(s), joints(sd)
    M = serial.mass_matrix(q)
    kinetic = 0.5 * np.einsum("ti,tij,tj->t", qd, M, qd) + 0.5 * sd**2 @ ROTORS
    # Gravity's power in the joints, for the potential energy is not to be had.
    gained = np.gradient(kinetic, dt) + np.sum(serial.gravity(q) * qd, axis=1)
    power = np.sum(coupled.inverse_dynamics(s, sd, sdd) * sd, axis=1)
    np.testing.assert_allclose(power[2:-2], gained[2:-2], atol=2e-4 * np.abs(gained).max())


def test_regressor_times_parameters_is_the_torque(robots) -> None:
    coupled, _ = robots
    s, sd, sdd = motion(30)
    torque = coupled.regressor(s, sd, sdd) @ coupled.parameters()
    np.testing.assert_allclose(torque, coupled.inverse_dynamics(s, sd, sdd).ravel(), atol=1e-10)
    some = np.array([3, 44, 61, 65])
    np.testing.assert_allclose(
        coupled.regressor(s, sd, sdd, columns=some), coupled.regressor(s, sd, sdd)[:, some]
    )


def test_derivatives_are_those_of_finite_differences(robots) -> None:
    coupled, _ = robots
    at = motion(3)
    for found, which in zip(coupled.inverse_dynamics_derivatives(*at), range(3), strict=True):
        for j in range(6):
            up, down = ([x.copy() for x in at] for _ in range(2))
            up[which][:, j] += 1e-6
            down[which][:, j] -= 1e-6
            slope = (coupled.inverse_dynamics(*up) - coupled.inverse_dynamics(*down)) / 2e-6
            np.testing.assert_allclose(found[:, :, j], slope, atol=1e-6)


def test_inertia_is_positive_and_symmetric_with_the_rotors_on_the_diagonal(robots) -> None:
    coupled, _ = robots
    bare = load_model("tx40@motors")
    s = motion(10)[0]
    M = coupled.mass_matrix(s)
    assert np.all(np.linalg.eigvalsh(M) > 0)
    np.testing.assert_allclose(M - bare.mass_matrix(s), np.broadcast_to(np.diag(ROTORS), M.shape))


def test_every_motor_has_a_rotor_of_its_own_to_identify() -> None:
    # In joint coordinates, too, all rotors but the first two count beside the links.
    assert base_parameters(load_model("tx40@motors")).rank == 40


def test_limits_hold_every_position_of_the_joints(robots) -> None:
    coupled, serial = robots
    random = np.random.default_rng(0)
    q = random.uniform(serial.q_min, serial.q_max, (200, 6))
    s = q.copy()
    s[:, 5] += q[:, 4]
    assert np.all((coupled.q_min <= s) & (s <= coupled.q_max))
    np.testing.assert_allclose(coupled.flange_pose(s), serial.flange_pose(q), atol=1e-12)


def test_a_model_file_finds_it_again(robots) -> None:
    coupled, _ = robots
    again = RobotModel.from_dict(coupled.with_payload(LOAD).to_dict())
    at = motion(5)
    np.testing.assert_allclose(
        again.inverse_dynamics(*at), coupled.with_payload(LOAD).inverse_dynamics(*at)
    )


def test_an_arm_without_coupling_has_no_motor_side() -> None:
    with pytest.raises(SpecError, match="every motor of this arm moves one joint only"):
        load_model("ur5@motors")
