"""When a stopped arm is truly at rest: judged by its true speed, not by what it reports."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.journal import Journal, Moment

REST_RAD_S = 0.01
"""An arm whose joints are all slower than this, and stay so, is at rest."""

SURE_AFTER_S = 0.1
"""Device time without a faster joint after which an arm counts as staying at rest."""


class RestWatch:
    """Follows the arm from the first command to stop to the first moment it stays at rest.

    Args:
        journal: Told when that was, once after each motion.

    Attributes:
        resting: Whether it is known to be at rest.
    """

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._cause = ""
        self._stopped = Moment(0.0, 0.0, 0.0)
        self._candidate: Moment | None = None
        self.resting = True
        self._told = False

    @property
    def waiting(self) -> bool:
        """Whether the arm was stopped and is not known to be at rest."""
        return bool(self._cause)

    def stopped(self, cause: str, at: Moment) -> None:
        """Begin; later causes of the same stop change nothing."""
        if not self._cause and not self._told:
            self._cause, self._stopped, self._candidate = cause, at, None

    def moved(self) -> None:
        """A motion begins: whatever came before, the arm is not at rest."""
        self._cause, self.resting, self._told = "", False, False

    def see(
        self, device_time: FloatArray, qd: FloatArray, until_s: float, spacing_s: float
    ) -> None:
        """Look at samples, as long as somebody stopped the arm.

        Args:
            device_time: (N,) of each sample [s].
            qd: (N, n) true joint speeds [rad/s].
            until_s: Monotonic time of the last sample.
            spacing_s: Wall time between samples.
        """
        if not self._cause or not len(qd):
            return
        fastest = np.abs(qd).max(axis=1)
        # NaN is no rest, and compares false.
        fast = np.flatnonzero(~(fastest < REST_RAD_S))
        first = int(fast[-1]) + 1 if len(fast) else 0
        if len(fast):
            self._candidate = None
        if self._candidate is None and first < len(qd):
            monotonic = until_s - (len(qd) - 1 - first) * spacing_s
            self._candidate = Moment(monotonic, float(device_time[first]), float(fastest[first]))
        found = self._candidate
        if found is not None and device_time[-1] - found.device_time >= SURE_AFTER_S:
            self._tell(found)

    def locked(self, cause: str, at: Moment) -> None:
        """The mechanical brakes hold the arm from this moment on."""
        self.stopped(cause, at)
        if self._cause:
            self._tell(at)

    def finish(self) -> None:
        """The robot is closed: what looked like rest counts as rest."""
        if self._cause and self._candidate is not None:
            self._tell(self._candidate)

    def _tell(self, found: Moment) -> None:
        self._journal.note(
            "rest",
            found,
            after=self._cause,
            device_s=round(found.device_time - self._stopped.device_time, 6),
            wall_s=round(max(0.0, found.monotonic_s - self._stopped.monotonic_s), 6),
        )
        self._cause, self.resting, self._told = "", True, True
