"""What the tool touches: pushes on the arm, seen as a force at the tool centre point."""

from __future__ import annotations

from collections import deque

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.ur.kinematics import jacobian
from hil_mock_robot.ur.machine import Machine

SINCE = (None, (5, 4))
"""Software that can tell contacts and the joints' past."""
LEAST_FORCE_N = 10.0
REMEMBERED_S = 2.0


class Touch:
    """Looks once a tick; on software that cannot tell contacts it sees nothing.

    Attributes:
        force: (3,) on the tool in the base frame, None when nothing pushes [N].
        ticks: Since when something pushes.
    """

    def __init__(self) -> None:
        self.force: FloatArray | None = None
        self.ticks = 0
        self._past: deque[FloatArray] = deque()

    def look(self, machine: Machine) -> None:
        """Note where the joints are, and what pushes."""
        if not machine.series.at_least(*SINCE):
            return
        self._past.append(machine.reading.q)
        if len(self._past) > REMEMBERED_S / machine.tick_s:
            self._past.popleft()
        self.force = _force_of(machine)
        self.ticks = self.ticks + 1 if self.force is not None else 0

    def along(self, direction: FloatArray) -> int:
        """Ticks since the tool met something on its way, 0 when it has not.

        Args:
            direction: (6,) of the way, of which the translation counts; zero for any.
        """
        if self.force is None or (direction[:3].any() and direction[:3] @ self.force >= 0):
            return 0
        return min(self.ticks, len(self._past) - 1)

    def past(self, ticks: int) -> FloatArray | None:
        """(6,) joint angles so many ticks ago [rad]; None when that is too long ago."""
        if not 0 <= ticks < len(self._past):
            return None
        return self._past[-1 - ticks]


def _force_of(machine: Machine) -> FloatArray | None:
    push = machine.body.pushed
    if not push.any():
        return None
    columns = np.asarray(jacobian(machine.body.arm, machine.reading.q, machine.tcp))
    wrench, *_ = np.linalg.lstsq(columns.T, push, rcond=1e-3)
    force = np.asarray(wrench[:3], dtype=np.float64)
    return force if np.linalg.norm(force) >= LEAST_FORCE_N else None
