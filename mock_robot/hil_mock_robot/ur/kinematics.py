"""Forward, differential and inverse kinematics of a UR arm from its published lengths.

A pose has shape (6,): position [m] and rotation vector [rad] of the tool in the base frame; `tcp`
is the pose of the tool in the flange frame. `Frame` is a pose as twelve plain floats, because
operations on small numpy arrays are too slow for a controller tick. `Posture` is the kinematic
chain at one joint position. `solve` and `nearest` compute the inverse kinematics in closed form
(`postures`); `solve` uses an iteration if no closed-form solution exists.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import acos, asin, atan2, cos, hypot, inf, pi, sin, sqrt

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray, SpecError

Numbers = Sequence[float] | FloatArray
Frame = tuple[float, float, float, float, float, float, float, float, float, float, float, float]


def tool_frame(arm: ArmDescription, q: Numbers, tcp: Numbers) -> Frame:
    """Return the frame of the tool at `q` (6,) [rad]."""
    return compose(Posture(lengths_of(arm), q).flange, frame_of(tcp))


def pose_of(arm: ArmDescription, q: Numbers, tcp: Numbers) -> FloatArray:
    """Return the tool pose (6,) at `q` (6,) [rad], as in URScript `get_forward_kin`."""
    return np.array(pose_from(tool_frame(arm, q, tcp)))


def jacobian(arm: ArmDescription, q: Numbers, tcp: Numbers) -> FloatArray:
    """Return the geometric tool Jacobian (6, 6) in the base frame: linear, then angular rows."""
    return np.array(_jacobian(arm, q, tcp)).reshape(6, 6)


def _jacobian(arm: ArmDescription, q: Numbers, tcp: Numbers) -> list[float]:
    posture = Posture(lengths_of(arm), q)
    tool = compose(posture.flange, frame_of(tcp))
    return posture.jacobian((tool[9], tool[10], tool[11]))


def tool_velocity(arm: ArmDescription, q: Numbers, qd: Numbers, tcp: Numbers) -> FloatArray:
    """Return the velocity (6,) of the tool in the base frame, [m/s] and [rad/s]."""
    return np.array(twist_of(_jacobian(arm, q, tcp), qd))


TWISTS = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
"""DH parameter α of each joint [rad], equal for all UR arms."""


@dataclass(frozen=True, slots=True)
class Lengths:
    """Nonzero DH parameters of one arm that are lengths [m]."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float


@cache
def lengths_of(arm: ArmDescription) -> Lengths:
    """Return the nonzero DH lengths of an arm.

    Raises:
        SpecError: The joint axes of the arm do not match those of a UR arm.
    """
    if arm.n_joints == 6:
        a, alpha, d, theta = (column.tolist() for column in arm.dh.T)
        lengths = Lengths(d[0], a[1], a[2], d[3], d[4], d[5])
        others = [a[0], d[1], d[2], a[3], a[4], a[5], *theta]
        if np.allclose(alpha, TWISTS) and not any(others):
            return lengths
    raise SpecError(
        f"the joint axes of {arm.name} are not arranged like those of a UR arm",
        hint="the mock UR controller moves ur3, ur5, ur10 and their e-Series versions",
    )


Triple = tuple[float, float, float]


class Posture:
    """Kinematic chain of one arm at one joint position, in the base frame.

    Args:
        lengths: DH lengths of the arm.
        q: Joint position, (6,) [rad].

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
        # Axes of frame 5, whose z axis is parallel to that of the flange.
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
        """Origin of the DH frame on the axis of the elbow joint [m]."""
        return self._c1 * self._x2, self._s1 * self._x2, self._z2

    def elbow_velocity(self, qd: Numbers) -> Triple:
        """Return the velocity of the point `elbow` [m/s]."""
        pan, lift = floats(qd)[:2]
        out, up = -lift * (self._z2 - self._z1), lift * self._x2
        x, y, _ = self.elbow
        return self._c1 * out - y * pan, self._s1 * out + x * pan, up

    def jacobian(self, point: Triple) -> list[float]:
        """Return the geometric Jacobian of a point fixed to the flange: 36 numbers, row by row.

        Args:
            point: Position of the point in the base frame [m].
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


def _minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def twist_of(jacobian: list[float], qd: Numbers) -> list[float]:
    """Return the velocity [m/s] of the point of a Jacobian, and the angular velocity [rad/s]."""
    a, b, c, d, e, f = floats(qd)
    J = jacobian
    return [
        J[i] * a + J[i + 1] * b + J[i + 2] * c + J[i + 3] * d + J[i + 4] * e + J[i + 5] * f
        for i in (0, 6, 12, 18, 24, 30)
    ]


SINGULAR = 1e-9
"""Sine of the wrist 2 angle below which the wrist is singular: wrist 3 and the parallel joints
are then determined only in sum."""

ROUNDING = 1e-9
"""Tolerance for a cosine above 1 at the limit of the reach, and for a joint limit [rad]."""

FAR = 1e3
"""Magnitude of a pose coordinate [m or rad] beyond which no solution is searched."""

ITERATIONS, DAMPING, LARGEST_STEP_RAD, STAGNANT = 60, 1e-3, 0.3, 0.9999
"""Parameters of the damped least-squares iteration, which stops when a step leaves more than the
share `STAGNANT` of the error."""


def solve(
    arm: ArmDescription,
    pose: Numbers,
    q_near: Numbers,
    tcp: Numbers,
    *,
    position_m: float = 1e-9,
    orientation_rad: float = 1e-9,
) -> FloatArray | None:
    """Return the joint position (6,) [rad] that moves the tool to a pose, or None.

    Of all postures within the joint limits, the result has the smallest sum of squared distances to
    `q_near`. If there is no closed-form solution, a damped least-squares iteration searches for the
    nearest position.

    Args:
        arm: UR arm.
        pose: Tool pose in the base frame, (6,).
        q_near: Reference joint position, (6,) [rad].
        tcp: Tool in the flange frame, (6,).
        position_m: Maximum position error of a damped least-squares solution [m].
        orientation_rad: Maximum orientation error of a damped least-squares solution [rad].
    """
    if not all(abs(number) < FAR for each in (pose, q_near, tcp) for number in floats(each)):
        return None
    flange = compose(frame_of(pose), inverted(frame_of(tcp)))
    found = nearest(arm, flange, q_near)
    if found is None:
        found = approach(arm, flange, q_near, position_m, orientation_rad)
    return None if found is None else np.array(found)


def nearest(arm: ArmDescription, flange: Frame, q_near: Numbers) -> list[float] | None:
    """Return the closed-form solution nearest to `q_near` for a flange frame, or None."""
    lengths, near = lengths_of(arm), floats(q_near)
    low, high = arm.q_min.tolist(), arm.q_max.tolist()
    best, least = None, inf
    for posture in postures(lengths, flange, near[5]):
        unwound = unwind(posture, near, low, high)
        if unwound is None:
            continue
        distance = sum((a - b) ** 2 for a, b in zip(unwound, near, strict=True))
        if distance < least:
            best, least = unwound, distance
    return best


def postures(lengths: Lengths, flange: Frame, wrist_3: float) -> Iterator[list[float]]:
    """Yield up to eight joint positions [rad] for a flange frame, without whole turns added.

    Args:
        lengths: DH lengths of the arm.
        flange: Required flange frame.
        wrist_3: Angle of wrist 3 in the wrist singularity, in which it is arbitrary [rad].
    """
    x, y = flange[9] - lengths.d6 * flange[2], flange[10] - lengths.d6 * flange[5]
    reach = hypot(x, y)
    if reach < abs(lengths.d4) * (1 - ROUNDING):
        return
    direction = atan2(y, x)
    offset = asin(max(-1.0, min(1.0, lengths.d4 / reach)))
    for pan in (direction + offset, direction + pi - offset):
        for wrist in _wrists(flange, pan, wrist_3):
            yield from _planar(lengths, flange, pan, *wrist)


def _wrists(flange: Frame, pan: float, wrist_3: float) -> Iterator[tuple[float, float]]:
    """Yield the angles of wrists 2 and 3 for a pan angle, for both signs of wrist 2."""
    r00, r01, r02, r10, r11, r12 = flange[:6]
    c1, s1 = cos(pan), sin(pan)
    along_x, along_y = r00 * s1 - r10 * c1, r01 * s1 - r11 * c1
    cosine, sine = r02 * s1 - r12 * c1, hypot(along_x, along_y)
    if sine < SINGULAR:
        yield atan2(0.0, cosine), wrist_3
        return
    yield atan2(sine, cosine), atan2(-along_y, along_x)
    yield atan2(-sine, cosine), atan2(along_y, -along_x)


def _planar(
    lengths: Lengths, flange: Frame, pan: float, wrist_2: float, wrist_3: float
) -> Iterator[list[float]]:
    """Yield the joint positions for both angles of the elbow: elbow up and elbow down."""
    c1, s1, c6, s6 = cos(pan), sin(pan), cos(wrist_3), sin(wrist_3)
    r00, r01, r02, r10, r11, r12, r20, r21, r22, px, py, pz = flange
    # The y axis of frame 5 lies in the plane and gives the sum of the three joint angles.
    yx, yy, yz = s6 * r00 + c6 * r01, s6 * r10 + c6 * r11, s6 * r20 + c6 * r21
    total = atan2(-(c1 * yx + s1 * yy), yz)
    x = c1 * (px - lengths.d6 * r02) + s1 * (py - lengths.d6 * r12) - lengths.d5 * sin(total)
    z = pz - lengths.d6 * r22 - lengths.d1 + lengths.d5 * cos(total)
    a2, a3 = lengths.a2, lengths.a3
    cosine = (x * x + z * z - a2 * a2 - a3 * a3) / (2 * a2 * a3)
    if abs(cosine) > 1 + ROUNDING:
        return
    bend = acos(max(-1.0, min(1.0, cosine)))
    for elbow in (bend, -bend):
        lift = atan2(z, x) - atan2(a3 * sin(elbow), a2 + a3 * cos(elbow))
        yield [pan, lift, elbow, total - lift - elbow, wrist_2, wrist_3]


def unwind(
    q: list[float], near: Numbers, low: list[float], high: list[float]
) -> list[float] | None:
    """Return angles with whole turns added, nearest to `near` within the limits [rad], or None."""
    unwound = []
    for angle, goal, least, most in zip(q, near, low, high, strict=True):
        nearest = angle + 2 * pi * round((goal - angle) / (2 * pi))
        if nearest > most + ROUNDING:
            nearest -= 2 * pi
        elif nearest < least - ROUNDING:
            nearest += 2 * pi
        if not least - ROUNDING <= nearest <= most + ROUNDING:
            return None
        unwound.append(min(max(nearest, least), most))
    return unwound


def approach(
    arm: ArmDescription, flange: Frame, near: Numbers, position_m: float, orientation_rad: float
) -> list[float] | None:
    """Return a damped least-squares solution from `near`, or None if its error is too large.

    Source: Nakamura and Hanafusa 1986.
    """
    lengths, q, least = lengths_of(arm), np.array(near, dtype=np.float64), inf
    for _ in range(ITERATIONS):
        posture = Posture(lengths, q)
        now = posture.flange
        back = compose(flange, inverted(now))
        error = np.array([flange[9 + i] - now[9 + i] for i in range(3)] + [*rotation_vector(back)])
        if _close(error, position_m, orientation_rad):
            return unwind(q.tolist(), floats(near), arm.q_min.tolist(), arm.q_max.tolist())
        size = float(np.linalg.norm(error))
        if size > least * STAGNANT:
            return None
        least = size
        J = np.array(posture.jacobian((now[9], now[10], now[11]))).reshape(6, 6)
        step = J.T @ np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), error)
        q += step * min(1.0, LARGEST_STEP_RAD / max(float(np.abs(step).max()), 1e-12))
    return None


def _close(error: FloatArray, position_m: float, orientation_rad: float) -> bool:
    return bool(
        np.linalg.norm(error[:3]) <= position_m and np.linalg.norm(error[3:]) <= orientation_rad
    )


NOWHERE: Frame = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Identity frame."""


def floats(values: Numbers) -> Sequence[float]:
    """Return the numbers as Python floats, because scalar arithmetic with numpy is slow."""
    return values.tolist() if isinstance(values, np.ndarray) else values


def frame_of(pose: Numbers) -> Frame:
    """Return the frame of a pose (6,)."""
    x, y, z, rx, ry, rz = floats(pose)
    return (*rotation_of(rx, ry, rz), x, y, z)


def pose_from(frame: Frame) -> list[float]:
    """Return the pose (6,) of a frame; the length of the rotation vector is at most π."""
    return [frame[9], frame[10], frame[11], *rotation_vector(frame)]


def rotation_of(
    x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the rotation matrix, row by row, of a rotation vector [rad] (Rodrigues' formula)."""
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
    """Return the rotation vector [rad] of a frame, accurate for every angle from 0 to π.

    The computation uses the quaternion, starting with its largest component (Shepperd 1978). A
    formula that uses only the trace loses all digits at an angle of π.
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
    """Return frame `b`, which is expressed in frame `a`, in the reference frame of `a`."""
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
    """Return the inverse of a frame."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, x, y, z = frame
    return (
        a0, a3, a6, a1, a4, a7, a2, a5, a8,
        -(a0 * x + a3 * y + a6 * z), -(a1 * x + a4 * y + a7 * z), -(a2 * x + a5 * y + a8 * z),
    )  # fmt: skip


def turned(frame: Frame, x: float, y: float, z: float) -> Triple:
    """Return a vector, expressed in a frame, in the axes of that frame's reference frame."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = frame[:9]
    return a0 * x + a1 * y + a2 * z, a3 * x + a4 * y + a5 * z, a6 * x + a7 * y + a8 * z


def pose_trans(a: Numbers, b: Numbers) -> FloatArray:
    """Return pose `b` (6,), expressed in `a` (6,), in the reference frame of pose `a`."""
    return np.array(pose_from(compose(frame_of(a), frame_of(b))))


def pose_inv(a: Numbers) -> FloatArray:
    """Return the inverse pose (6,) of `a` (6,), as in URScript `pose_inv`."""
    return np.array(pose_from(inverted(frame_of(a))))
