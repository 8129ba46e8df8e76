"""The interlocks on distances: clearance and workspace, from measured joint positions."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, StructArray
from hil.engine.interlock_context import Distances
from hil.engine.interlock_moving import moving
from hil.engine.interlock_protocol import Action, Margin, Trip

CLEAR_BY_M = 0.005
"""Distances so much above the least are well inside again [m]."""

ROOMY_M = 0.1
"""With so much to spare a distance counts as not near its limit at all [m]."""


class LeastDistance:
    """Trips when any of several distances falls below a least one.

    Every sample is judged, few are computed. A joint that turns by Δq moves no point by more than
    its distance from the joint's axis times |Δq|, so between two positions a distance changes by
    at most Σ |Δq_j| · reach_j, whichever way the arm took. While that is less than what every
    distance had to spare at the last position computed, none needs computing.

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
        self._measured, self._looked = measured, measured.own()
        self._least = least_m
        self._before: StructArray | None = None
        self._n = measured.reach.shape[1]
        # Nothing was computed yet: nothing is proven anywhere.
        self._at, self._spent = np.zeros(self._n), np.full(self._n, np.nan)

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        trip = self._first(block)
        self._before = block
        return trip

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        q = block["q"]
        known = bool(np.isfinite(q).all())
        return known and bool((self._measured.distances(q) >= self._least + CLEAR_BY_M).all())

    def margin(self, block: StructArray) -> Margin | None:
        """See `HasMargin.margin`: that of the pair with the least distance."""
        q = block["q"][-1:]
        if not np.isfinite(q).all():
            return None
        distances = self._looked.distances(q)[:, 0]
        pair = int(distances.argmin())
        share = float(np.clip((distances[pair] - self._least) / ROOMY_M, 0.0, 1.0))
        subject = " and ".join(self._measured.names[pair])
        value, least = 1e3 * float(distances[pair]), 1e3 * self._least
        return Margin(value, least, "mm", share, subject=subject, least=True)

    def _first(self, block: StructArray) -> Trip | None:
        """The first violation."""
        q = block["q"]
        row = self._next_in_doubt(q, 0)
        while row < len(q):
            if trip := self._judged(block, row):
                return trip
            row = self._next_in_doubt(q, row + 1)
        return None

    def _next_in_doubt(self, q: FloatArray, begin: int) -> int:
        """The first row from `begin` that is not proven to be far enough; len(q) without one."""
        if begin == len(q):
            return begin
        spent = np.abs(q[begin:] - self._at) @ self._spent
        # NaN is not less.
        if spent.max() < 1.0:
            return len(q)
        return begin + int(np.logical_not(spent < 1.0).argmax())

    def _judged(self, block: StructArray, row: int) -> Trip | None:
        """The verdict on one row, computed; it then proves what lies around it."""
        q = block["q"][row]
        if not np.isfinite(q).all():
            joint = int(np.argmin(np.isfinite(q)))
            moves = moving(block, self._before)[row]
            return self._trip(block, row, float("nan"), joint=joint) if moves else None
        distances = self._measured.distances(q[None])[:, 0]
        self.computed += 1
        spare = distances - self._least
        if (spare > 0).all():
            # A joint spends of a pair's spare what it can reach; the pair it spends most of counts.
            self._at = q.copy()
            self._spent = (self._measured.reach / spare[:, None]).max(axis=0, initial=0.0)
            return None
        if (spare >= 0).all():
            return None
        pair = int(distances.argmin())
        subject = " and ".join(self._measured.names[pair])
        return self._trip(block, row, float(distances[pair]), subject=subject)

    def _trip(
        self, block: StructArray, row: int, value: float, *, joint: int = -1, subject: str = ""
    ) -> Trip:
        time = float(block["device_time"][row])
        return Trip(
            self.name, joint, 1e3 * value, 1e3 * self._least, "mm", time, subject, least=True
        )
