"""Prepared segments as the drives take them: raw set-points of all axes, a row per cycle."""

from __future__ import annotations

import numpy as np

from hil.errors import CommandRefused
from hil.robot import Limits, Segment
from hil.typing import FloatArray, IntArray
from hil_drivers.checks import SPEED_SLACK, refused, require_executable
from hil_drivers.cia402.scaling import Scaling
from hil_drivers.cia402.torque_model import TorqueModel
from hil_drivers.cia402.track import Track

AT_SET_POINT_RAD = 1e-4
"""Set-points are followed without being smoothed: a segment begins where the last one ended."""


def track_of(
    segment: Segment,
    limits: Limits,
    standing: FloatArray,
    rate_hz: float,
    scaling: Scaling,
    model: TorqueModel | None,
) -> Track:
    """A segment that can be executed, in the drives' integers.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (n,) the set-point that is held [rad].
        rate_hz: Rows per second of device time.
        scaling: Of the drives.
        model: Says the feed-forward torque; none is sent without.

    Raises:
        CommandRefused: It leaves the limits, jumps, begins elsewhere or moves at its ends.
    """
    require_executable(segment, limits, standing, at_set_point_rad=AT_SET_POINT_RAD)
    _require_no_jump(segment, limits, rate_hz)
    return Track(
        segment=segment.index,
        position=scaling.raw_position(segment.q),
        velocity=scaling.raw_velocity(segment.qd),
        torque=_torque(segment, scaling, model),
    )


def _torque(segment: Segment, scaling: Scaling, model: TorqueModel | None) -> IntArray:
    if model is None:
        return np.zeros(segment.q.shape, dtype=np.int64)
    return scaling.raw_torque(model.torque(segment.q, segment.qd, segment.qdd))


def _require_no_jump(segment: Segment, limits: Limits, rate_hz: float) -> None:
    """What velocities say is one thing, what drives follow are positions."""
    speed = np.abs(np.diff(segment.q, axis=0)).max(axis=0, initial=0.0) * rate_hz
    if (too_fast := np.flatnonzero(speed > limits.qd_max * SPEED_SLACK)).size:
        joint = int(too_fast[0])
        raise _jump(segment, joint, speed[joint], limits.qd_max[joint])


def _jump(segment: Segment, joint: int, speed: float, most: float) -> CommandRefused:
    return refused(
        f"segment {segment.index} ({segment.kind}) has set-points of joint {joint} that are "
        f"{speed:.3f} rad/s apart, {most:.3f} are allowed"
    )
