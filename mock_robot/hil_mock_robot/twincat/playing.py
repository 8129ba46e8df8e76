"""What the PLC commands: a hold, the rows of a trajectory, a ramp to rest. All in closed form."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hil.core import FloatArray


class Course(Protocol):
    """Set-points of the cycles to come."""

    def next(self, count: int) -> FloatArray:
        """(N, 3, n) of the next cycles, N ≤ count; fewer when it ends."""


class Trajectory:
    """Rows of the array, one per cycle.

    Args:
        rows: (N, 3, n) positions [rad], velocities and accelerations.
    """

    def __init__(self, rows: FloatArray) -> None:
        self._rows, self._at = rows, 0

    def next(self, count: int) -> FloatArray:
        """See `Course`."""
        rows = self._rows[self._at : self._at + count]
        self._at += len(rows)
        return rows


class Ramp:
    """Every joint comes to rest in the same time, the fastest with a given deceleration.

    Args:
        setpoint: (3, n) from where.
        deceleration: Of the fastest joint [rad/s²].
        cycle_s: Time between two set-points [s].
    """

    def __init__(self, setpoint: FloatArray, deceleration: float, cycle_s: float) -> None:
        self._q, self._v = setpoint[0].copy(), setpoint[1].copy()
        self._takes_s = float(np.abs(self._v).max()) / deceleration
        self._cycle_s, self._done = cycle_s, 0
        self._cycles = int(np.ceil(self._takes_s / cycle_s - 1e-9))

    def next(self, count: int) -> FloatArray:
        """See `Course`; the last set-point rests."""
        last = min(self._done + count, self._cycles)
        t = np.arange(self._done + 1, last + 1)[:, None] * self._cycle_s
        self._done = last
        t = np.minimum(t, self._takes_s)
        left = 1.0 - t / self._takes_s if self._takes_s else np.zeros_like(t)
        q = self._q + self._v * (t - t**2 / 2 / max(self._takes_s, 1e-12))
        slowing = np.where(left > 0, -self._v / max(self._takes_s, 1e-12), 0.0)
        return np.stack((q, self._v * left, slowing), axis=1)


class Hold:
    """One position for ever.

    Args:
        q: (n,) [rad].
    """

    def __init__(self, q: FloatArray) -> None:
        self._row = np.zeros((3, len(q)))
        self._row[0] = q

    def next(self, count: int) -> FloatArray:
        """See `Course`."""
        return np.repeat(self._row[None], count, axis=0)
