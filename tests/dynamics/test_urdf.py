"""Robot models from URDF files, good and bad."""

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import SpecError
from hil.dynamics import RobotModel, load_model
from tests.support.dynamics_arms import motion, urdf, written

LOAD = Payload(2.0, (0.01, 0.02, 0.05), (0.01, 0.012, 0.009, 0.0, 0.0, 0.0))

FINGER = (
    '<link name="finger"/><joint name="finger_joint" type="prismatic"><parent link="{parent}"/>'
    '<child link="finger"/><limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>'
)


@pytest.mark.parametrize("name", ["ur5", "lab6"])
def test_urdf_and_built_in_arm_have_the_same_dynamics(tmp_path, name):
    model = RobotModel.from_urdf(written(tmp_path, urdf(name)))
    built_in = RobotModel.from_arm(name)
    samples = motion(20)
    np.testing.assert_allclose(
        model.inverse_dynamics(*samples), built_in.inverse_dynamics(*samples), atol=1e-9
    )
    np.testing.assert_allclose(
        model.payload_effort(LOAD, *samples), built_in.payload_effort(LOAD, *samples), atol=1e-9
    )
    np.testing.assert_allclose(
        model.flange_pose(samples[0]), built_in.flange_pose(samples[0]), atol=1e-12
    )


def test_load_model_takes_a_path(tmp_path):
    model = load_model(written(tmp_path, urdf("ur5")), rotor_inertia=[0.1] * 6)
    assert model.joint_names[2] == "elbow_joint"
    assert model.parameters()[-1] == 0.1
    np.testing.assert_allclose(model.q_max, 6.2)


def test_an_endless_joint_counts_one_coordinate_and_has_no_limit(tmp_path):
    model = RobotModel.from_urdf(written(tmp_path, urdf("ur3", wrist_3="continuous")))
    assert model.n == 6
    assert model.q_min[5] == -np.inf
    assert model.q_max[5] == np.inf
    assert model.effort_max[5] == 12.0
    samples = motion(5)
    np.testing.assert_allclose(
        model.inverse_dynamics(*samples),
        RobotModel.from_arm("ur3").inverse_dynamics(*samples),
        atol=1e-9,
    )


def test_the_flange_can_be_named(tmp_path):
    path = written(tmp_path, urdf("ur5"))
    at_joint = RobotModel.from_urdf(path, flange="link_6").flange_pose(np.zeros((1, 6)))
    at_tool = RobotModel.from_urdf(path).flange_pose(np.zeros((1, 6)))
    assert np.linalg.norm(at_joint[0, :3, 3] - at_tool[0, :3, 3]) == pytest.approx(0.0823)
    with pytest.raises(SpecError, match="'gripper' is not a link behind the last joint"):
        RobotModel.from_urdf(path, flange="gripper")


def test_a_prismatic_axis_carries_weight(tmp_path):
    lift = (
        '<robot name="lift"><link name="base"/><link name="table"><inertial><mass value="3"/>'
        '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
        '<joint name="z" type="prismatic"><parent link="base"/><child link="table"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    model = RobotModel.from_urdf(written(tmp_path, lift))
    assert model.gravity(np.array([[0.4]]))[0, 0] == pytest.approx(3 * 9.81)


def test_a_missing_file_is_named():
    with pytest.raises(SpecError, match=r"there is no file nowhere\.urdf in /"):
        load_model("nowhere.urdf")


def test_broken_xml_is_reported_with_its_line(tmp_path):
    with pytest.raises(SpecError, match=r"not well-formed XML.*line 2"):
        load_model(written(tmp_path, "<robot>\n<link name=></robot>"))


def test_a_file_that_is_no_urdf_is_refused(tmp_path):
    with pytest.raises(SpecError, match="outermost element is <mujoco>"):
        load_model(written(tmp_path, "<mujoco/>"))


def test_a_free_flyer_is_refused(tmp_path):
    base = (
        '<link name="world"/><joint name="root" type="floating"><parent link="world"/>'
        '<child link="base_link"/></joint>'
    )
    with pytest.raises(SpecError, match="joint 'root' is of type 'floating'"):
        load_model(written(tmp_path, urdf("ur5", extra=base)))


@pytest.mark.parametrize("parent", ["link_3", "base_link"])
def test_a_branch_is_refused_with_the_fork(tmp_path, parent):
    text = urdf("ur5", extra=FINGER.format(parent=parent))
    with pytest.raises(SpecError, match=f"link '{parent}' carries the joints .*finger_joint"):
        load_model(written(tmp_path, text))


def test_a_robot_without_joints_is_refused(tmp_path):
    with pytest.raises(SpecError, match="no joint moves"):
        load_model(written(tmp_path, '<robot name="r"><link name="a"/></robot>'))


RING = (
    '<robot name="r"><link name="a"/><link name="b"/><link name="c"/>'
    '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="k" type="revolute"><parent link="b"/><child link="a"/>'
    '<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>'
)


def changed(old: str, new: str) -> str:
    text = urdf("ur5")
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (changed('child link="link_4"', 'child link="nothing"'), "not exist: 'nothing'"),
        (changed('mass value="3.7', 'mass value="x3.7'), "link 'link_1': <mass value='x3.7"),
        (changed('mass value="3.7', 'mass value="-3.7'), "link 'link_1': the mass is negative"),
        (changed('xyz="0 0 1"', 'xyz="0 0 0"'), "axis of length 0"),
        (changed('lower="-6.2"', 'lower="7"'), "lower limit above its upper limit"),
        (changed('"elbow_joint"', '"wrist_1_joint"'), "two joints are called 'wrist_1_joint'"),
        (changed('parent link="base_link"', 'parent link="link_6"'), "not connected: "),
        (changed("<axis", '<mimic joint="elbow_joint"/><axis'), "mimics a different joint"),
        (changed(' velocity="', ' speed="'), "has a <limit> without `velocity`"),
        (changed(' velocity="', ' velocity="-'), "has a negative velocity limit"),
        (changed(' effort="', ' effort="-'), "has a negative effort limit"),
        (changed('<joint name="elbow_joint"', "<joint"), "a joint has no name"),
        (changed('mass value="3.7', 'mass weight="3.7'), "link 'link_1': <mass> has no value"),
        (changed(' ixy="', ' xy="'), "link 'link_1': <inertia> has no ixy"),
        (RING, "not form one tree"),
    ],
)
def test_what_is_wrong_in_a_urdf_is_said_before_pinocchio_sees_it(tmp_path, text, problem):
    with pytest.raises(SpecError) as caught:
        load_model(written(tmp_path, text))
    assert problem in caught.value.message


def test_all_problems_of_a_urdf_are_reported_at_once(tmp_path):
    text = changed('mass value="3.7', 'mass value="-3.7').replace("8.393", "heavy")
    with pytest.raises(SpecError) as caught:
        load_model(written(tmp_path, text))
    assert len(caught.value.message.splitlines()) == 2
