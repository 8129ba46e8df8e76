"""Arms: the data of those built in, makers' tables, and descriptions drawn from URDFs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import hil.arms
from hil.arms import arm_names, load_arm
from hil.core.errors import SpecError
from hil.dynamics.dh_from_urdf import described
from hil.dynamics.robot_model import RobotModel, load_model
from hil.planning.custom_arm import own_arm_drafts
from hil.planning.workspace import plannable_arm
from hil.spec.station import StationRobot
from tests.support.dynamics_arms import UR_ARMS, dh_chain
from tests.support.paths import DATA, FILES

# Built-in arms: complete and plausible, the UR5 equal to the maker's ROS description


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


# Arms of other makers stand where the makers' own tables, joint by joint, say they do


QUARTER = np.pi / 2
# Rows as in a URDF: origin xyz [m], origin rpy [rad], axis; then where the flange is.
PANDA = (
    [
        ((0, 0, 0.333), (0, 0, 0), (0, 0, 1)),
        ((0, 0, 0), (-QUARTER, 0, 0), (0, 0, 1)),
        ((0, -0.316, 0), (QUARTER, 0, 0), (0, 0, 1)),
        ((0.0825, 0, 0), (QUARTER, 0, 0), (0, 0, 1)),
        ((-0.0825, 0.384, 0), (-QUARTER, 0, 0), (0, 0, 1)),
        ((0, 0, 0), (QUARTER, 0, 0), (0, 0, 1)),
        ((0.088, 0, 0), (QUARTER, 0, 0), (0, 0, 1)),
    ],
    ((0, 0, 0.107), (0, 0, 0)),
)
"""franka_description robots/fer/kinematics.yaml."""
KR300 = (
    [
        ((0, 0, 0.675), (0, 0, 0), (0, 0, -1)),
        ((0.35, 0, 0), (0, 0, 0), (0, 1, 0)),
        ((1.15, 0, 0), (0, 0, 0), (0, 1, 0)),
        ((1.0, 0, -0.041), (0, 0, 0), (-1, 0, 0)),
        ((0, 0, 0), (0, 0, 0), (0, 1, 0)),
        ((0, 0, 0), (0, 0, 0), (-1, 0, 0)),
    ],
    ((0.24, 0, 0), (0, QUARTER, 0)),
)
"""kuka_kr300_support urdf/kr300r2500ultra_macro.xacro, not where our DH came from."""
TX40 = (
    [
        ((0, 0, 0.32), (0, 0, 0), (0, 0, 1)),
        ((0, 0, 0), (-QUARTER, 0, 0), (0, 0, 1)),
        ((0.225, 0, 0.035), (0, 0, 0), (0, 0, 1)),
        ((0, -0.225, 0), (QUARTER, 0, 0), (0, 0, 1)),
        ((0, 0, 0), (-QUARTER, 0, 0), (0, 0, 1)),
        ((0, 0, 0), (QUARTER, np.pi, 0), (0, 0, 1)),
    ],
    ((0, 0, 0.065), (0, 0, 0)),
)
"""figaroh-plus tx40_mdh_modified.urdf, whose zero has joints 2 and 3 elsewhere (see ANGLES)."""
MAKERS = {"panda": PANDA, "kr300": KR300, "tx40": TX40}
ANGLES = {
    "panda": lambda q: q,
    "kr300": lambda q: q * [-1, 1, 1, 1, 1, 1],
    "tx40": lambda q: q + np.array([0, -QUARTER, QUARTER, 0, 0, 0]),
}
"""From our joint angles to those of the maker's table."""


def pose(xyz, rpy):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    out[:3, 3] = xyz
    return out


def flange(name, q):
    rows, tool = MAKERS[name]
    here = np.eye(4)
    for (xyz, rpy, axis), angle in zip(rows, ANGLES[name](q), strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        here = here @ pose(xyz, rpy) @ turn
    return here @ pose(*tool)


@pytest.mark.parametrize("name", MAKERS)
def test_flange_is_where_the_published_table_puts_it(name):
    robot = load_model(name)
    q = np.random.default_rng(1).uniform(-2, 2, (20, robot.n))
    theirs = np.array([flange(name, one) for one in q])
    np.testing.assert_allclose(robot.flange_pose(q), theirs, atol=1e-12)


@pytest.mark.parametrize(("name", "weight"), [("panda", 18.0), ("tx40", 27.0), ("kr300", 1120.0)])
def test_links_weigh_less_than_the_whole_arm_with_its_base(name, weight):
    assert 0.7 * weight < load_arm(name).mass.sum() < weight


def test_panda_holds_its_wrist_with_the_torque_its_masses_ask_for():
    # Stretched out level by joint 2 alone, everything beyond joint 2 hangs on that joint.
    robot, arm = load_model("panda"), load_arm("panda")
    q = np.array([[0.0, QUARTER, 0.0, 0.0, 0.0, 0.0, 0.0]])
    pinned = robot.gravity(q)[0, 1]
    poses = [np.eye(4)]
    for (xyz, rpy, _), angle in zip(PANDA[0], q[0], strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
        poses.append(poses[-1] @ pose(xyz, rpy) @ turn)
    com = {  # franka_description robots/fer/inertials.yaml, link frames of that table
        2: (0.00038, -0.09211, 0.01908),
        3: (0.05152, 0.01696, -0.02971),
        4: (-0.05113, 0.05825, 0.01698),
        5: (-0.00005, 0.0373, -0.0928),
        6: (0.06572, -0.00371, 0.00153),
        7: (0.00089, -0.00044, 0.05491),
    }
    moment = sum(
        9.81 * arm.mass[i - 1] * (poses[i] @ [*centre, 1.0])[0] for i, centre in com.items()
    )
    assert pinned == pytest.approx(-moment, rel=1e-6)


def test_mock_says_that_it_has_no_drives_for_seven_joints():
    from hil_mock_robot.plant.truth import draw_truth

    with pytest.raises(SpecError, match="arms with 6 joints only; panda has 7"):
        draw_truth("panda")


# An arm described from its URDF is the same arm; one that cannot be described is refused


URDF = FILES / "own_arm.urdf"
DESCRIBED_UR5 = (Path(hil.arms.__file__).parent / "ur5.yaml").read_text("utf-8")


@pytest.fixture
def arm(tmp_path: Path) -> str:
    (*_, draft), _ = own_arm_drafts(URDF, tmp_path / "own.yaml", robot="own", name="own")
    draft.path.write_text(draft.text)
    return str(draft.path)


def changed(folder: Path, old: str, new: str) -> Path:
    text = URDF.read_text()
    assert old in text
    path = folder / "changed.urdf"
    path.write_text(text.replace(old, new))
    return path


def test_torques_are_those_of_the_urdf(arm: str) -> None:
    states = np.random.default_rng(1).uniform(-2, 2, (3, 50, 6))
    by_urdf = RobotModel.from_urdf(URDF).inverse_dynamics(*states)
    by_description = load_model(arm).inverse_dynamics(*states)

    assert np.abs(by_description - by_urdf).max() < 1e-6
    assert np.abs(by_urdf).max() > 10


def test_the_flange_is_where_the_urdf_has_it(arm: str) -> None:
    place = np.eye(4)
    for a, alpha, d, theta in load_arm(arm).dh:
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
        place @= [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st],
                  [0, sa, ca, d], [0, 0, 0, 1]]  # fmt: skip
    # By hand: a turret turned by 0.4 rad, on it a forearm of 0.52 m that points 0.1 rad downwards
    # from an elbow 0.04 m high; the steps of 0.04, -0.02 and -0.02 m to the side cancel.
    out = 0.06 + 0.52 * np.cos(0.1) + 0.04 * np.sin(0.1)
    up = 0.3 + 0.1 + 0.45 - 0.52 * np.sin(0.1) + 0.04 * np.cos(0.1)
    assert np.allclose(place[:3, 3], [out * np.cos(0.4), out * np.sin(0.4), up], atol=1e-8)


def test_motions_are_planned_for_it(arm: str) -> None:
    found = plannable_arm(StationRobot(driver="mock", model=arm))
    assert found.n_joints == 6
    assert found.joint_names[0] == "A1"
    assert len(found.capsules) == 7


def test_what_the_urdf_leaves_out_is_told_and_marked(tmp_path: Path) -> None:
    (*_, draft), notes = own_arm_drafts(URDF, tmp_path / "own.yaml", robot="own", name="own")
    assert "joints: A1, A2, A3, A4, A5, A6" in notes
    assert "the URDF has no speed limit for A4, A5: guessed" in notes
    marked = [line for line in draft.text.splitlines() if "GUESS values that the URDF" in line]
    assert len(marked) == 2
    draft.path.write_text(draft.text)
    assert load_arm(str(draft.path)).guessed == (
        "rate_hz", "payload_max", "excite", "qdd_max", "gear_ratio", "drive_gain", "capsules",
        "effort_max", "qd_max", "q_limits",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0 -1"/>', r"first joint is \(0, 0, -1\)"),
        ('xyz="0 0 0.3" rpy', 'xyz="0.1 0 0.3" rpy', r"through \(0.1, 0, 0.3\)"),
        (
            '<joint name="A6" type="revolute">',
            '<joint name="A6" type="prismatic">',
            "prismatic joint",
        ),
        ('<mass value="7"/>', '<mass value="0"/>', "the mass of boom is zero"),
        ('ixx="0.14"', 'ixx="-0.14"', "inertia of boom is not physically possible"),
    ],
)
def test_an_arm_that_cannot_be_described_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(SpecError, match=message):
        described(changed(tmp_path, old, new))


ELBOW = '<limit lower="-2.2" upper="2.2" effort="120" velocity="3"/>'


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ('lower="0" upper="0" effort="1" velocity="1"', r"joint 'A3' has no range \(0 to 0\)"),
        ('effort="1" velocity="1"', r"joint 'A3' has no range \(0 to 0\)"),
        (
            'lower="-150" upper="150" effort="1" velocity="115"',
            "joint 'A3' turns from -150 to 150 rad, 48 turns; are its limits in degrees",
        ),
    ],
)
def test_limits_of_no_arm_are_refused(tmp_path: Path, limit: str, message: str) -> None:
    with pytest.raises(SpecError, match=message) as caught:
        own_arm_drafts(
            changed(tmp_path, ELBOW, f"<limit {limit}/>"), tmp_path / "o.yaml", robot="o", name="o"
        )
    assert "continuous" in caught.value.hint


def test_a_speed_that_no_joint_has_is_told_and_guessed(tmp_path: Path) -> None:
    urdf = changed(tmp_path, ELBOW, ELBOW.replace('"3"', '"115"'))
    (*_, draft), notes = own_arm_drafts(urdf, tmp_path / "own.yaml", robot="own", name="own")
    assert notes[0] == (
        "implausible speed limits are ignored (are they in degrees per second?): A3 115 rad/s"
    )
    assert "the URDF has no speed limit for A3, A4, A5: guessed" in notes
    draft.path.write_text(draft.text)
    arm = load_arm(str(draft.path))
    assert "qd_max" in arm.guessed
    assert np.degrees(arm.qd_max[2]) == pytest.approx(90)


@pytest.mark.parametrize(("low", "high"), [(-0.05, 0.05), (2.3, 3.5), (-6, 6)])
def test_programs_move_inside_the_limits_however_narrow(
    tmp_path: Path, low: float, high: float
) -> None:
    limits = ELBOW.replace("-2.2", str(low)).replace('"2.2"', f'"{high}"')
    urdf = changed(tmp_path, ELBOW, limits)
    (*_, draft), _ = own_arm_drafts(urdf, tmp_path / "own.yaml", robot="own", name="own")
    draft.path.write_text(draft.text)
    arm = load_arm(str(draft.path))
    assert low < arm.excite_min[2] < arm.excite_max[2] < high


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rate_hz: 250\n", "the arm description lacks the key 'joints'"),
        ("- 1\n", "is not a valid arm description"),
        ("a: [1\n", "cannot be read as an arm"),
        (
            DESCRIBED_UR5.replace("drive_gain_nm_a: 10.15", "drive_gain_nm_a: 0"),
            "a drive_gain_nm_a is 0",
        ),
    ],
    ids=["no joints", "a list", "torn", "no gain"],
)
def test_a_description_that_is_none_says_why(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    with pytest.raises(SpecError, match=message):
        load_arm(str(path))
