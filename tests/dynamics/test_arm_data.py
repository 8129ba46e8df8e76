"""Built-in arms: complete and plausible, the UR5 equal to the maker's ROS description."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from hil.arms import arm_names, load_arm
from tests.support.dynamics_arms import UR_ARMS, dh_chain
from tests.support.paths import DATA

UR5 = DATA / "ur5"
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")

REACH_MM = {"ur3": 500, "ur5": 850, "ur10": 1300, "ur3e": 500, "ur5e": 850, "ur10e": 1300}
"""Working radius around joint 1 that the makers' data sheets state."""

WEIGHT_KG = {"ur3": 11.0, "ur5": 18.4, "ur10": 28.9, "ur3e": 11.2, "ur5e": 20.6, "ur10e": 33.5}
"""Weight of the whole arm with its base, from the data sheets."""


class RosLoader(yaml.SafeLoader):
    """YAML with ur_description's angles."""


RosLoader.add_constructor(
    "!degrees", lambda loader, node: np.radians(float(loader.construct_scalar(node)))
)


def ros(name: str):
    path = UR5 / name
    if not path.is_file():
        pytest.skip(f"{path} is not there: set HIL_DATA to the folder with the recorded data")
    return yaml.load(path.read_text("utf-8"), RosLoader)


def ros_frames():
    """Poses of ur_description's link frames at q = 0."""
    pose, frames = np.eye(4), []
    for link in LINKS:
        origin = ros("default_kinematics.yaml")["kinematics"][link]
        step = np.eye(4)
        angles = [origin[key] for key in ("roll", "pitch", "yaw")]
        step[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        step[:3, 3] = [origin[key] for key in "xyz"]
        pose = pose @ step
        frames.append(pose)
    return frames


@pytest.mark.data
def test_ur5_centres_of_mass_lie_where_ur_description_has_them():
    centres = ros("physical_parameters.yaml")["inertia_parameters"]["center_of_mass"]
    arm, dh = load_arm("ur5"), dh_chain("ur5", np.zeros(6))
    for i, (link, frame) in enumerate(zip(LINKS, ros_frames(), strict=True)):
        theirs = frame @ [*(centres[f"{link}_cog"][key] for key in "xyz"), 1.0]
        np.testing.assert_allclose(dh[i + 1] @ [*arm.com[i], 1.0], theirs, atol=1e-9)


@pytest.mark.data
def test_ur5_inertias_are_those_of_ur_description():
    parameters = ros("physical_parameters.yaml")["inertia_parameters"]
    arm, dh = load_arm("ur5"), dh_chain("ur5", np.zeros(6))
    for i, (link, frame) in enumerate(zip(LINKS, ros_frames(), strict=True)):
        assert arm.mass[i] == parameters[f"{link}_mass"]
        turn = [parameters["rotation"][link][key] for key in ("roll", "pitch", "yaw")]
        R = frame[:3, :3] @ Rotation.from_euler("xyz", turn).as_matrix()
        t = parameters["tensor"][link]
        tensor = np.array(
            [
                [t["ixx"], t["ixy"], t["ixz"]],
                [t["ixy"], t["iyy"], t["iyz"]],
                [t["ixz"], t["iyz"], t["izz"]],
            ]
        )
        ours = dh[i + 1][:3, :3] @ arm.inertia[i] @ dh[i + 1][:3, :3].T
        np.testing.assert_allclose(ours, R @ tensor @ R.T, rtol=1e-5, atol=1e-9)


@pytest.mark.data
def test_ur5_limits_are_those_of_ur_description():
    limits, arm = ros("joint_limits.yaml")["joint_limits"], load_arm("ur5")
    for i, joint in enumerate(arm.joint_names):
        assert arm.effort_max[i] == limits[joint]["max_effort"]
        assert arm.qd_max[i] == pytest.approx(limits[joint]["max_velocity"])
        # ur_description halves the elbow's range to help its planners.
        if joint != "elbow_joint":
            assert arm.q_max[i] == pytest.approx(limits[joint]["max_position"])


@pytest.mark.parametrize("name", UR_ARMS)
def test_ur_dimensions_agree_with_the_data_sheet(name):
    arm = load_arm(name)
    a, d = np.abs(arm.dh[:, 0]), arm.dh[:, 2]
    # The stated radius reaches to the wrist, stretched out, d4 beside the arm.
    reach = np.hypot(a.sum() + d[4], d[3])
    assert 1e3 * reach == pytest.approx(REACH_MM[name], rel=0.15)
    assert 0.75 * WEIGHT_KG[name] < arm.mass.sum() < WEIGHT_KG[name]


@pytest.mark.parametrize("name", arm_names())
def test_every_link_is_a_body_that_can_exist(name):
    arm = load_arm(name)
    for mass, inertia in zip(arm.mass, arm.inertia, strict=True):
        smallest, middle, largest = np.linalg.eigvalsh(inertia)
        assert mass > 0
        assert smallest > 0
        assert smallest + middle >= largest


@pytest.mark.parametrize("name", arm_names())
def test_every_number_has_a_source(name):
    arm = load_arm(name)
    topics = {"kinematics", "limits", "masses", "inertia", "drive_gains", "capsules"}
    assert topics <= arm.sources.keys()
    assert all(arm.sources.values())


@pytest.mark.parametrize("name", arm_names())
def test_excitation_stays_inside_the_limits(name):
    arm = load_arm(name)
    assert np.all(arm.excite_min >= arm.q_min)
    assert np.all(arm.excite_max <= arm.q_max)
    assert np.all(arm.excite_min < arm.excite_max)


@pytest.mark.parametrize("name", arm_names())
def test_every_link_has_a_name_and_a_body(name):
    arm = load_arm(name)
    assert len(arm.link_names) == arm.n_joints + 1
    assert {capsule.link for capsule in arm.capsules} == set(range(arm.n_joints + 1))
