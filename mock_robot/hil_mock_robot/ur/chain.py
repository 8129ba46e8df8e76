"""The six joints of a UR arm in closed form: where everything is at one joint position.

All UR arms share one structure: the shoulder pan axis is vertical, the next three axes are
parallel, and the wrist turns twice by a right angle. Notation of the standard DH convention.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import cos, pi, sin

import numpy as np

from hil.arms import ArmDescription
from hil.core import SpecError
from hil_mock_robot.ur.poses import Frame, Numbers, Triple, floats

TWISTS = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
"""DH α of every UR arm [rad]."""


@dataclass(frozen=True, slots=True)
class Lengths:
    """The DH lengths of one arm that are not zero [m]."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float


@cache
def lengths_of(arm: ArmDescription) -> Lengths:
    """The lengths of an arm.

    Raises:
        SpecError: Its axes do not lie as those of a UR arm do.
    """
    if arm.n_joints == 6:
        a, alpha, d, theta = (column.tolist() for column in arm.dh.T)
        lengths = Lengths(d[0], a[1], a[2], d[3], d[4], d[5])
        others = [a[0], d[1], d[2], a[3], a[4], a[5], *theta]
        if np.allclose(alpha, TWISTS) and not any(others):
            return lengths
    raise SpecError(
        f"the axes of {arm.name} do not lie as those of a UR arm do",
        hint="the mock UR controller moves ur3, ur5, ur10 and their e-Series versions",
    )


class Posture:
    """One joint position of one arm, in the base frame.

    Args:
        lengths: Of the arm.
        q: (6,) [rad].

    Attributes:
        flange: Frame of the last link.
    """

    __slots__ = (
        "_axis_5", "_c1", "_origin_5", "_origin_6", "_s1", "_x2", "_x3", "_z1", "_z2", "_z3",
        "flange",
    )  # fmt: skip

    def __init__(self, lengths: Lengths, q: Numbers) -> None:
        q1, q2, q3, q4, q5, q6 = floats(q)
        c1, s1 = cos(q1), sin(q1)
        c, s = cos(q2 + q3 + q4), sin(q2 + q3 + q4)
        c5, s5, c6, s6 = cos(q5), sin(q5), cos(q6), sin(q6)
        d1, d4, d5, d6 = lengths.d1, lengths.d4, lengths.d5, lengths.d6
        self._c1, self._s1 = c1, s1
        # In the plane of the arm: x away from the pan axis, z up.
        self._z1 = d1
        self._x2, self._z2 = lengths.a2 * cos(q2), d1 + lengths.a2 * sin(q2)
        self._x3 = self._x2 + lengths.a3 * cos(q2 + q3)
        self._z3 = self._z2 + lengths.a3 * sin(q2 + q3)
        ax, ay, az = self._axis_5 = (c1 * s, s1 * s, -c)
        ox, oy, oz = self._origin_5 = (
            c1 * self._x3 + s1 * d4, s1 * self._x3 - c1 * d4, self._z3,
        )  # fmt: skip
        ox, oy, oz = self._origin_6 = ox + d5 * ax, oy + d5 * ay, oz + d5 * az
        # Axes of frame 5, whose z is that of the flange.
        xx, xy, xz = c1 * c5 * c + s1 * s5, s1 * c5 * c - c1 * s5, c5 * s
        yx, yy, yz = -c1 * s, -s1 * s, c
        zx, zy, zz = s1 * c5 - c1 * s5 * c, -c1 * c5 - s1 * s5 * c, -s5 * s
        self.flange: Frame = (
            c6 * xx + s6 * yx, c6 * yx - s6 * xx, zx,
            c6 * xy + s6 * yy, c6 * yy - s6 * xy, zy,
            c6 * xz + s6 * yz, c6 * yz - s6 * xz, zz,
            ox + d6 * zx, oy + d6 * zy, oz + d6 * zz,
        )  # fmt: skip

    @property
    def elbow(self) -> Triple:
        """Origin of the DH frame on the elbow's axis [m]."""
        return self._c1 * self._x2, self._s1 * self._x2, self._z2

    def elbow_velocity(self, qd: Numbers) -> Triple:
        """How fast `elbow` moves [m/s]."""
        pan, lift = floats(qd)[:2]
        out, up = -lift * (self._z2 - self._z1), lift * self._x2
        x, y, _ = self.elbow
        return self._c1 * out - y * pan, self._s1 * out + x * pan, up

    def jacobian(self, point: Triple) -> list[float]:
        """Geometric Jacobian of a point fixed to the flange: 36 numbers, row by row.

        Args:
            point: In the base frame [m].
        """
        x, y, z = point
        c1, s1 = self._c1, self._s1
        reach = c1 * x + s1 * y
        h1, h2, h3 = z - self._z1, z - self._z2, z - self._z3
        ax, ay, az = self._axis_5
        flange = self.flange
        bx, by, bz = flange[2], flange[5], flange[8]
        ux, uy, uz = _minus(point, self._origin_5)
        wx, wy, wz = _minus(point, self._origin_6)
        return [
            -y, -c1 * h1, -c1 * h2, -c1 * h3, ay * uz - az * uy, by * wz - bz * wy,
            x, -s1 * h1, -s1 * h2, -s1 * h3, az * ux - ax * uz, bz * wx - bx * wz,
            0.0, reach, reach - self._x2, reach - self._x3, ax * uy - ay * ux, bx * wy - by * wx,
            0.0, s1, s1, s1, ax, bx,
            0.0, -c1, -c1, -c1, ay, by,
            1.0, 0.0, 0.0, 0.0, az, bz,
        ]  # fmt: skip


def twist_of(jacobian: list[float], qd: Numbers) -> list[float]:
    """Velocity [m/s], then angular velocity [rad/s], of the point a Jacobian belongs to."""
    a, b, c, d, e, f = floats(qd)
    J = jacobian
    return [
        J[i] * a + J[i + 1] * b + J[i + 2] * c + J[i + 3] * d + J[i + 4] * e + J[i + 5] * f
        for i in (0, 6, 12, 18, 24, 30)
    ]


def _minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]
