"""What an arm is asked to do, looked at before anything moves."""

from __future__ import annotations

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, FloatArray
from hil.robot import Limits, Segment

AT_SET_POINT_RAD = 0.02
SLACK_RAD = 1e-6
REST_RAD_S = 0.01
SPEED_SLACK = 1.001


def require_executable(
    segment: Segment,
    limits: Limits,
    standing: FloatArray,
    *,
    at_set_point_rad: float = AT_SET_POINT_RAD,
) -> None:
    """Refuse what the arm cannot do, or would do with a jump.

    Args:
        segment: The next one.
        limits: Of the arm with n joints.
        standing: (n,) the set-point it holds [rad].
        at_set_point_rad: How far from there the segment may begin [rad].

    Raises:
        CommandRefused: It leaves the limits, begins elsewhere or moves at its ends.
    """
    where = f"segment {segment.index} ({segment.kind})"
    n = len(limits.q_min)
    shapes = {np.shape(array) for array in (segment.q, segment.qd, segment.qdd)}
    if shapes != {(len(segment.q), n)} or not len(segment.q):
        raise refused(f"{where} is for {segment.q.shape[-1]} joints, the arm has {n}")
    numbers = (segment.q, segment.qd, segment.qdd, (segment.speed, segment.acceleration))
    if not all(np.isfinite(array).all() for array in numbers):
        raise refused(f"{where} holds numbers that are none")
    _require_within(where, segment, limits)
    off = float(np.abs(segment.q[0] - standing).max())
    if off > at_set_point_rad:
        raise refused(f"{where} begins {off:.4f} rad from where the arm stands")
    if segment.kind != "hold" and np.abs(segment.qd[[0, -1]]).max() > REST_RAD_S:
        raise refused(f"{where} does not begin and end at rest")


def require_liftable(payload: Payload, limits: Limits) -> None:
    """Refuse a load that the arm is not made for.

    Raises:
        CommandRefused: It is too heavy.
    """
    if payload.mass > limits.payload_max_kg:
        raise CommandRefused(
            f"a load of {payload.mass:g} kg is too heavy: the arm carries "
            f"{limits.payload_max_kg:g} kg",
            hint="mount a lighter one",
        )


def _require_within(where: str, segment: Segment, limits: Limits) -> None:
    q = segment.q
    if (q < limits.q_min - SLACK_RAD).any() or (q > limits.q_max + SLACK_RAD).any():
        raise refused(f"{where} leaves the arm's joint range")
    _require_joints_within(where, "rad/s", segment.qd, limits.qd_max)
    _require_joints_within(where, "rad/s²", segment.qdd, limits.qdd_max)


def _require_joints_within(where: str, unit: str, asked: FloatArray, most: FloatArray) -> None:
    highest = np.abs(asked).max(axis=0)
    if (highest > most * SPEED_SLACK).any():
        joint = int((highest - most).argmax())
        raise refused(
            f"{where} moves joint {joint} at {highest[joint]:.3f} {unit}, {most[joint]:.3f} are "
            "allowed"
        )


def refused(why: str) -> CommandRefused:
    """The error for a segment that cannot be executed."""
    return CommandRefused(why, hint="plan again for this arm, from where it stands")
