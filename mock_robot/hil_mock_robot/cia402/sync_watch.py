"""What an enabled drive in a cyclic mode makes of a SYNC that stays away."""

from __future__ import annotations

from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.stopping import AT_REST_RAD_S

SYNC_LOST_STEPS = 100
"""Device time without SYNC that a cyclic mode survives."""


class SyncWatch:
    """Counts the steps without SYNC, and sees whether the set-point leaves its path meanwhile."""

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.reset()

    def reset(self) -> None:
        """Forget what was."""
        self._unsynced, self._strayed = 0, False

    def look(self, steps: int, *, synced: bool, cyclic: bool) -> bool:
        """Whether it is an error: SYNC stays away too long, or is back after the set-point left.

        It would jump onto its path again; as it is, it comes to rest along a ramp.

        Args:
            steps: That begin now.
            synced: A SYNC begins them.
            cyclic: The axis is enabled in a mode that needs SYNC.
        """
        self._unsynced = 0 if synced else self._unsynced + steps
        error = cyclic and (self._strayed if synced else self._unsynced > SYNC_LOST_STEPS)
        if synced or not cyclic:
            self._strayed = False
        elif abs(self._axis.demand_qd) > AT_REST_RAD_S:
            self._strayed = self._strayed or self._unsynced > self._axis.period_steps
        return error
