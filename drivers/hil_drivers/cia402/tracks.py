"""Prepared segments as the drives take them: raw set-points of all axes, a row per cycle."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, IntArray
from hil.robot import Limits, Segment
from hil_drivers.arm import require_executable
from hil_drivers.cia402.jumps import require_smooth
from hil_drivers.cia402.scaling import Scaling
from hil_drivers.cia402.torque_model import TorqueModel
from hil_drivers.cia402.track import Track

AT_SET_POINT_RAD = 1e-4
"""Set-points are followed without being smoothed: farther away, a segment's begin is reached first.
"""

GIVEN_RAD = 2e-3
"""A brake gives when its axis is switched on, after the plan was made from where the arm stood: so
much is made good before the first motion. Between motions it would hide a mistake."""

LED_RAD = 0.05
"""Led by a spring (CST, CSV), an arm rests beside its set-point, where friction keeps it."""

REACHED_S = 0.4


def track_of(
    segment: Segment,
    limits: Limits,
    standing: FloatArray,
    rate_hz: float,
    scaling: Scaling,
    model: TorqueModel | None,
    *,
    led: bool = False,
    first: bool = False,
) -> Track:
    """A segment that can be executed, in the drives' integers.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (n,) the set-point that is held [rad].
        rate_hz: Rows per second of device time.
        scaling: Of the drives.
        model: Says the feed-forward torque; none is sent without.
        led: The master leads the joints; its begin may be farther from there.
        first: Nothing has moved since the axes were switched on; a brake may have given.

    Raises:
        CommandRefused: It leaves the limits, jumps, begins elsewhere or moves at its ends.
    """
    moves = segment.kind != "hold"
    tolerance = LED_RAD if led else GIVEN_RAD if first and moves else AT_SET_POINT_RAD
    require_executable(segment, limits, standing, at_set_point_rad=tolerance)
    require_smooth(segment, limits, rate_hz)
    q, qd, qdd = segment.q, segment.qd, segment.qdd
    if np.abs(q[0] - standing).max() > AT_SET_POINT_RAD:
        way = _way(standing, q[0], rate_hz)
        q, qd, qdd = (np.vstack(pair) for pair in zip(way, (q, qd, qdd), strict=True))
    return Track(
        segment=segment.index,
        position=scaling.raw_position(q),
        velocity=scaling.raw_velocity(qd),
        torque=_torque(q, qd, qdd, scaling, model),
    )


def _way(start: FloatArray, end: FloatArray, rate_hz: float) -> tuple[FloatArray, ...]:
    """(N, n) positions, velocities, accelerations from rest to rest by a polynomial of degree 5."""
    t = np.arange(round(REACHED_S * rate_hz))[:, None] / round(REACHED_S * rate_hz)
    way = end - start
    q = start + way * (10 * t**3 - 15 * t**4 + 6 * t**5)
    qd = way * (30 * t**2 - 60 * t**3 + 30 * t**4) / REACHED_S
    qdd = way * (60 * t - 180 * t**2 + 120 * t**3) / REACHED_S**2
    return q, qd, qdd


def _torque(
    q: FloatArray, qd: FloatArray, qdd: FloatArray, scaling: Scaling, model: TorqueModel | None
) -> IntArray:
    if model is None:
        return np.zeros(q.shape, dtype=np.int64)
    return scaling.raw_torque(model.torque(q, qd, qdd))
