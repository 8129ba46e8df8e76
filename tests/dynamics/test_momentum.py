"""Momentum and Cᵀq̇ against Pinocchio's mass matrix and its derivative, and with loads."""

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.dynamics import RobotModel, base_parameters
from tests.support.dynamics_arms import motion

LOAD = Payload(3.0, (0.02, -0.05, 0.08), (0.01, 0.012, 0.008, 0.001, 0.0, -0.002))
STEP = 1e-6
SLIDING = """<robot name="gantry">
<link name="base"/><link name="cart"><inertial><origin xyz="0.1 0.2 0.3"/><mass value="4"/>
<inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0.01" ixz="0" iyz="0.02"/></inertial></link>
<link name="arm"><inertial><origin xyz="0.2 -0.1 0.1"/><mass value="2"/>
<inertia ixx="0.05" iyy="0.06" izz="0.04" ixy="0" ixz="0.01" iyz="0"/></inertial></link>
<link name="tip"><inertial><origin xyz="0 0.1 0.2"/><mass value="1"/>
<inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="x" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0.5"/>
<limit lower="-1" upper="1" effort="100" velocity="1"/></joint>
<joint name="r" type="revolute"><parent link="cart"/><child link="arm"/><axis xyz="0 1 0.3"/>
<origin xyz="0.1 0 0.4" rpy="0.3 0.2 0.1"/><limit lower="-3" upper="3" effort="50" velocity="2"/>
</joint>
<joint name="z" type="prismatic"><parent link="arm"/><child link="tip"/><axis xyz="0 0.2 1"/>
<origin xyz="0 0.2 0.1"/><limit lower="-1" upper="1" effort="50" velocity="1"/></joint></robot>"""


@pytest.fixture(params=["ur5", "tx40@motors", "sliding"])
def arm(request, tmp_path):
    if request.param != "sliding":
        return RobotModel.from_arm(request.param, rotor_inertia=[0.4, 0.5, 0.3, 0.1, 0.1, 0.1])
    (tmp_path / "a.urdf").write_text(SLIDING)
    return RobotModel.from_urdf(tmp_path / "a.urdf", rotor_inertia=[0.4, 0.1, 0.2])


def test_momentum_is_mass_matrix_times_velocity(arm) -> None:
    q, qd, _ = motion(20, arm.n)
    p, _ = arm.momentum(arm.parameters(), q, qd)
    np.testing.assert_allclose(p, np.einsum("sij,sj->si", arm.mass_matrix(q), qd), atol=1e-12)


def test_the_other_part_is_the_gradient_of_the_kinetic_energy(arm) -> None:
    q, qd, _ = motion(20, arm.n, seed=1)
    _, found = arm.momentum(arm.parameters(), q, qd)
    for j, step in enumerate(STEP * np.eye(arm.n)):
        change = (arm.mass_matrix(q + step) - arm.mass_matrix(q - step)) / (2 * STEP)
        energy = 0.5 * np.einsum("si,sij,sj->s", qd, change, qd)
        np.testing.assert_allclose(found[:, j], energy, atol=1e-7)


def test_the_momentum_changes_as_the_torques_say(arm) -> None:
    """dp/dt = τ − g + Cᵀq̇: what an observer without accelerations rests on."""
    q, qd, qdd = motion(20, arm.n, seed=2)
    phi, still = arm.parameters(), np.zeros_like(q)
    after, before = (arm.momentum(phi, q + s * STEP * qd, qd + s * STEP * qdd)[0] for s in (1, -1))
    forced = arm.torque(phi, q, qd, qdd) - arm.torque(phi, q, still, still)
    expected = forced + arm.momentum(phi, q, qd)[1]
    np.testing.assert_allclose((after - before) / (2 * STEP), expected, atol=1e-6)


def test_parameters_that_no_link_has_will_do(arm) -> None:
    q, qd, _ = motion(20, arm.n)
    base = base_parameters(arm, rotor=True)
    expanded = base.expand(base.combine(arm.parameters()))
    for mine, given in zip(
        arm.momentum(expanded, q, qd), arm.momentum(arm.parameters(), q, qd), strict=True
    ):
        np.testing.assert_allclose(mine, given, atol=1e-9)


def test_a_load_is_part_of_the_last_link(arm) -> None:
    q, qd, qdd = motion(20, arm.n)
    loaded = arm.loaded_parameters(arm.parameters(), LOAD)
    np.testing.assert_allclose(
        arm.torque(loaded, q, qd, qdd),
        arm.with_payload(LOAD).inverse_dynamics(q, qd, qdd),
        atol=1e-10,
    )
