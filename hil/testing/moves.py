"""Small safe motions of any robot, for tests of drivers."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Literal

import numpy as np

from hil.core import FloatArray, StructArray
from hil.excitation import Hold, Line, Motion
from hil.robot import Robot, Segment, Status

SPEED_RAD_S = 0.3
ACCELERATION_RAD_S2 = 1.0
REST_RAD_S = 0.02
REST_S = 5.0
"""Time limit within which all joint speeds must fall below `REST_RAD_S` after a stop [s]."""

LONG_WAY_RAD = 0.4
AT_SET_POINT_RAD = 0.01
SURE_S = 0.1
"""Time for which the arm must remain static before it counts as static [s]."""

_UNDER_WAY_RAD = 0.02
_PATIENCE_S = 3.0

Kind = Literal["move", "trajectory", "hold"]

_numbers = itertools.count(1)


def standing_at(robot: Robot) -> FloatArray:
    """Return the set-point (n,) [rad] that a static robot holds.

    If the set-point is unknown, the position is returned.
    """
    row = robot.read()[-1]
    q, target = np.array(row["q"]), np.array(row["q_target"])
    return np.where(np.abs(q - target) < AT_SET_POINT_RAD, target, q)


def room(robot: Robot) -> tuple[float, float]:
    """Return the distances of the last joint from its upper and lower limits [rad]."""
    q, limits = standing_at(robot)[-1], robot.limits
    return float(limits.q_max[-1] - q), float(q - limits.q_min[-1])


def move(robot: Robot, way_rad: float, kind: Literal["move", "trajectory"] = "move") -> Segment:
    """Return a slow motion of the last joint towards the more distant joint limit."""
    up, down = room(robot)
    limits = robot.limits
    velocity = min(SPEED_RAD_S, float(limits.qd_max[-1]) / 2)
    acceleration = min(ACCELERATION_RAD_S2, float(limits.qdd_max[-1]) / 2)
    return line(robot, way_rad if up > down else -way_rad, velocity, acceleration, kind)


def line(
    robot: Robot,
    way_rad: float,
    velocity: float,
    acceleration: float,
    kind: Literal["move", "trajectory"] = "move",
) -> Segment:
    """Return a motion of the last joint from the present position, without checking limits.

    Args:
        robot: Static robot.
        way_rad: Distance of the motion with sign [rad].
        velocity: Maximum velocity, reached if the distance is long enough [rad/s].
        acceleration: Maximum acceleration, reached if the distance is long enough [rad/s²].
        kind: Kind of the segment: `move` or `trajectory`.
    """
    q, rate = standing_at(robot), robot.capabilities.rate_hz
    goal = q.copy()
    goal[-1] += way_rad
    ends = tuple(q.tolist()), tuple(goal.tolist())
    # The jerk is just high enough to reach both limits, because a driver can reject a high jerk.
    jerk = 1.2 * acceleration**2 / velocity
    return _segment(robot, Line(*ends, velocity, acceleration, jerk, rate_hz=rate), kind)


def hold(robot: Robot) -> Segment:
    """Return a segment with one set-point at the present position of the robot."""
    return _segment(robot, Hold(tuple(standing_at(robot).tolist())), "hold")


def begin(robot: Robot, segment: Segment) -> None:
    """Start a segment and read the state until the arm moves.

    Raises:
        AssertionError: The arm does not start to move in time.
    """
    robot.prepare(segment)
    robot.start()
    for row in rows_for(robot, _PATIENCE_S):
        if row["segment"] == segment.index and _way(row, segment) > _UNDER_WAY_RAD:
            return
    raise AssertionError(f"the robot has not moved within {_PATIENCE_S:g} s")


def follow(robot: Robot, segment: Segment) -> StructArray:
    """Execute a segment completely; return the rows with the number of the segment.

    Raises:
        AssertionError: The segment does not end in time.
    """
    robot.prepare(segment)
    robot.start()
    allowed = len(segment.q) / robot.capabilities.rate_hz * 1.5 + _PATIENCE_S
    mine = []
    for row in rows_for(robot, allowed):
        if row["segment"] == segment.index:
            mine.append(row)
            if not row["status"] & Status.MOVING:
                return np.array(mine)
    raise AssertionError(
        f"segment {segment.index} ({segment.kind}) has not ended within {allowed:.1f} s; "
        f"{len(mine)} rows carry its number"
    )


def settle(robot: Robot) -> None:
    """Read the state until the arm is static.

    Raises:
        AssertionError: The arm does not become static in time.
    """
    for row in rows_for(robot, REST_S):
        if not row["status"] & Status.MOVING and np.abs(row["qd"]).max() < REST_RAD_S:
            return
    raise AssertionError(f"the arm is not at rest {REST_S:g} s after stop")


def rest_time(robot: Robot) -> float:
    """Read until the arm has remained static; return when it became static [s].

    The returned time is a device time.

    Raises:
        AssertionError: The arm does not become static in time.
    """
    since = np.inf
    for row in rows_for(robot, REST_S):
        now = float(row["device_time"])
        since = min(since, now) if np.abs(row["qd"]).max() < REST_RAD_S else np.inf
        if now - since >= SURE_S:
            return since
    raise AssertionError(f"the arm is not at rest {REST_S:g} s after stop")


def rows_for(robot: Robot, seconds: float) -> Iterator[np.void]:
    """Yield state rows for a duration on the device clock.

    For robots with a wall clock, the duration must also pass on the host clock.
    """
    wall = robot.capabilities.clock == "wall"
    until, last = time.monotonic() + seconds, np.inf
    while not wall or time.monotonic() < until:
        for row in robot.read():
            last = min(last, float(row["device_time"]) + seconds)
            if row["device_time"] > last:
                return
            yield row


def _segment(robot: Robot, motion: Motion, kind: Kind) -> Segment:
    samples = motion.sample(robot.capabilities.rate_hz)
    return Segment(
        index=next(_numbers),
        kind=kind,
        q=samples.q,
        qd=samples.qd,
        qdd=samples.qdd,
        speed=float(np.abs(samples.qd).max()),
        acceleration=float(np.abs(samples.qdd).max()),
    )


def _way(row: np.void, segment: Segment) -> float:
    return float(np.abs(row["q"] - segment.q[0]).max())
