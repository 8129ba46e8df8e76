"""Inverse kinematics of UR arms: all eight postures in closed form, the nearest one wins."""

from __future__ import annotations

from collections.abc import Iterator
from math import acos, asin, atan2, cos, hypot, inf, pi, sin

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.chain import Lengths, Posture, lengths_of
from hil_mock_robot.ur.poses import (
    Frame,
    Numbers,
    compose,
    floats,
    frame_of,
    inverted,
    rotation_vector,
)

SINGULAR = 1e-9
"""Sine of the wrist 2 angle below which only the sum of its neighbours matters."""
ROUNDING = 1e-9
"""How far a cosine may exceed 1 at the very end of the arm's reach, and a joint its limit [rad]."""
FAR = 1e3
"""Metres and radians beyond which, as for what is no number, there is no solution."""
ITERATIONS, DAMPING, LARGEST_STEP_RAD, STAGNANT = 60, 1e-3, 0.3, 0.9999
"""Of the fallback; it gives up when a step leaves more than this share of the error."""


def solve(
    arm: ArmDescription,
    pose: Numbers,
    q_near: Numbers,
    tcp: Numbers,
    *,
    position_m: float = 1e-9,
    orientation_rad: float = 1e-9,
) -> FloatArray | None:
    """The joint position (6,) [rad] that brings the tool to a pose, or None.

    Of all postures within the joint limits it is the one with the least sum of squared distances
    to `q_near`. Where there is none in closed form, damped least squares go as near as they can.

    Args:
        arm: A UR arm.
        pose: (6,) of the tool in the base frame.
        q_near: (6,) [rad].
        tcp: (6,) tool in the flange frame.
        position_m: Largest position error of what the fallback finds [m].
        orientation_rad: Its largest orientation error [rad].
    """
    if not all(abs(number) < FAR for each in (pose, q_near, tcp) for number in floats(each)):
        return None
    flange = compose(frame_of(pose), inverted(frame_of(tcp)))
    found = nearest(arm, flange, q_near)
    if found is None:
        found = approach(arm, flange, q_near, position_m, orientation_rad)
    return None if found is None else np.array(found)


def nearest(arm: ArmDescription, flange: Frame, q_near: Numbers) -> list[float] | None:
    """The same for a frame of the flange, in closed form only."""
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
    """Up to eight joint positions [rad] that bring the flange to a frame, not yet unwound.

    Args:
        lengths: Of the arm.
        flange: Where the flange shall be.
        wrist_3: What wrist 3 is where it is free to choose, in the wrist singularity [rad].
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


def unwind(
    q: list[float], near: Numbers, low: list[float], high: list[float]
) -> list[float] | None:
    """Whole turns added so that each joint is nearest to `near` within its limits [rad]."""
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
    """Damped least squares from `near` (Nakamura and Hanafusa 1986); None when it ends far off."""
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


def _wrists(flange: Frame, pan: float, wrist_3: float) -> Iterator[tuple[float, float]]:
    """Wrist 2 and wrist 3 for an angle of the pan joint; the wrist flips once."""
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
    """The three parallel joints: elbow up and elbow down."""
    c1, s1, c6, s6 = cos(pan), sin(pan), cos(wrist_3), sin(wrist_3)
    r00, r01, r02, r10, r11, r12, r20, r21, r22, px, py, pz = flange
    # The y axis of frame 5 lies in the plane and tells how far all three have turned together.
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
