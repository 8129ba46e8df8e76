"""Times counted in bins: percentiles of any number of them, at the cost of one increment each."""

from __future__ import annotations

from array import array


class Histogram:
    """Times from 0 on, to the microsecond.

    Args:
        most_s: Longer ones count as so long; `longest_s` has them [s].

    Attributes:
        longest_s: The longest one [s].
    """

    def __init__(self, most_s: float = 0.05) -> None:
        self._last = int(most_s * 1e6)
        self._bins = array("Q", bytes(8 * (self._last + 1)))
        self.longest_s = 0.0

    def add(self, time_s: float) -> None:
        """Count one."""
        at = int(time_s * 1e6)
        self._bins[0 if at < 0 else at if at < self._last else self._last] += 1
        if time_s > self.longest_s:
            self.longest_s = time_s

    def __len__(self) -> int:
        return sum(self._bins)

    def percentile(self, percent: float) -> float:
        """So many percent of the times are no longer [s]; 0 when there are none."""
        left = max(len(self) * percent / 100.0, 1e-9)
        for at, count in enumerate(self._bins):
            left -= count
            if left <= 0:
                return at * 1e-6
        return 0.0
