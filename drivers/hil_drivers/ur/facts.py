"""What is known of a UR arm: from its description, then from its controller."""

from __future__ import annotations

from hil.core import FloatArray
from hil.robot import Capabilities, EffortKind, Limits, Segment
from hil_drivers import arm
from hil_drivers.ur.options import MOST_ACCELERATION, MOST_SPEED, Options


def capabilities_of(model: str, options: Options) -> Capabilities:
    """Return names, rate and the meaning of `effort`."""
    effort: EffortKind = "current" if options.torque_source == "current" else "torque"
    return arm.capabilities_of(model, options.frequency_hz, effort)


def limits_of(model: str, options: Options, reported: arm.ReportedLimits | None = None) -> Limits:
    """Return the maker's limits, narrowed by the controller's own once they are known."""
    return arm.limits_of(model, reported, options.speed_share)


def require_playable(segment: Segment, limits: Limits, standing: FloatArray) -> None:
    """Raise if the arm cannot execute a segment, or `ur-rtde` would not let it through.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (6,) the set-point it holds [rad].

    Raises:
        CommandRefused: See `hil_drivers.arm.require_executable`.
    """
    arm.require_executable(segment, limits, standing)
    where = f"segment {segment.index} ({segment.kind})"
    if not 0 <= segment.speed <= MOST_SPEED * arm.SPEED_SLACK:
        raise arm.refused(f"{where} asks for {segment.speed:.3f} rad/s, at most {MOST_SPEED} go")
    if not 0 <= segment.acceleration <= MOST_ACCELERATION:
        raise arm.refused(
            f"{where} asks for {segment.acceleration:.1f} rad/s², at most {MOST_ACCELERATION} go"
        )
