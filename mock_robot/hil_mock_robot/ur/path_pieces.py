"""Pieces of a path over motion time: straight `Line`s with trapezoidal speed, and `Parabola`s.

A piece's coordinates are joint angles, or a tool position and the turn of a frame. A parabola
leads from one line to the next with constant acceleration, which is a blended corner. `Trapezoid`
is the speed along a line: up with constant acceleration, cruise, down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Protocol

import numpy as np

from hil.core import FloatArray

Moment = tuple[FloatArray, FloatArray, FloatArray]
"""Coordinates (6,), their first and second derivative by motion time."""


class Piece(Protocol):
    """Part of a path, from its own time 0 to `duration`.

    Attributes:
        leg: Index of the move it belongs to.
        duration: [s].
        anchor: (3,) rotation vector of the frame that the coordinates turn; unused by joints.
    """

    leg: int
    duration: float
    anchor: FloatArray

    def at(self, t: float) -> Moment:
        """Where it is at a time."""

    def effort(self, t: float, pace: float, change: float) -> float:
        """Return acceleration as a share of the allowed one; at most 1 as long as the pace is 1.

        Args:
            t: Motion time [s].
            pace: Motion time per time, 0 to 1.
            change: Of the pace [1/s].
        """


Size = Callable[[FloatArray], float]
"""Size of a change of the six coordinates, in the unit of the way."""


class Line:
    """From `start` along `direction`, by a trapezoid.

    Args:
        leg: Index of the move.
        start: (6,).
        direction: (6,) change of the coordinates per unit of way.
        profile: Way by time.
        anchor: (3,) see `Piece`.
    """

    def __init__(
        self,
        leg: int,
        start: FloatArray,
        direction: FloatArray,
        profile: Trapezoid,
        anchor: FloatArray,
    ) -> None:
        self.leg, self.anchor, self.duration = leg, anchor, profile.duration
        self._start, self._direction, self._profile = start, direction, profile

    def at(self, t: float) -> Moment:
        """See `Piece`."""
        way, speed, acceleration = self._profile.at(t)
        d = self._direction
        return self._start + way * d, speed * d, acceleration * d

    def effort(self, t: float, pace: float, change: float) -> float:
        """See `Piece`."""
        _, speed, acceleration = self._profile.at(t)
        return abs(acceleration * pace * pace + speed * change) / self._profile.acceleration


class Parabola:
    """From one line to the next with constant acceleration.

    Args:
        leg: Index of the move that it begins.
        start: (6,).
        entry, end: (6,) velocities at its two ends.
        duration: [s].
        limit: Largest size of the acceleration, in the unit of `spare`.
        size: Size of the acceleration.
        speed: Largest size of the velocity.
        anchor: (3,) see `Piece`.
    """

    def __init__(
        self,
        leg: int,
        start: FloatArray,
        entry: FloatArray,
        end: FloatArray,
        duration: float,
        limit: float,
        size: float,
        speed: float,
        anchor: FloatArray,
    ) -> None:
        self.leg, self.anchor, self.duration = leg, anchor, duration
        self._start, self._entry = start, entry
        self._acceleration = (end - entry) / duration
        self._limit, self._size, self._speed = limit, size, speed

    def at(self, t: float) -> Moment:
        """See `Piece`."""
        v = self._entry + t * self._acceleration
        return self._start + 0.5 * t * (self._entry + v), v, self._acceleration

    def effort(self, t: float, pace: float, change: float) -> float:
        """See `Piece`; as if both parts pointed in one direction."""
        return (self._size * pace * pace + self._speed * abs(change)) / self._limit


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
        """Duration of the piece [s]."""
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


PEAK_OF_MEAN, RAMP_SHARE = 1.5, 1 / 3
"""Of a motion of given duration: a third of it speeds up, a third cruises, a third slows down."""


def pace_for_duration(length: float, duration_s: float) -> tuple[float, float]:
    """Speed and acceleration with which a way from rest to rest takes so long [s]."""
    v = PEAK_OF_MEAN * length / duration_s
    return v, v / (RAMP_SHARE * duration_s)


def joint_size(change: FloatArray) -> float:
    """Of the leading axis [rad]."""
    return float(np.abs(change).max())


TURN_RAD_M = 4.0
"""A tool turns with four times as many rad/s and rad/s² as it moves with m/s and m/s².

Source: Universal Robots forum, thread 15912, "movel tool angular speed".
"""


def tool_size(change: FloatArray) -> float:
    """Way of the tool [m], or a quarter of its turn [rad] where that is more."""
    x, y, z, rx, ry, rz = change.tolist()
    turn = rx * rx + ry * ry + rz * rz
    return sqrt(max(x * x + y * y + z * z, turn / TURN_RAD_M**2))
