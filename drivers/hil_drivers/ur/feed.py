"""Which set-point is due at which tick of the robot: pure arithmetic, no clock of our own."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray

JUMP_S = 0.04
"""Lateness that is made up for at once: `servoj` smooths over more than that [s]."""

CATCH_UP = 1.25
"""Set-points per tick at most where we are later than that: gently, not by a jump."""

TINY = 1e-6
"""Of a set-point: what time stamps lose by rounding."""


class Feed:
    """The set-points of one segment, paced by the robot's own time stamps.

    Ticks that were missed let the arm stand still on its last set-point. After a few it is where
    it ought to be with the next one; after more it goes on from where it stands, at most a quarter
    faster than planned, also where only every few ticks are answered. A robot that lives ten times
    as fast, or a host that is late, thus gets the same path.

    Args:
        q: (N, n) set-points [rad].
        rate_hz: Set-points per second of device time.
        begun: Device time at which the first one is commanded [s].

    Attributes:
        place: Index, also between two set-points, of what was commanded last.
        late_s: How far `place` is behind the schedule [s].
    """

    def __init__(self, q: FloatArray, rate_hz: float, begun: float) -> None:
        self._q = q
        self._rate_hz = rate_hz
        self._last_tick = begun
        self._begun = begun
        self.place = 0.0
        self.late_s = 0.0

    @property
    def over(self) -> bool:
        """Whether the last set-point was commanded."""
        return self.place >= len(self._q) - 1 - TINY

    def due(self, device_time: float) -> FloatArray:
        """(n,) what to command now that the robot says which time it is [rad]."""
        schedule = min((device_time - self._begun) * self._rate_hz, len(self._q) - 1.0)
        behind = max(schedule - self.place, 0.0)
        ticks = (device_time - self._last_tick) * self._rate_hz
        self._last_tick = device_time
        few = JUMP_S * self._rate_hz
        gently = CATCH_UP * (ticks if ticks <= few else 1.0)
        self.place += behind if behind <= few else min(behind, gently)
        self.late_s = (schedule - self.place) / self._rate_hz
        before = min(int(self.place), len(self._q) - 1)
        after = min(before + 1, len(self._q) - 1)
        part = self.place - before
        return np.asarray(self._q[before] * (1.0 - part) + self._q[after] * part)
