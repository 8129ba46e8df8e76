"""Independent descriptions of the built-in arms for the dynamics tests: DH, MJCF, URDF."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hil.arms import load_arm
from hil.arms.payload import Payload

UR_ARMS = ("ur3", "ur5", "ur10", "ur3e", "ur5e", "ur10e")


def motion(samples: int, joints: int = 6, seed: int = 0):
    """q, qd, qdd, each (samples, joints)."""
    random = np.random.default_rng(seed)
    return tuple(random.uniform(-size, size, (samples, joints)) for size in (np.pi, 2.0, 5.0))


def dh_matrix(a: float, alpha: float, d: float, theta: float) -> np.ndarray:
    """The textbook matrix, written out (Siciliano et al. 2009, eq. 2.52)."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def dh_chain(name: str, q: np.ndarray) -> list[np.ndarray]:
    """Poses of the DH frames 0…n at one joint position."""
    poses = [np.eye(4)]
    for (a, alpha, d, theta), angle in zip(load_arm(name).dh, q, strict=True):
        poses.append(poses[-1] @ dh_matrix(a, alpha, d, theta + angle))
    return poses


def _links(name: str):
    """Joint placement, then centre of mass and inertia in the frame that turns with the joint."""
    arm = load_arm(name)
    before = np.eye(4)
    for i, (a, alpha, d, theta) in enumerate(arm.dh):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", theta).as_matrix()
        fixed = dh_matrix(a, alpha, d, 0.0)
        R = fixed[:3, :3]
        yield before @ turn, R @ arm.com[i] + fixed[:3, 3], R @ arm.inertia[i] @ R.T, i
        before = fixed


def _numbers(values) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _rpy(pose: np.ndarray) -> np.ndarray:
    with warnings.catch_warnings():
        # In gimbal lock any of the equivalent triples will do.
        warnings.simplefilter("ignore", UserWarning)
        return Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")


def mjcf(name: str, armature=None, payload: Payload | None = None) -> str:
    """A MuJoCo model of an arm, the load as a body of its own."""
    arm = load_arm(name)
    armature = np.zeros(arm.n_joints) if armature is None else armature
    opened = ""
    for placement, com, inertia, i in _links(name):
        quaternion = Rotation.from_matrix(placement[:3, :3]).as_quat(scalar_first=True)
        full = (*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2])
        opened += (
            f'<body pos="{_numbers(placement[:3, 3])}" quat="{_numbers(quaternion)}">'
            f'<joint axis="0 0 1" armature="{armature[i]}"/>'
            f'<inertial mass="{arm.mass[i]}" pos="{_numbers(com)}" fullinertia="{_numbers(full)}"/>'
        )
    if payload is not None:
        flange = dh_matrix(*arm.dh[-1][:3], 0.0)
        quaternion = Rotation.from_matrix(flange[:3, :3]).as_quat(scalar_first=True)
        opened += (
            f'<body pos="{_numbers(flange[:3, 3])}" quat="{_numbers(quaternion)}">'
            f'<inertial mass="{payload.mass}" pos="{_numbers(payload.com)}" '
            f'fullinertia="{_numbers(payload.inertia)}"/></body>'
        )
    return (
        '<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81">'
        '<flag contact="disable"/></option><worldbody>'
        + opened
        + "</body>" * arm.n_joints
        + "</worldbody></mujoco>"
    )


def mujoco_torques(model, q, qd, qdd) -> np.ndarray:
    """(N, n) inverse dynamics by MuJoCo."""
    import mujoco

    data = mujoco.MjData(model)
    out = np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse
    return out


def urdf(name: str, wrist_3: str = "revolute", extra: str = "") -> str:
    """A URDF of an arm: one link per joint, a fixed `tool0` at the flange."""
    arm = load_arm(name)
    text = '<robot name="arm"><link name="base_link"/>'
    parent = "base_link"
    for placement, com, inertia, i in _links(name):
        rpy = _rpy(placement)
        kind = wrist_3 if i == arm.n_joints - 1 else "revolute"
        xx, xy, xz, _, yy, yz, _, _, zz = inertia.ravel()
        text += (
            f'<link name="link_{i + 1}"><inertial><mass value="{arm.mass[i]:.17g}"/>'
            f'<origin xyz="{_numbers(com)}"/><inertia ixx="{xx:.17g}" ixy="{xy:.17g}" '
            f'ixz="{xz:.17g}" iyy="{yy:.17g}" iyz="{yz:.17g}" izz="{zz:.17g}"/></inertial></link>'
            f'<joint name="{arm.joint_names[i]}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="link_{i + 1}"/><axis xyz="0 0 1"/>'
            f'<origin xyz="{_numbers(placement[:3, 3])}" rpy="{_numbers(rpy)}"/>'
            f'<limit lower="-6.2" upper="6.2" effort="{arm.effort_max[i]}" velocity="3"/></joint>'
        )
        parent = f"link_{i + 1}"
    flange = dh_matrix(*arm.dh[-1][:3], 0.0)
    rpy = _rpy(flange)
    text += (
        f'<link name="tool0"/><joint name="flange" type="fixed"><parent link="{parent}"/>'
        f'<child link="tool0"/><origin xyz="{_numbers(flange[:3, 3])}" rpy="{_numbers(rpy)}"/>'
        "</joint>"
    )
    return text + extra + "</robot>"


def written(folder: Path, text: str) -> Path:
    """The text as a URDF file."""
    path = folder / "arm.urdf"
    path.write_text(text, "utf-8")
    return path
