"""Kinematics of the mock UR controller and its force sensor, against independent references."""

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil_mock_robot.plant.model import build_plant, nominal_links
from hil_mock_robot.ur import kinematics
from hil_mock_robot.ur.kinematics import (
    Posture,
    frame_of,
    jacobian,
    lengths_of,
    pose_from,
    pose_inv,
    pose_of,
    pose_trans,
    postures,
    solve,
    tool_frame,
    tool_velocity,
)
from tests.support.dynamics_arms import UR_ARMS
from tests.support.ur_machine import machine_of, movej, pass_time

NO_TCP = np.zeros(6)
ANGLES = st.floats(-2 * np.pi, 2 * np.pi)
JOINTS = st.lists(ANGLES, min_size=6, max_size=6).map(np.array)
TOOLS = st.tuples(
    *[st.floats(-0.3, 0.3)] * 3, *[st.floats(-2.0, 2.0)] * 3
).map(np.array)  # fmt: skip


@cache
def plant_of(name):
    """The mock's own rigid body, with a body at the flange to look at."""
    arm = load_arm(name)
    seen = Payload(1.0, (0, 0, 0), (0.1, 0.1, 0.1, 0, 0, 0))
    return build_plant(arm.dh, nominal_links(arm), [0.1] * 6, seen, (0, 0, -9.81), 1e-3)


def at(plant, q, tcp):
    """Position, rotation and Jacobian of the tool by MuJoCo."""
    model, data = plant.model, plant.data
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    body = data.body("payload")
    flange = body.xmat.reshape(3, 3)
    position = body.xpos + flange @ tcp[:3]
    linear, angular = np.zeros((3, 6)), np.zeros((3, 6))
    mujoco.mj_jac(model, data, linear, angular, position, body.id)
    turn = flange @ Rotation.from_rotvec(tcp[3:]).as_matrix()
    return position, turn, np.vstack((linear, angular))


def matrix(pose):
    homogeneous = np.eye(4)
    homogeneous[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
    homogeneous[:3, 3] = pose[:3]
    return homogeneous


@pytest.mark.thorough
@pytest.mark.parametrize("name", UR_ARMS)
@given(q=JOINTS, qd=JOINTS, tcp=TOOLS)
@settings(max_examples=40, deadline=None)
def test_pose_jacobian_and_velocity_of_the_tool_are_those_of_mujoco(name, q, qd, tcp):
    arm = load_arm(name)
    position, turn, J = at(plant_of(name), q, tcp)
    pose = pose_of(arm, q, tcp)
    assert pose[:3] == pytest.approx(position, abs=1e-12)
    assert matrix(pose)[:3, :3] == pytest.approx(turn, abs=1e-9)
    assert jacobian(arm, q, tcp) == pytest.approx(J, abs=1e-12)
    assert tool_velocity(arm, q, qd, tcp) == pytest.approx(J @ qd, abs=1e-11)


def test_a_ur5_with_all_joints_at_zero_reaches_as_far_as_its_lengths_add_up():
    x, y, z = -(0.425 + 0.39225), -(0.10915 + 0.0823), 0.089159 - 0.09465
    pose = pose_of(load_arm("ur5"), np.zeros(6), NO_TCP)
    assert pose == pytest.approx([x, y, z, np.pi / 2, 0, 0], abs=1e-12)


@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda a: a @ a > 1e-3),
    angle=st.one_of(
        st.floats(0, np.pi),
        st.sampled_from([0.0, 1e-300, 1e-15, 1e-9, 1e-5]),
        st.sampled_from([1e-15, 1e-9, 1e-5, 0.0]).map(lambda less: np.pi - less),
    ),
)
def test_rotation_vectors_survive_the_way_to_a_matrix_and_back(axis, angle):
    vector = axis / np.linalg.norm(axis) * angle
    frame = frame_of([0, 0, 0, *vector])
    expected = Rotation.from_rotvec(vector)
    assert np.reshape(frame[:9], (3, 3)) == pytest.approx(expected.as_matrix(), abs=1e-14)
    back = np.array(pose_from(frame)[3:])
    assert np.linalg.norm(back) <= np.pi + 1e-15
    if angle < np.pi - 1e-7:
        assert back == pytest.approx(vector, abs=1e-14, rel=1e-8)
    # At half a turn the axis may point either way, but the turn is the same to all digits.
    assert (Rotation.from_rotvec(back) * expected.inv()).magnitude() < 2e-15


@given(a=TOOLS, b=TOOLS)
def test_poses_are_chained_and_undone_as_matrices_are(a, b):
    assert matrix(pose_trans(a, b)) == pytest.approx(matrix(a) @ matrix(b), abs=1e-14)
    assert matrix(pose_inv(a)) == pytest.approx(np.linalg.inv(matrix(a)), abs=1e-14)


def regular(q):
    """Away from the three singularities, where fewer than eight postures are distinct."""
    return min(abs(np.sin(q[4])), abs(np.sin(q[2]))) > 0.1


@pytest.mark.thorough
@pytest.mark.parametrize("name", UR_ARMS)
@given(q=JOINTS.filter(regular), tcp=TOOLS)
@settings(max_examples=40, deadline=None)
def test_the_inverse_returns_the_posture_that_it_is_asked_near_to(name, q, tcp):
    arm = load_arm(name)
    found = solve(arm, pose_of(arm, q, tcp), q, tcp)
    J = jacobian(arm, q, NO_TCP)
    if np.linalg.cond(J) < 1e3:
        assert found == pytest.approx(q, abs=1e-9)
    assert pose_of(arm, found, tcp)[:3] == pytest.approx(pose_of(arm, q, tcp)[:3], abs=1e-9)


@given(q=JOINTS.filter(regular), near=JOINTS)
@settings(max_examples=60, deadline=None)
def test_of_all_postures_the_nearest_within_the_limits_is_returned(q, near):
    arm = load_arm("ur5")
    flange = tool_frame(arm, q, NO_TCP)
    every = list(postures(lengths_of(arm), flange, near[5]))
    assert len(every) in (2, 4, 6, 8)
    for each in every:
        assert tool_frame(arm, each, NO_TCP) == pytest.approx(flange, abs=1e-9)
    best = solve(arm, pose_from(flange), near, NO_TCP)
    turned = np.array(every)[:, None] + 2 * np.pi * np.arange(-2, 3)[:, None]
    squares = np.where(np.abs(turned) <= 2 * np.pi + 1e-9, (turned - near) ** 2, np.inf)
    least = squares.min(axis=1).sum(axis=1).min()
    assert np.sum((best - near) ** 2) == pytest.approx(least, rel=1e-9)


def test_a_generic_pose_has_eight_postures():
    arm = load_arm("ur5")
    flange = tool_frame(arm, [0.3, -1.2, 1.4, -0.9, 1.1, 0.2], NO_TCP)
    every = np.array(list(postures(lengths_of(arm), flange, 0.0)))
    assert every.shape == (8, 6)
    apart = np.abs(np.exp(1j * every[:, None]) - np.exp(1j * every[None])).max(axis=2)
    assert apart[~np.eye(8, dtype=bool)].min() > 0.1


def test_what_is_only_reached_beyond_the_limits_has_no_solution():
    arm = load_arm("ur5")
    q = np.array([0.3, -1.2, 1.4, -0.9, 1.1, 0.2])
    pose = pose_of(arm, q, NO_TCP)
    narrow = replace(arm, q_min=q - 0.05, q_max=q + 0.05)
    assert solve(narrow, pose, np.zeros(6), NO_TCP) == pytest.approx(q, abs=1e-9)
    beside = replace(arm, q_min=q + 0.05, q_max=q + 0.1)
    assert solve(beside, pose, q, NO_TCP) is None


@pytest.mark.parametrize(
    "pose",
    [
        [1.2, 0, 0, 0, 0, 0],
        [0.02, 0, 0.6, 0, 0, 0],
        [np.nan, 0, 0, 0, 0, 0],
        [0.3, 0, np.inf, 0, 0, 0],
        [1e300, 0, 0, 0, 0, 0],
    ],
)
def test_what_is_out_of_reach_or_no_number_has_no_solution(pose):
    assert solve(load_arm("ur5"), pose, np.zeros(6), NO_TCP) is None


def test_a_joint_at_its_limit_stays_there():
    arm = load_arm("ur5")
    q = np.array([0.3, -1.2, 1.4, -0.9, 1.1, 2 * np.pi])
    assert solve(arm, pose_of(arm, q, NO_TCP), q, NO_TCP) == pytest.approx(q, abs=1e-9)


def test_in_the_wrist_singularity_wrist_3_stays_where_it_is():
    arm = load_arm("ur5")
    q = np.array([0.3, -1.2, 1.4, -0.9, 0.0, 0.7])
    assert solve(arm, pose_of(arm, q, NO_TCP), q, NO_TCP) == pytest.approx(q, abs=1e-6)


def test_just_out_of_reach_a_solution_may_be_asked_for_that_is_near_enough():
    arm = load_arm("ur5")
    q = np.array([0.3, -1.2, 0.02, -0.9, 1.1, 0.2])
    pose = pose_of(arm, q, NO_TCP)
    shoulder = np.array([0, 0, 0.089159])
    pose[:3] += 1e-3 * (pose[:3] - shoulder) / np.linalg.norm(pose[:3] - shoulder)
    assert solve(arm, pose, q, NO_TCP) is None
    near_enough = solve(arm, pose, q, NO_TCP, position_m=5e-3, orientation_rad=5e-2)
    error = pose_of(arm, near_enough, NO_TCP) - pose
    assert np.linalg.norm(error[:3]) <= 5e-3


@given(q=JOINTS, qd=JOINTS)
@settings(max_examples=40, deadline=None)
def test_the_elbow_is_where_mujoco_has_the_third_joint(q, qd):
    plant = plant_of("ur5")
    plant.data.qpos[:] = q
    mujoco.mj_forward(plant.model, plant.data)
    body, linear = plant.data.body("link3"), np.zeros((3, 6))
    mujoco.mj_jac(plant.model, plant.data, linear, None, body.xpos, body.id)
    posture = Posture(lengths_of(load_arm("ur5")), q)
    assert posture.elbow == pytest.approx(body.xpos, abs=1e-12)
    assert posture.elbow_velocity(qd) == pytest.approx(linear @ qd, abs=1e-11)


def test_an_arm_with_other_axes_is_refused():
    with pytest.raises(SpecError, match="lab6"):
        pose_of(load_arm("lab6"), np.zeros(6), NO_TCP)


# The force and torque sensor of an e-Series arm, against forces worked out here.


BENT = np.array([0.2, -1.4, 1.6, -1.7, -1.5, 0.1])
NO_TOOL = np.zeros(6)


def turn_of(machine):
    """(3, 3) rotation of the flange."""
    pose = kinematics.pose_of(machine.body.arm, machine.reading.q, NO_TOOL)
    return Rotation.from_rotvec(pose[3:]).as_matrix()


def test_it_carries_what_really_hangs_there_whatever_is_declared():
    machine, com = machine_of("ur5e"), (0.1, 0.0, 0.05)
    machine.body.mount(Payload(2.0, com))
    pass_time(machine, 0.1)
    force = turn_of(machine).T @ [0.0, 0.0, -2.0 * 9.81]
    carried = [*force, *np.cross(com, force)]
    assert machine.outputs["ft_raw_wrench"] == pytest.approx(carried, abs=0.05)


@pytest.mark.thorough
def test_it_feels_pushes_in_its_own_axes():
    machine = machine_of("ur5e")
    machine.move(movej(BENT, 2.0, 10.0, machine.tick_s))
    pass_time(machine, 3.0)
    before = np.array(machine.outputs["ft_raw_wrench"])
    J = np.asarray(kinematics.jacobian(machine.body.arm, BENT, NO_TOOL))
    wrench = np.array([5.0, -3.0, 8.0, 0.2, 0.1, -0.3])
    machine.body.push(J.T @ wrench)
    pass_time(machine, 0.002)
    R = turn_of(machine).T
    felt = np.array(machine.outputs["ft_raw_wrench"]) - before
    assert felt == pytest.approx([*R @ wrench[:3], *R @ wrench[3:]], abs=0.5)


def test_cb3_has_none():
    assert "ft_raw_wrench" not in machine_of("ur5").outputs
