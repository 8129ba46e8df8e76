"""Arms of other makers stand where the makers' own tables, joint by joint, say they do."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.arms import load_arm
from hil.core.errors import SpecError
from hil.dynamics import load_model

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

    with pytest.raises(SpecError, match="arms with 6 joints; panda has 7"):
        draw_truth("panda")
