"""URScript `movec`: an arc through three points, as a polygon with blended corners."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.ur.kinematics import compose, frame_of, rotation_vector
from hil_mock_robot.ur.routes import Leg
from hil_mock_robot.ur.script_poses import between

STEP_RAD = math.radians(6.0)
"""Arc angle of one leg [rad]; with this angle, the tool stays within 0.15 % of the radius of the
circle."""
ROUNDED = 0.45
"""Blend radius as a share of the leg length; a share of 0.5 would leave no straight part."""
STRAIGHT = 1e-9
"""Threshold of twice the triangle area divided by the squared side, below which points are
collinear.
"""


def arc_legs(
    start: Sequence[float],
    via: Sequence[float],
    to: Sequence[float],
    v: float,
    a: float,
    *,
    fixed: bool,
) -> list[Leg]:
    """Return legs along the circle from `start` through `via` to `to`.

    Args:
        start: Tool pose at the start, (6,).
        via: Intermediate pose, (6,); its orientation is ignored.
        to: Tool pose at the end, (6,).
        v: Tool speed [m/s].
        a: Tool acceleration [m/s²].
        fixed: Whether the orientation is constant relative to the circle, instead of interpolated
            between `start` and `to`.
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
    """Return centre, unit axis and angle [rad] of an arc; angle 0 for collinear points."""
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
    """Return a vector at right angles to the axis, rotated about the axis."""
    turned: FloatArray = math.cos(angle) * vector + math.sin(angle) * np.cross(axis, vector)
    return turned


def _orientation(
    start: Sequence[float], to: Sequence[float], share: float, turn: FloatArray, *, fixed: bool
) -> list[float]:
    if not fixed:
        return between(start, to, share)[3:]
    frame = compose(frame_of((0.0, 0.0, 0.0, *(share * turn).tolist())), frame_of(start))
    return list(rotation_vector(frame))
