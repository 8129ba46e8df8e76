"""Does the arm follow what it is led along?"""

from __future__ import annotations

from collections import deque

import numpy as np

from hil.core import FloatArray


class LagWatch:
    """Compares where the controller wants the arm with what it was told lately.

    `servoj` smooths and follows late, so a plain difference grows with speed. What has to hold at
    any speed: every joint's target lies between the least and the most it was told within the
    last `lag_s`, give or take `lag_rad`.

    Args:
        lag_s: How late the target may be [s of device time].
        lag_rad: How far beside the told range it may be [rad].
    """

    def __init__(self, lag_s: float, lag_rad: float) -> None:
        self._lag_s, self._lag_rad = lag_s, lag_rad
        self._told: deque[tuple[float, FloatArray]] = deque()

    def tell(self, device_time: float, q: FloatArray) -> None:
        """Note a set-point (n,) that was commanded."""
        self._told.append((device_time, q))
        # One older than the window stays: it is what was held when the window began.
        while len(self._told) > 1 and self._told[1][0] < device_time - self._lag_s:
            self._told.popleft()

    def off(self, target: FloatArray) -> FloatArray:
        """(n,) how far the controller's target is outside the range it was told [rad]."""
        told = np.array([q for _, q in self._told])
        if not len(told):
            return np.zeros_like(target)
        under, over = told.min(axis=0) - target, target - told.max(axis=0)
        return np.asarray(np.maximum(np.maximum(under, over), 0.0))

    def lost(self, target: FloatArray) -> bool:
        """Whether the arm does not follow."""
        return bool(self.off(target).max() > self._lag_rad)
