"""The mock PLC's journal: what it was told, what went wrong, when the arm was at rest."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.server.journal import Journal, Moment, RestWatch

STOPPING = ("stop", "watchdog", "fault", "release")


class Witness:
    """Writes down what the program tells.

    Args:
        journal: Where.
        cycle_s: Device time of a cycle [s].
    """

    def __init__(self, journal: Journal, cycle_s: float) -> None:
        self._journal, self._cycle_s = journal, cycle_s
        self._rest = RestWatch(journal)
        self._cycles = 0
        self._speed = 0.0

    def happened(self, event: str, details: dict[str, Any]) -> None:
        """The program tells something."""
        at = Moment(time.monotonic(), self._cycles * self._cycle_s, self._speed)
        if event == "start":
            self._rest.moved()
        self._journal.note(event, at, **details)
        if event in STOPPING:
            self._rest.stopped(event, at)

    def passed(self, speeds: FloatArray) -> None:
        """Cycles are over; true joint speeds (N, n) [rad/s]."""
        first, self._cycles = self._cycles, self._cycles + len(speeds)
        self._speed = float(np.abs(speeds[-1]).max()) if len(speeds) else 0.0
        if self._rest.waiting:
            times: FloatArray = np.arange(first, self._cycles, dtype=float) * self._cycle_s
            self._rest.see(times, speeds, time.monotonic(), 0.0)

    def close(self) -> None:
        """The last lines."""
        self._rest.finish()
        self._journal.note("closed", Moment(time.monotonic(), self._cycles * self._cycle_s, 0.0))
        self._journal.close()
