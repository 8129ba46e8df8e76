"""Which sample belongs to which segment, and whether it moves: by device time, not by arrival."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hil.core import StructArray
from hil.robot import Status

STILL_RAD_S = 1e-3
"""A commanded speed below this is none [rad/s]; the controller's own ramps end at 0."""


class Standing:
    """Knows what the arm was told to do when.

    Segments follow each other: one ends where the next begins. A motion that nobody has seen end
    yet is still going on.
    """

    def __init__(self) -> None:
        # When it began, its index, when its motion was over (inf: not yet).
        self._known: list[tuple[float, int, float]] = [(-np.inf, -1, -np.inf)]

    @property
    def moving(self) -> bool:
        """Whether the newest segment's motion has not been seen to end."""
        return self._known[-1][2] == np.inf

    @property
    def segment(self) -> int:
        """Index of the newest segment."""
        return self._known[-1][1]

    def begin(self, index: int, at: float, *, moves: bool) -> None:
        """A segment begins with the first sample after a device time [s]."""
        self.end(at)
        self._known.append((at, index, np.inf if moves else at))

    def end(self, at: float) -> None:
        """The newest motion was over by that device time; nothing happens when none was on."""
        begun, index, _ = self._known[-1]
        if self.moving:
            self._known[-1] = (begun, index, max(at, begun))

    def stamp(self, rows: StructArray) -> None:
        """Fill `segment` and the bits `MOVING` or `HOLDING` of `status`, in place."""
        times = rows["device_time"]
        moving = np.zeros(len(rows), dtype=bool)
        for begun, index, over in self._known:
            mine = times > begun
            rows["segment"][mine] = index
            moving = np.where(mine, times <= over, moving)
        rows["status"] |= np.where(moving, Status.MOVING, Status.HOLDING).astype("<i4")
        while len(self._known) > 1 and self._known[1][0] < times[0]:
            self._known.pop(0)


def still(rows: StructArray, speed: Callable[[StructArray], np.ndarray]) -> float | None:
    """Device time of the first row with no commanded speed, None when there is none."""
    at = np.flatnonzero(speed(rows) < STILL_RAD_S)
    return float(rows["device_time"][at[0]]) if len(at) else None
