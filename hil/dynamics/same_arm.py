"""Check whether a recording that names a robot can belong to a given model."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from hil.core import DataError, FloatArray, SpecError
from hil.dynamics.robot_model import MOTOR_SIDE, RobotModel, load_model

APART_M, APART_RAD = 0.01, 0.05
"""Maximum difference between the axes of two descriptions of the same arm [m, rad].

Differences up to this maximum occur, for example, between a nominal and a calibrated description.
"""


def may_be(name: str, robot: RobotModel) -> bool:
    """Return whether data of the robot named `name` can belong to the model `robot`.

    Two built-in arms are compared by name. The path of a description does not identify an arm.
    Therefore an arm description is compared with another description, or with a built-in arm, by DH
    parameters. A URDF is compared with any robot by the distance and the angle between consecutive
    joint axes. A file that cannot be read on this machine, and an unknown name, are compatible with
    any robot.

    Args:
        name: Name of a built-in arm, path of a URDF or a description, or an empty text.
        robot: Robot model.
    """
    given, own = name.removesuffix(MOTOR_SIDE), robot.name.removesuffix(MOTOR_SIDE)
    if not given or given == own:
        return True
    other = _geometry_of(given)
    if other is None:
        return True
    axes, dh = other
    if robot.arm is None or dh is None:
        return _alike(axes, _axes(robot))
    told_by_name = not _is_file(own) and not _is_file(given)
    return not told_by_name and _alike(_lengths_and_angles(dh), _lengths_and_angles(robot.arm.dh))


@lru_cache(maxsize=32)
def _geometry_of(name: str) -> tuple[tuple[FloatArray, FloatArray], FloatArray | None] | None:
    try:
        robot = load_model(name)
    except (SpecError, DataError, OSError):
        return None
    return _axes(robot), None if robot.arm is None else robot.arm.dh


def _lengths_and_angles(dh: FloatArray) -> tuple[FloatArray, FloatArray]:
    return dh[:, [0, 2]], dh[:, [1, 3]]


def _axes(robot: RobotModel) -> tuple[FloatArray, FloatArray]:
    """Return distances [m] and angles [rad] (n − 1,) between consecutive joint axes.

    Distances and angles of joint axes do not depend on the frame convention.
    """
    geometry = robot.joint_geometry()
    at, lines = np.eye(4), []
    for placement, axis in zip(geometry.placement, geometry.axis, strict=True):
        at = at @ placement
        lines.append((at[:3, 3], at[:3, :3] @ axis))
    pairs = [_between(*one, *two) for one, two in pairwise(lines)]
    slides = ~(geometry.turns[1:] & geometry.turns[:-1])
    apart, inclined = np.array(pairs).reshape(-1, 2).T
    return np.where(slides, 0.0, apart), inclined  # the position of a prismatic axis is arbitrary


def _between(
    p: FloatArray, axis: FloatArray, other: FloatArray, other_axis: FloatArray
) -> tuple[float, float]:
    """Return distance and angle of two lines, each defined by a point and a unit vector."""
    across = np.cross(axis, other_axis)
    size = float(np.linalg.norm(across))
    inclined = float(np.arcsin(min(size, 1.0)))
    if inclined < APART_RAD:
        return float(np.linalg.norm(np.cross(other - p, axis))), inclined
    return abs(float((other - p) @ across)) / size, inclined


def _is_file(name: str) -> bool:
    return bool(Path(name).suffix) or "/" in name


def _alike(one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]) -> bool:
    if one[0].shape != other[0].shape:
        return False
    pairs = zip(one, other, (APART_M, APART_RAD), strict=True)
    return all(np.allclose(a, b, rtol=0.0, atol=limit) for a, b, limit in pairs)
