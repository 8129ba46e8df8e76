"""A URDF in words: links and joints of a chain, from its geometry and its parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

import numpy as np

from hil.core import FloatArray
from hil.dynamics import RobotModel, about_centre
from hil.export.identified_parameters import IdentifiedParameters

UNLIMITED = 1e9
"""Effort and speed of joints whose limits nobody knows: a URDF has no word for infinity."""


def written(robot: RobotModel, found: IdentifiedParameters, comment: str) -> str:
    """The URDF of a robot that has none of its own."""
    geometry = robot.joint_geometry()
    links = ["base_link", *(_link_name(name) for name in robot.joint_names)]
    lines = ['<?xml version="1.0"?>', f"<!-- {plain(comment)} -->"]
    lines += [f"<robot name={quoteattr(robot.name)}>", f"  <link name={quoteattr(links[0])}/>"]
    pose = np.eye(4)
    for j, joint in enumerate(robot.joint_names):
        body = found.inertial[10 * j : 10 * j + 10]
        lines += [
            f"  <link name={quoteattr(links[j + 1])}>",
            f"    {inertial(body)}",
            "  </link>",
            f'  <joint name={quoteattr(joint)} type="{_kind(robot, j, bool(geometry.turns[j]))}">',
            f"    {_origin(geometry.placement[j])}",
            f"    <parent link={quoteattr(links[j])}/>",
            f"    <child link={quoteattr(links[j + 1])}/>",
            f'    <axis xyz="{_numbers(geometry.axis[j])}"/>',
            f"    {_limit(robot, j)}",
            f"    {dynamics(found, j)}",
            "  </joint>",
        ]
        pose = pose @ geometry.placement[j]
    flange = np.linalg.solve(pose, robot.flange_pose(np.zeros((1, robot.n)))[0])
    return "\n".join([*lines, *_flange(links[-1], flange), "</robot>", ""])


def inertial(body: FloatArray) -> str:
    """`<inertial>` of ten parameters about the link's origin."""
    m, com, I = about_centre(body)  # noqa: E741
    names = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2))
    told = " ".join(f'{name}="{_number(I[i, j])}"' for name, i, j in (*names, ("izz", 2, 2)))
    return (
        f'<inertial><origin xyz="{_numbers(com)}" rpy="0 0 0"/><mass value="{_number(m)}"/>'
        f"<inertia {told}/></inertial>"
    )


def dynamics(found: IdentifiedParameters, j: int) -> str:
    """`<dynamics>` of joint j; `armature` is no word of URDF, and most readers leave it out."""
    rotor = found.inertial[10 * len(found.coulomb) + j]
    return (
        f'<dynamics damping="{_number(found.viscous[j])}" friction="{_number(found.coulomb[j])}" '
        f'armature="{_number(rotor)}"/>'
    )


def roll_pitch_yaw(R: FloatArray) -> tuple[float, float, float]:
    """Angles [rad] with R = Rz(yaw) Ry(pitch) Rx(roll); yaw is 0 where pitch is a right angle."""
    across = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], across)
    if across < 1e-9:
        return math.atan2(-R[1, 2], R[1, 1]), pitch, 0.0
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


def _link_name(joint: str) -> str:
    return joint.removesuffix("_joint") + "_link"


def _kind(robot: RobotModel, j: int, turns: bool) -> str:
    if not turns:
        return "prismatic"
    limited = np.isfinite(robot.q_min[j]) and np.isfinite(robot.q_max[j])
    return "revolute" if limited else "continuous"


def _limit(robot: RobotModel, j: int) -> str:
    ends = (robot.q_min[j], robot.q_max[j])
    limited = all(math.isfinite(end) for end in ends)
    told = f'lower="{_number(ends[0])}" upper="{_number(ends[1])}" ' if limited else ""
    effort, speed = (
        float(values[j]) if math.isfinite(values[j]) else UNLIMITED
        for values in (robot.effort_max, robot.qd_max)
    )
    return f'<limit {told}effort="{_number(effort)}" velocity="{_number(speed)}"/>'


def _flange(parent: str, pose: FloatArray) -> Iterator[str]:
    yield '  <link name="flange"/>'
    yield '  <joint name="flange_fixed" type="fixed">'
    yield f"    {_origin(pose)}"
    yield f"    <parent link={quoteattr(parent)}/>"
    yield '    <child link="flange"/>'
    yield "  </joint>"


def _origin(pose: FloatArray) -> str:
    angles = np.array(roll_pitch_yaw(pose[:3, :3]))
    return f'<origin xyz="{_numbers(pose[:3, 3])}" rpy="{_numbers(angles)}"/>'


def _numbers(values: FloatArray) -> str:
    return " ".join(_number(value) for value in values)


def _number(value: float) -> str:
    """Shortest text that reads back as the same number."""
    return repr(float(value) + 0.0)


def plain(text: str) -> str:
    """Text as a comment may hold it."""
    return text.replace("--", "- -")
