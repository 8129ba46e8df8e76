"""The interlocks on distances: clearance and workspace, from measured joint positions."""

from __future__ import annotations

import numpy as np

from hil.engine.interlocks.context import Distances
from hil.engine.interlocks.interlock import Action, Trip
from hil.robot import Status
from hil.typing import BoolArray, FloatArray, IntArray, StructArray

CLEAR_BY_M = 0.005
"""Distances so much above the least are well inside again [m]."""


class LeastDistance:
    """Trips when any of several distances falls below a least one.

    Every sample is judged, few are computed. A joint that turns by Δq moves no point by more than
    its distance from the joint's axis times |Δq|, so between two positions a distance changes by
    at most Σ |Δq_j| · reach_j, whichever way the arm took. What the last position computed had to
    spare beyond that is proven to be left.

    Args:
        name: Shown when it trips.
        measured: Gives the distances.
        least_m: Least distance [m].
        action: What a trip does.
        shown: What is watched, for people; by default the least distance.

    Attributes:
        computed: Samples whose distances were computed so far.
    """

    def __init__(
        self,
        name: str,
        measured: Distances,
        least_m: float,
        *,
        action: Action = "stop",
        shown: str = "",
    ) -> None:
        self.name = name
        self.action = action
        self.watches = shown or f"{1e3 * least_m:.4g} mm"
        self.computed = 0
        self._measured = measured
        self._least = least_m
        self._reach = measured.reach
        self._farthest = self._reach.max(axis=0, initial=0.0)
        # Nothing was computed yet: nothing is proven anywhere.
        self._at = np.zeros(self._reach.shape[1])
        self._spare = np.full(len(self._reach), -np.inf)
        self._least_spare = -np.inf

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        turned = np.abs(block["q"] - self._at)
        # The farthest reach stands for all: cheaper, and enough for most samples. NaN is not less.
        if (turned @ self._farthest).max() < self._least_spare:
            return None
        with np.errstate(invalid="ignore"):
            proven = (turned @ self._reach.T < self._spare).all(axis=1)
        return None if proven.all() else self._look(block, np.logical_not(proven))

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        q = block["q"]
        known = bool(np.isfinite(q).all())
        return known and bool((self._measured.distances(q) >= self._least + CLEAR_BY_M).all())

    def _look(self, block: StructArray, doubtful: BoolArray) -> Trip | None:
        """Compute the rows in doubt; the newest of them proves what follows."""
        q = block["q"]
        known = np.isfinite(q).all(axis=1)
        unseen = np.flatnonzero(~known & ((block["status"] & Status.MOVING) != 0))
        rows = np.flatnonzero(doubtful & known)
        distances = self._measured.distances(q[rows])
        self.computed += len(rows)
        if len(rows):
            self._at, self._spare = q[rows[-1]].copy(), distances[:, -1] - self._least
            self._least_spare = float(self._spare.min(initial=np.inf))
        return self._first(block, rows, distances, unseen)

    def _first(
        self, block: StructArray, rows: IntArray, distances: FloatArray, unseen: IntArray
    ) -> Trip | None:
        close = np.flatnonzero(distances.min(axis=0, initial=np.inf) < self._least)
        first = rows[close[0]] if len(close) else len(block)
        if len(unseen) and unseen[0] < first:
            joint = int(np.argmin(np.isfinite(block["q"][unseen[0]])))
            return self._trip(block, int(unseen[0]), float("nan"), joint=joint)
        if not len(close):
            return None
        pair = int(distances[:, close[0]].argmin())
        subject = " and ".join(self._measured.names[pair])
        return self._trip(block, int(first), float(distances[pair, close[0]]), subject=subject)

    def _trip(
        self, block: StructArray, row: int, value: float, *, joint: int = -1, subject: str = ""
    ) -> Trip:
        time = float(block["device_time"][row])
        return Trip(
            self.name, joint, 1e3 * value, 1e3 * self._least, "mm", time, subject, least=True
        )
