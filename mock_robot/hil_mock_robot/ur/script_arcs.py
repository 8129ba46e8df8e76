"""URScript `movec`: a circle through three points, as a polygon with rounded corners."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.ur.kinematics import compose, frame_of, rotation_vector
from hil_mock_robot.ur.routes import Leg
from hil_mock_robot.ur.script_poses import between

STEP_RAD = math.radians(6.0)
"""Of the arc, a leg: the tool stays within 0.15 % of the radius of the circle."""
ROUNDED = 0.45
"""Of a leg, at both of its ends; half would leave nothing straight."""
STRAIGHT = 1e-9
"""Twice the area of a triangle as a share of its sides squared: less is no triangle."""


def arc_legs(
    start: Sequence[float],
    via: Sequence[float],
    to: Sequence[float],
    v: float,
    a: float,
    *,
    fixed: bool,
) -> list[Leg]:
    """Legs along the circle from `start` through `via` to `to`.

    Args:
        start: (6,) where the tool is.
        via: (6,) whose position is passed; its orientation does not matter.
        to: (6,) where it ends.
        v: Of the tool [m/s].
        a: Of the tool [m/s²].
        fixed: The orientation turns with the circle, in place of turning from that of `start` to
            that of `to`.
    """
    centre, axis, angle = _circle(np.array(start[:3]), np.array(via[:3]), np.array(to[:3]))
    count = max(1, math.ceil(angle / STEP_RAD))
    spoke = np.array(start[:3]) - centre
    chord = 2.0 * float(np.linalg.norm(spoke)) * math.sin(0.5 * angle / count)
    legs = []
    for i in range(1, count + 1):
        share = i / count
        place = centre + _turned(spoke, axis, share * angle) if angle else np.array(to[:3])
        turn = _orientation(start, to, share, axis * angle, fixed=fixed)
        radius = ROUNDED * chord if i < count else 0.0
        pose = np.concatenate((place, turn))
        legs.append(Leg("p", pose, v, a, radius=radius, is_pose=True))
    return legs


def _circle(
    start: FloatArray, via: FloatArray, to: FloatArray
) -> tuple[FloatArray, FloatArray, float]:
    """Centre, unit axis and angle [rad] of an arc; angle 0 for points on a straight line."""
    b, c = via - start, to - start
    normal = np.cross(b, c)
    area, size = float(normal @ normal), float(max(b @ b, c @ c))
    if area <= (STRAIGHT * size) ** 2 or size == 0.0:
        return start, np.zeros(3), 0.0
    centre = start + np.cross((b @ b) * c - (c @ c) * b, normal) * (0.5 / area)
    axis = normal / math.sqrt(area)
    spoke, last = start - centre, to - centre
    angle = math.atan2(float(np.cross(spoke, last) @ axis), float(spoke @ last))
    return centre, axis, angle % (2.0 * math.pi)


def _turned(vector: FloatArray, axis: FloatArray, angle: float) -> FloatArray:
    """A vector at right angles to the axis, turned about it."""
    turned: FloatArray = math.cos(angle) * vector + math.sin(angle) * np.cross(axis, vector)
    return turned


def _orientation(
    start: Sequence[float], to: Sequence[float], share: float, turn: FloatArray, *, fixed: bool
) -> list[float]:
    if not fixed:
        return between(start, to, share)[3:]
    frame = compose(frame_of((0.0, 0.0, 0.0, *(share * turn).tolist())), frame_of(start))
    return list(rotation_vector(frame))
