"""What a robot cannot do is refused before anything moves, as checks."""

from __future__ import annotations

from typing import Literal

import numpy as np

from hil.core import FloatArray, HilError, RobotError
from hil.robot import Robot, Segment, Status
from hil.testing.asserts import raises
from hil.testing.moves import AT_SET_POINT_RAD, line, room, rows_for, standing_at

TOO_FAR_RAD = 0.2
TOO_MUCH = 1.5
"""Share of a limit that is asked for."""

_RUN_UP = 2.2
"""Way that getting fast and slow again takes, in velocities squared per acceleration."""

WATCHED_S = 0.2
KINDS: tuple[Literal["move", "trajectory"], ...] = ("move", "trajectory")


def a_position_beyond_the_limits_is_refused(robot: Robot) -> None:
    """`prepare` raises for a segment that leaves the joint range, and nothing moves."""
    up, down = room(robot)
    way = up + TOO_FAR_RAD if up < down else -down - TOO_FAR_RAD
    if not np.isfinite(way):
        return  # a joint that turns for ever has no end to go beyond
    velocity, acceleration = _half(robot)
    for kind in KINDS:
        _refused(robot, line(robot, way, velocity, acceleration, kind), "leaves the joint range")


def a_velocity_beyond_the_limits_is_refused(robot: Robot) -> None:
    """The same for one that is faster than `limits.qd_max`."""
    _, acceleration = _half(robot)
    velocity = TOO_MUCH * float(robot.limits.qd_max[-1])
    for kind in KINDS:
        segment = _within_range(robot, velocity, acceleration, kind)
        _refused(robot, segment, f"asks for {np.abs(segment.qd).max():.2f} rad/s")


def an_acceleration_beyond_the_limits_is_refused(robot: Robot) -> None:
    """The same for one that needs more than `limits.qdd_max`."""
    velocity = 0.9 * float(robot.limits.qd_max[-1])
    acceleration = TOO_MUCH * float(robot.limits.qdd_max[-1])
    for kind in KINDS:
        segment = _within_range(robot, velocity, acceleration, kind)
        _refused(robot, segment, f"asks for {np.abs(segment.qdd).max():.1f} rad/s²")


def _half(robot: Robot) -> tuple[float, float]:
    limits = robot.limits
    return float(limits.qd_max[-1]) / 2, float(limits.qdd_max[-1]) / 2


def _within_range(
    robot: Robot, velocity: float, acceleration: float, kind: Literal["move", "trajectory"]
) -> Segment:
    """As far as it takes to get that fast; harder where there is no room for it."""
    up, down = room(robot)
    way = min(_RUN_UP * velocity**2 / acceleration, 0.9 * max(up, down))
    acceleration = max(acceleration, _RUN_UP * velocity**2 / way)
    return line(robot, way if up >= down else -way, velocity, acceleration, kind)


def _refused(robot: Robot, segment: Segment, what: str) -> None:
    here = standing_at(robot)
    raises(HilError, lambda: robot.prepare(segment), f"prepare of a {segment.kind} that {what}")
    raises(RobotError, robot.start, "start after prepare has refused")
    for row in rows_for(robot, WATCHED_S):
        moved = _off(row, here)
        assert moved < AT_SET_POINT_RAD, f"it was refused, and the arm has moved {moved:.3f} rad"
        assert not row["status"] & Status.MOVING, "it was refused, and rows say that the arm moves"


def _off(row: np.void, here: FloatArray) -> float:
    return float(np.abs(row["q"] - here).max())
