"""Robot models against independent sources: MuJoCo, the textbook DH chain, published numbers."""

import subprocess
import sys

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import DataError, SpecError
from hil.dynamics import RobotModel, load_model, payload_parameters
from tests.support.dynamics_arms import UR_ARMS, dh_chain, mjcf, motion, mujoco_torques

ROTORS = (0.75, 0.74, 0.62, 0.11, 0.12, 0.13)
LOAD = Payload(2.8, (0.03, -0.15, 0.06), (0.011, 0.014, 0.009, 0.001, -0.002, 0.0005))


@pytest.mark.parametrize("name", ["ur5", "ur10e"])
def test_inverse_dynamics_equals_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    q, qd, qdd = motion(50)
    peer = mujoco.MjModel.from_xml_string(mjcf(name, ROTORS))
    ours = RobotModel.from_arm(name, ROTORS).inverse_dynamics(q, qd, qdd)
    np.testing.assert_allclose(ours, mujoco_torques(peer, q, qd, qdd), atol=1e-9)


@pytest.mark.parametrize("name", ["ur3", "ur5e"])
def test_mass_matrix_equals_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    peer = mujoco.MjModel.from_xml_string(mjcf(name, ROTORS))
    data, q = mujoco.MjData(peer), motion(10)[0]
    for sample, ours in zip(q, RobotModel.from_arm(name, ROTORS).mass_matrix(q), strict=True):
        data.qpos[:] = sample
        mujoco.mj_forward(peer, data)
        theirs = np.zeros((6, 6))
        mujoco.mj_fullM(peer, data, theirs)
        np.testing.assert_allclose(ours, theirs, atol=1e-10)


@pytest.mark.parametrize("name", ["ur5", "ur10"])
def test_payload_adds_what_a_mujoco_body_adds(name):
    mujoco = pytest.importorskip("mujoco")
    q, qd, qdd = motion(30)
    bare = mujoco_torques(mujoco.MjModel.from_xml_string(mjcf(name)), q, qd, qdd)
    loaded = mujoco.MjModel.from_xml_string(mjcf(name, payload=LOAD))
    added = RobotModel.from_arm(name).payload_effort(LOAD, q, qd, qdd)
    np.testing.assert_allclose(added, mujoco_torques(loaded, q, qd, qdd) - bare, atol=1e-9)


@pytest.mark.parametrize("name", [*UR_ARMS, "lab6"])
def test_flange_pose_equals_the_textbook_dh_chain(name):
    q = motion(20)[0]
    expected = [dh_chain(name, sample)[-1] for sample in q]
    np.testing.assert_allclose(RobotModel.from_arm(name).flange_pose(q), expected, atol=1e-12)


def test_ur5_flange_at_zero_is_where_the_published_dimensions_put_it():
    # Stretched out along −x: a2 + a3 behind, d4 + d6 to the side, d1 − d5 above the base.
    pose = RobotModel.from_arm("ur5").flange_pose(np.zeros((1, 6)))[0]
    np.testing.assert_allclose(pose[:3, 3], [-0.81725, -0.19145, -0.005491], atol=1e-9)


def test_gravity_of_a_tilted_base_turns_with_it():
    q = motion(5)[0]
    upright, hanging = RobotModel.from_arm("ur5"), RobotModel.from_arm("ur5", gravity=(0, 0, 9.81))
    np.testing.assert_allclose(hanging.gravity(q), -upright.gravity(q), atol=1e-12)
    on_a_wall = RobotModel.from_arm("ur5", gravity=(-9.81, 0, 0)).gravity(q)
    assert np.abs(on_a_wall[:, 0]).max() > 1.0
    assert np.abs(upright.gravity(q)[:, 0]).max() < 1e-9


@pytest.mark.parametrize("rotors", [None, ROTORS])
@pytest.mark.parametrize("name", ["ur5", "lab6"])
def test_regressor_times_parameters_is_inverse_dynamics(name, rotors):
    model = RobotModel.from_arm(name, rotors)
    q, qd, qdd = motion(40)
    torque = model.inverse_dynamics(q, qd, qdd).ravel()
    np.testing.assert_allclose(model.regressor(q, qd, qdd) @ model.parameters(), torque, atol=1e-9)


def test_regressor_rows_are_sample_major():
    model = RobotModel.from_arm("ur5")
    q, qd, qdd = motion(3)
    whole = model.regressor(q, qd, qdd)
    last = model.regressor(q[2:], qd[2:], qdd[2:])
    assert whole.shape == (18, 66)
    np.testing.assert_array_equal(whole[12:], last)
    np.testing.assert_array_equal(whole[12:, 60:], np.diag(qdd[2]))


def test_gravity_regressor_times_parameters_is_gravity():
    model = RobotModel.from_arm("ur10e")
    q = motion(20)[0]
    columns = model.gravity_regressor(q)
    torque = columns @ model.parameters(rotor=False)
    np.testing.assert_allclose(torque, model.gravity(q).ravel(), atol=1e-9)
    inertias = [i for i, name in enumerate(model.parameter_names(rotor=False)) if "I" in name]
    assert np.abs(columns[:, inertias]).max() < 1e-12


def test_payload_regressor_times_its_ten_parameters_is_the_payload_effort():
    model = RobotModel.from_arm("ur5e")
    q, qd, qdd = motion(20)
    effort = model.payload_effort(LOAD, q, qd, qdd)
    predicted = model.payload_regressor(q, qd, qdd) @ payload_parameters(LOAD)
    np.testing.assert_allclose(predicted, effort.ravel(), atol=1e-9)


def test_payload_held_level_acts_with_its_lever_arm():
    # At zero the UR5 is stretched out level, its flange a2 + a3 away from joint 2.
    load = Payload(mass=1.5)
    q = np.zeros((1, 6))
    still = np.zeros((1, 6))
    effort = RobotModel.from_arm("ur5").payload_effort(load, q, still, still)
    assert effort[0, 1] == pytest.approx(-1.5 * 9.81 * 0.81725, rel=1e-9)


def test_parameter_names_match_the_columns():
    model = RobotModel.from_arm("ur5", ROTORS)
    named = dict(zip(model.parameter_names(), model.parameters(), strict=True))
    assert named["m_2"] == pytest.approx(8.393)
    assert named["Ia_3"] == pytest.approx(0.62)
    assert len(model.parameter_names(rotor=False)) == 60


def test_an_empty_payload_changes_nothing():
    model = RobotModel.from_arm("ur5")
    assert model.with_payload(Payload()) is model


def test_limits_come_from_the_arm():
    model = load_model("ur10")
    assert model.n == 6
    assert model.joint_names[1] == "shoulder_lift_joint"
    np.testing.assert_allclose(model.effort_max, [330, 330, 150, 56, 56, 56])
    np.testing.assert_allclose(np.degrees(model.qd_max), [120, 120, 180, 180, 180, 180])
    np.testing.assert_allclose(np.degrees(model.q_min), -360)


def test_unknown_arm_is_refused_with_the_known_names():
    with pytest.raises(SpecError, match="ur7") as caught:
        load_model("ur7")
    assert "ur10e" in caught.value.hint


def test_wrong_number_of_rotor_inertias_is_refused():
    with pytest.raises(SpecError, match="3 rotor inertias were given for the 6 joints"):
        RobotModel.from_arm("ur5", [1, 2, 3])


def test_data_of_another_arm_are_refused():
    with pytest.raises(DataError, match="rows of 6 joints"):
        RobotModel.from_arm("ur5").gravity(np.zeros((4, 7)))


def test_importing_hil_does_not_load_pinocchio():
    code = (
        "import sys, hil, hil.dynamics, hil.dynamics.collision;"
        "sys.exit('pinocchio' in sys.modules or 'mujoco' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
