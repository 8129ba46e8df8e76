"""The holding brake of one axis: it brings the joint to rest where it is, and keeps it there."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.cia402.contracts import STEP_S

DECELERATIONS = 2.0
"""How hard it brakes, in what the joint may accelerate with."""

AT_REST_RAD_S = 0.01
"""Slower than this it closes without a trace."""


class Brake:
    """Where the joint goes while it is closed.

    Args:
        qdd_max: What the joint may accelerate with [rad/s²].

    Attributes:
        closed: It is, from the start on.
    """

    def __init__(self, qdd_max: float) -> None:
        self._deceleration = DECELERATIONS * qdd_max
        self.closed = True
        self._q = self._qd = 0.0

    @property
    def rests(self) -> bool:
        """It is closed, and the joint has come to rest."""
        return self.closed and self._qd == 0.0

    def close(self, held: float, q: float, qd: float) -> None:
        """Take a joint at `q`, `qd`; one at rest is kept where its drive held it [rad], [rad/s]."""
        self.closed = True
        slow = abs(qd) < AT_REST_RAD_S
        self._q, self._qd = (held, 0.0) if slow else (q, qd)

    def path(self, steps: int) -> FloatArray:
        """(N, 3) of the joint during the next steps."""
        rows = np.zeros((steps, 3))
        if self._qd == 0.0:
            rows[:, 0] = self._q
            return rows
        for row in rows:
            before = self._qd
            least = max(0.0, abs(before) - self._deceleration * STEP_S)
            self._qd = least if before > 0.0 else -least
            self._q += 0.5 * (before + self._qd) * STEP_S
            row[:] = self._q, self._qd, (self._qd - before) / STEP_S
        return rows
