"""Pieces of path in six coordinates: straight lines and the parabolas that blend them.

The coordinates are joint angles [rad], or a tool position [m] and a rotation vector [rad] that
turns an anchor frame.
"""

from __future__ import annotations

from typing import Protocol

from hil.core import FloatArray
from hil_mock_robot.ur.profiles import Trapezoid

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
        """Acceleration there as a share of what is allowed; 1 at most as long as the pace is 1.

        Args:
            t: Motion time [s].
            pace: Motion time per time, 0 to 1.
            change: Of the pace [1/s].
        """


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
