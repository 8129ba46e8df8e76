"""Coming to rest from any motion: along the present direction, all joints or the tool."""

from __future__ import annotations

import numpy as np

from hil.arms import ArmDescription
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.following import ToolFollower
from hil_mock_robot.ur.limits import MotionImpossible
from hil_mock_robot.ur.poses import Numbers

JOINTS_INSTEAD_RAD_S2 = 8.0
"""Where the tool cannot be stopped on a straight line, the joints are, with this."""


class StopJoints:
    """URScript `stopj(a)`: the fastest joint decelerates with `a`, the others in proportion.

    Args:
        deceleration: [rad/s²].
        tick_s: Device time of a tick.
    """

    def __init__(self, deceleration: float, tick_s: float) -> None:
        self._a, self._tick_s = deceleration, tick_s

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """See `Motion`; the speed slider does not delay a stop."""
        speed = float(np.abs(now[1]).max())
        if speed == 0.0:
            return None
        left = max(0.0, 1.0 - self._a * self._tick_s / speed)
        v = now[1] * left
        q = now[0] + 0.5 * (now[1] + v) * self._tick_s
        return np.stack((q, v, (v - now[1]) / self._tick_s))


class StopL:
    """URScript `stopl(a)`: the tool decelerates on the line on which it moves.

    A tool that moves mostly by turning decelerates its turn with as many rad/s². Near a
    singularity the joints stop together instead: a stop never fails.

    Args:
        arm: A UR arm.
        tcp: (6,) tool in the flange frame.
        deceleration: [m/s²].
        tick_s: Device time of a tick.
    """

    def __init__(
        self, arm: ArmDescription, tcp: Numbers, deceleration: float, tick_s: float
    ) -> None:
        self._follower = ToolFollower(arm, tcp, tick_s)
        self._a, self._tick_s = deceleration, tick_s
        self._joints = StopJoints(JOINTS_INSTEAD_RAD_S2, tick_s)
        self._straight = True
        self._most = 0.0

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        """See `Motion`; the speed slider does not delay a stop."""
        if self._straight:
            try:
                return self._on_the_line(now)
            except MotionImpossible:
                self._straight = False
        return self._joints.advance(now, scale)

    def _on_the_line(self, now: Setpoint) -> Setpoint | None:
        """One tick; the joints must not get faster than they were when the stop began."""
        fastest = float(np.abs(now[1]).max())
        if fastest == 0.0:
            return None
        self._most = self._most or fastest
        twist = np.array(self._follower.twist(now))
        speed = float(max(np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])))
        left = 1.0 - self._a * self._tick_s / speed if speed > 0.0 else 0.0
        if not left > 0.0:
            v = np.zeros(6)
            return np.array((now[0] + 0.5 * self._tick_s * now[1], v, -now[1] / self._tick_s))
        after = self._follower.drift(now, left * twist)
        if np.abs(after[1]).max() > self._most:
            raise MotionImpossible("the joints would get faster while the tool stops")
        return after
