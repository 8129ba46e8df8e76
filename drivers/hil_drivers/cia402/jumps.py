"""What drives would do with a segment: they follow its positions, whatever its velocities say."""

from __future__ import annotations

import numpy as np

from hil.core import CommandRefused, FloatArray
from hil.robot import Limits, Segment
from hil_drivers.arm import SPEED_SLACK, refused

ACCELERATION_SLACK = 1.10
"""Second differences of sampled polynomials and rounded positions may be that much more."""

ROUNDING_RAD = 1e-8
"""Of a position; second differences see four of it."""


def require_smooth(segment: Segment, limits: Limits, rate_hz: float) -> None:
    """Refuse positions between which drives would jump.

    Args:
        segment: The next one.
        limits: Of the arm.
        rate_hz: Rows per second of device time.

    Raises:
        CommandRefused: Positions are farther apart than the fastest speed, bend more than the
            highest acceleration, do not begin and end at rest; or a hold moves.
    """
    if segment.kind == "hold" and len(segment.q) != 1:
        raise refused(f"{_where(segment)} has {len(segment.q)} rows: a hold has one")
    speed = np.abs(np.diff(segment.q, axis=0)).max(axis=0, initial=0.0) * rate_hz
    if (too_fast := np.flatnonzero(speed > limits.qd_max * SPEED_SLACK)).size:
        joint = int(too_fast[0])
        raise refused(
            f"{_where(segment)} has set-points of joint {joint} that are {speed[joint]:.3f} rad/s "
            f"apart, {limits.qd_max[joint]:.3f} are allowed"
        )
    # At rest before the first row and after the last one: a segment that sets out or ends at
    # speed bends there.
    at_rest = np.vstack((segment.q[:1], segment.q, segment.q[-1:]))
    bends = np.abs(np.diff(at_rest, 2, axis=0)) * rate_hz**2
    most = limits.qdd_max * ACCELERATION_SLACK + 4 * ROUNDING_RAD * rate_hz**2
    if (bends > most).any():
        raise _too_sharp(segment, bends, limits.qdd_max)


def _too_sharp(segment: Segment, bends: FloatArray, most: FloatArray) -> CommandRefused:
    row, joint = np.unravel_index(int((bends / most).argmax()), bends.shape)
    place = {0: "sets out", len(bends) - 1: "ends"}.get(int(row), f"bends at row {row}")
    return refused(
        f"{_where(segment)} {place} with {bends[row, joint]:.1f} rad/s² of joint {joint} by its "
        f"positions, {most[joint]:.3f} are allowed"
    )


def _where(segment: Segment) -> str:
    return f"segment {segment.index} ({segment.kind})"
