"""Pieces of a path over motion time: straight `Line`s with trapezoidal speed, and `Parabola`s.

The coordinates of a piece are joint angles, or a tool position with the rotation vector relative to
a frame. A parabola connects two lines with constant acceleration and forms a blended corner.
`Trapezoid` is the speed profile along a line: acceleration, cruise, deceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Protocol

import numpy as np

from hil.core import FloatArray

Moment = tuple[FloatArray, FloatArray, FloatArray]
"""Coordinates (6,), and their first and second derivative by motion time."""


class Piece(Protocol):
    """Part of a path, defined for the motion time from 0 to `duration`.

    Attributes:
        leg: Index of the move that contains the piece.
        duration: Duration of the piece [s].
        anchor: Rotation vector of the frame in which rotations are defined, (3,); unused for
            joints.
    """

    leg: int
    duration: float
    anchor: FloatArray

    def at(self, t: float) -> Moment:
        """Return coordinates and derivatives at a motion time."""

    def effort(self, t: float, pace: float, change: float) -> float:
        """Return the acceleration as a share of its limit; at most 1 while the pace is 1.

        Args:
            t: Motion time [s].
            pace: Motion time per device time, 0 to 1.
            change: Rate of change of the pace [1/s].
        """


Size = Callable[[FloatArray], float]
"""Function that returns the size of a change of the six coordinates, in units of path length."""


class Line:
    """Straight piece from `start` along `direction` with a trapezoidal speed profile.

    Args:
        leg: Index of the move.
        start: Coordinates at the start, (6,).
        direction: Change of the coordinates per unit of path length, (6,).
        profile: Profile of path length, speed and acceleration over time.
        anchor: Rotation vector of the reference frame, (3,); see `Piece`.
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
        """Return coordinates and their derivatives at a motion time; see `Piece`."""
        way, speed, acceleration = self._profile.at(t)
        d = self._direction
        return self._start + way * d, speed * d, acceleration * d

    def effort(self, t: float, pace: float, change: float) -> float:
        """Return the acceleration as a share of its limit; see `Piece`."""
        _, speed, acceleration = self._profile.at(t)
        return abs(acceleration * pace * pace + speed * change) / self._profile.acceleration


class Parabola:
    """Piece from one line to the next with constant acceleration.

    Args:
        leg: Index of the move that begins with the parabola.
        start: Coordinates at the start, (6,).
        entry, end: Velocities at the start and at the end, (6,).
        duration: Duration of the piece [s].
        limit: Acceleration limit, in the unit of `size`.
        size: Size of the acceleration of the piece.
        speed: Largest size of the velocity in the piece.
        anchor: Rotation vector of the reference frame, (3,); see `Piece`.
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
        """Return coordinates and their derivatives at a motion time; see `Piece`."""
        v = self._entry + t * self._acceleration
        return self._start + 0.5 * t * (self._entry + v), v, self._acceleration

    def effort(self, t: float, pace: float, change: float) -> float:
        """Return an upper bound of the acceleration share: two terms are added as if parallel."""
        return (self._size * pace * pace + self._speed * abs(change)) / self._limit


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """Speed profile along a line: acceleration `a`, cruise, deceleration `a`.

    Attributes:
        length: Path length, in the unit of the path.
        entry, peak, leaving: Speed at the start, during cruise and at the end.
        acceleration: Magnitude of acceleration and deceleration.
        rising, cruising, falling: Duration of the three phases [s].
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
        """Return path length, speed and acceleration at a time from 0 to `duration` [s]."""
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
    """Return the fastest speed profile with speed at most `v` and acceleration at most `a`.

    Args:
        length: Path length, ≥ 0.
        v: Maximum speed, > 0.
        a: Maximum acceleration, > 0.
        entry: Speed at the start, at most `v`.
        end: Speed at the end, at most `v`; must be reachable with `a`.
    """
    highest = sqrt(max(0.0, a * length + 0.5 * (entry**2 + end**2)))
    peak = max(min(v, highest), entry, end)
    rising, falling = (peak - entry) / a, (peak - end) / a
    ramps = 0.5 * (rising * (entry + peak) + falling * (peak + end))
    cruising = max(0.0, length - ramps) / peak if peak > 0.0 else 0.0
    return Trapezoid(length, entry, peak, end, a, rising, cruising, falling)


PEAK_OF_MEAN, RAMP_SHARE = 1.5, 1 / 3
"""Profile of a motion with given duration: equal thirds for acceleration, cruise and
deceleration.
"""


def pace_for_duration(length: float, duration_s: float) -> tuple[float, float]:
    """Return speed and acceleration of a motion from rest to rest with given duration [s]."""
    v = PEAK_OF_MEAN * length / duration_s
    return v, v / (RAMP_SHARE * duration_s)


def joint_size(change: FloatArray) -> float:
    """Return the change of the joint that moves most [rad]."""
    return float(np.abs(change).max())


TURN_RAD_M = 4.0
"""Ratio of rotation to translation of a tool: rad/s and rad/s² are four times m/s and m/s².

Source: The source of this ratio is the Universal Robots forum, thread 15912, "movel tool
angular speed".
"""


def tool_size(change: FloatArray) -> float:
    """Return the larger of the path length of the tool [m] and a quarter of its rotation [rad]."""
    x, y, z, rx, ry, rz = change.tolist()
    turn = rx * rx + ry * ry + rz * rz
    return sqrt(max(x * x + y * y + z * z, turn / TURN_RAD_M**2))
