"""Which rows are shown: as many as a screen can take, whatever the clock of the robot does."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from hil.core import FloatArray, StructArray
from hil.recording import MAX_RATE_HZ

AT_ONCE = 12
"""Rows shown of one block at most, so that a burst is no flood."""


class Decimation:
    """Lets at most `rate_hz` rows a second of *wall* time through, spread over what came in.

    A mock on a virtual clock delivers hundreds of blocks a second: most are turned away by one
    comparison.

    Args:
        rate_hz: Rows a second of wall time [Hz].
        clock: Monotonic wall clock [s].
    """

    def __init__(
        self, rate_hz: float = MAX_RATE_HZ, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate_hz = rate_hz
        self._clock = clock
        self._last = clock()
        self._allowed = 1.0

    def due(self) -> int:
        """How many rows may be shown now."""
        return min(AT_ONCE, int(self._allowed + (self._clock() - self._last) * self._rate_hz))

    def select(self, rows: StructArray) -> tuple[StructArray, FloatArray]:
        """The rows to show, evenly spread and with the newest, and how old each is.

        Returns:
            Rows, and their age in wall time [s], shape (len(rows),): the time since the newest
            row by the device clock, shrunk where that runs faster than the wall.
        """
        n = min(self.due(), len(rows))
        if not n:
            return rows[:0], np.empty(0)
        every = -(-len(rows) // n)
        chosen = rows[(len(rows) - 1) % every :: every]
        elapsed = self._spend(len(chosen))
        age = chosen["device_time"][-1] - chosen["device_time"]
        # The oldest comes after the newest of the last time: no viewer's time runs backwards.
        longest = elapsed * (1 - 1 / len(chosen))
        return chosen, age * min(1.0, longest / max(float(age[0]), 1e-9))

    def _spend(self, n: int) -> float:
        """Book `n` rows; returns the time since the last ones [s]."""
        now = self._clock()
        elapsed, self._last = now - self._last, now
        self._allowed = min(AT_ONCE, self._allowed + elapsed * self._rate_hz) - n
        return elapsed
