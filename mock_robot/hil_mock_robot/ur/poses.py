"""Poses as UR writes them, metres and rotation vector, and the frames behind them.

A frame is twelve floats: the rotation matrix row by row, then the position. Plain floats, because
three coordinates at a time are faster without numpy, and this runs in every tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, sin, sqrt

import numpy as np

from hil.core import FloatArray

Frame = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
Numbers = Sequence[float] | FloatArray
Triple = tuple[float, float, float]

NOWHERE: Frame = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The frame that changes nothing."""


def floats(values: Numbers) -> Sequence[float]:
    """The same numbers as Python's own floats: numpy's scalars are slow in scalar arithmetic."""
    return values.tolist() if isinstance(values, np.ndarray) else values


def frame_of(pose: Numbers) -> Frame:
    """The frame of a pose (6,)."""
    x, y, z, rx, ry, rz = floats(pose)
    return (*rotation_of(rx, ry, rz), x, y, z)


def pose_from(frame: Frame) -> list[float]:
    """The pose (6,) of a frame; the rotation vector is at most π long."""
    return [frame[9], frame[10], frame[11], *rotation_vector(frame)]


def rotation_of(
    x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Rotation matrix, row by row, of a rotation vector [rad] (Rodrigues' formula)."""
    angle = sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return NOWHERE[:9]
    half = sin(0.5 * angle)
    s, c = sin(angle) / angle, 2.0 * half * half / (angle * angle)
    xx, yy, zz, xy, xz, yz = c * x * x, c * y * y, c * z * z, c * x * y, c * x * z, c * y * z
    return (
        1.0 - yy - zz, xy - s * z, xz + s * y,
        xy + s * z, 1.0 - xx - zz, yz - s * x,
        xz - s * y, yz + s * x, 1.0 - xx - yy,
    )  # fmt: skip


def rotation_vector(frame: Frame) -> Triple:
    """Rotation vector [rad] of a frame, accurate for every angle from 0 to π.

    By way of the quaternion whose largest component is computed first (Shepperd 1978): a formula
    by the trace alone loses all digits at π.
    """
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = frame[:9]
    trace = r00 + r11 + r22
    if trace >= r00 and trace >= r11 and trace >= r22:
        w, x, y, z = 1.0 + trace, r21 - r12, r02 - r20, r10 - r01
    elif r00 >= r11 and r00 >= r22:
        w, x, y, z = r21 - r12, 1.0 + r00 - r11 - r22, r01 + r10, r02 + r20
    elif r11 >= r22:
        w, x, y, z = r02 - r20, r01 + r10, 1.0 + r11 - r00 - r22, r12 + r21
    else:
        w, x, y, z = r10 - r01, r02 + r20, r12 + r21, 1.0 + r22 - r00 - r11
    length = sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    scale = 2.0 * atan2(length, abs(w)) / length
    scale = -scale if w < 0.0 else scale
    return scale * x, scale * y, scale * z


def compose(a: Frame, b: Frame) -> Frame:
    """Frame `b`, given in `a`, as seen from where `a` is given."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, ax, ay, az = a
    b0, b1, b2, b3, b4, b5, b6, b7, b8, bx, by, bz = b
    return (
        a0 * b0 + a1 * b3 + a2 * b6, a0 * b1 + a1 * b4 + a2 * b7, a0 * b2 + a1 * b5 + a2 * b8,
        a3 * b0 + a4 * b3 + a5 * b6, a3 * b1 + a4 * b4 + a5 * b7, a3 * b2 + a4 * b5 + a5 * b8,
        a6 * b0 + a7 * b3 + a8 * b6, a6 * b1 + a7 * b4 + a8 * b7, a6 * b2 + a7 * b5 + a8 * b8,
        a0 * bx + a1 * by + a2 * bz + ax,
        a3 * bx + a4 * by + a5 * bz + ay,
        a6 * bx + a7 * by + a8 * bz + az,
    )  # fmt: skip


def inverted(frame: Frame) -> Frame:
    """The frame that undoes this one."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, x, y, z = frame
    return (
        a0, a3, a6, a1, a4, a7, a2, a5, a8,
        -(a0 * x + a3 * y + a6 * z), -(a1 * x + a4 * y + a7 * z), -(a2 * x + a5 * y + a8 * z),
    )  # fmt: skip


def turned(frame: Frame, x: float, y: float, z: float) -> Triple:
    """A vector given in a frame, in the axes in which that frame is given."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = frame[:9]
    return a0 * x + a1 * y + a2 * z, a3 * x + a4 * y + a5 * z, a6 * x + a7 * y + a8 * z


def pose_trans(a: Numbers, b: Numbers) -> FloatArray:
    """URScript `pose_trans`: pose `b` (6,), given in `a` (6,), as seen from where `a` is given."""
    return np.array(pose_from(compose(frame_of(a), frame_of(b))))


def pose_inv(a: Numbers) -> FloatArray:
    """URScript `pose_inv`: the pose (6,) that undoes `a` (6,)."""
    return np.array(pose_from(inverted(frame_of(a))))
