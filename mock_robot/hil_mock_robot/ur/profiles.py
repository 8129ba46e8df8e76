"""How far along a straight piece of path a motion is at what time, and how fast."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

PEAK_OF_MEAN, RAMP_SHARE = 1.5, 1 / 3
"""Of a motion of given duration: a third of it speeds up, a third cruises, a third slows down."""


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """Speed up with `a`, cruise, slow down with `a`.

    Attributes:
        length: Of the way, in the unit of the path.
        entry, peak, leaving: Speed at the beginning, on the way and at the end.
        acceleration: Both ways.
        rising, cruising, falling: How long each part lasts [s].
    """

    length: float
    entry: float
    peak: float
    leaving: float
    acceleration: float
    rising: float
    cruising: float
    falling: float

    @property
    def duration(self) -> float:
        """[s]."""
        return self.rising + self.cruising + self.falling

    def at(self, t: float) -> tuple[float, float, float]:
        """Way, speed and acceleration at a time from 0 to `duration` [s]."""
        if t < self.rising:
            a = self.acceleration
            return t * (self.entry + 0.5 * a * t), self.entry + a * t, a
        left = self.duration - t
        if left > self.falling:
            way = 0.5 * (self.entry + self.peak) * self.rising + self.peak * (t - self.rising)
            return way, self.peak, 0.0
        if left <= 0.0:
            return self.length, self.leaving, 0.0
        a = self.acceleration
        return self.length - left * (self.leaving + 0.5 * a * left), self.leaving + a * left, -a


def trapezoid(length: float, v: float, a: float, entry: float = 0.0, end: float = 0.0) -> Trapezoid:
    """The fastest way with a speed of at most `v` and an acceleration of at most `a`.

    Args:
        length: ≥ 0.
        v: > 0.
        a: > 0.
        entry: Speed at the beginning, at most `v`.
        end: Speed at the end, at most `v`; `a` suffices to get there.
    """
    highest = sqrt(max(0.0, a * length + 0.5 * (entry**2 + end**2)))
    peak = max(min(v, highest), entry, end)
    rising, falling = (peak - entry) / a, (peak - end) / a
    ramps = 0.5 * (rising * (entry + peak) + falling * (peak + end))
    cruising = max(0.0, length - ramps) / peak if peak > 0.0 else 0.0
    return Trapezoid(length, entry, peak, end, a, rising, cruising, falling)


def timed(length: float, duration_s: float) -> tuple[float, float]:
    """Speed and acceleration with which a way from rest to rest takes so long [s]."""
    v = PEAK_OF_MEAN * length / duration_s
    return v, v / (RAMP_SHARE * duration_s)
