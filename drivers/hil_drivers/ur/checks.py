"""What a UR arm is asked to do, looked at before anything moves."""

from __future__ import annotations

from hil.core import FloatArray
from hil.robot import Limits, Segment
from hil_drivers import checks
from hil_drivers.ur.options import MOST_ACCELERATION, MOST_SPEED


def require_executable(segment: Segment, limits: Limits, standing: FloatArray) -> None:
    """Refuse what the arm cannot do, or what `ur-rtde` would not let through.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (6,) the set-point it holds [rad].

    Raises:
        CommandRefused: See `hil_drivers.checks`.
    """
    checks.require_executable(segment, limits, standing)
    where = f"segment {segment.index} ({segment.kind})"
    if not 0 <= segment.speed <= MOST_SPEED * checks.SPEED_SLACK:
        raise checks.refused(f"{where} asks for {segment.speed:.3f} rad/s, at most {MOST_SPEED} go")
    if not 0 <= segment.acceleration <= MOST_ACCELERATION:
        raise checks.refused(
            f"{where} asks for {segment.acceleration:.1f} rad/s², at most {MOST_ACCELERATION} go"
        )
