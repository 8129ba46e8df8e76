"""A joint's way as pieces without reversal, on which Dahl's state has a closed form.

Within a piece travelled in direction s the state is z = s + (z₀ − s)·exp(−way/x₀), whatever the
steps. So it takes one exponential per sample and a loop over reversals only, which matters where
the length x₀ is searched for; `hil.estimators.friction.memory` goes sample by sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """A way of N steps in G pieces.

    Attributes:
        direction: (G,) +1, −1, or 0 for a series without any motion.
        length: (G,) of each piece [rad].
        fresh: (G,) true where a series begins, whose state is 0.
        number: (N,) the piece of every step.
        way: (N,) travelled since the piece began, the step included [rad].
    """

    direction: FloatArray
    length: FloatArray
    fresh: BoolArray
    number: IntArray
    way: FloatArray

    @classmethod
    def of(cls, steps: FloatArray, series: tuple[slice, ...]) -> Pieces:
        """Those of the steps (N,) [rad] of all series."""
        starts = np.zeros(len(steps), dtype=bool)
        starts[[rows.start for rows in series]] = True
        direction = _held(np.sign(steps), starts)
        begins = starts.copy()
        begins[1:] |= direction[1:] != direction[:-1]
        first = np.flatnonzero(begins)
        number = np.cumsum(begins) - 1
        travelled = np.cumsum(np.abs(steps))
        way = travelled - (travelled[first] - np.abs(steps[first]))[number]
        last = np.append(first[1:], len(steps)) - 1
        return cls(direction[first], way[last], starts[first], number, way)

    def every(self, k: int) -> Pieces:
        """The same way, told after every k-th step only."""
        return replace(self, number=self.number[::k].copy(), way=self.way[::k].copy())

    def state(self, length: float) -> tuple[FloatArray, FloatArray]:
        """Dahl's state (N,) after every step and its derivative by log(length)."""
        begin, slope = self._beginnings(length)
        gap = begin - self.direction
        share = self.way / length
        kept = np.exp(-share)
        state = self.direction[self.number] + gap[self.number] * kept
        return state, (slope[self.number] + gap[self.number] * share) * kept

    def _beginnings(self, length: float) -> tuple[FloatArray, FloatArray]:
        """(G,) state at the beginning of every piece, and its derivative."""
        share = self.length / length
        kept = np.exp(-share)
        begin, slope = np.zeros(len(kept)), np.zeros(len(kept))
        z = dz = 0.0
        rows = zip(self.fresh.tolist(), self.direction.tolist(), share.tolist(), kept.tolist(),
                   strict=True)  # fmt: skip
        for g, (fresh, s, x, a) in enumerate(rows):
            if fresh:
                z = dz = 0.0
            begin[g], slope[g] = z, dz
            z, dz = s + (z - s) * a, (dz + (z - s) * x) * a
        return begin, slope


def _held(sign: FloatArray, starts: BoolArray) -> FloatArray:
    """Signs (N,) with 0 replaced by what was before it in the series, if anything was."""
    known = np.where((sign != 0) | starts, np.arange(len(sign)), 0)
    return np.asarray(sign[np.maximum.accumulate(known)])
