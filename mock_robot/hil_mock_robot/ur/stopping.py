"""Coming to rest from any motion: along the present direction, all joints together."""

from __future__ import annotations

import numpy as np

from hil_mock_robot.ur.contracts import Setpoint


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
