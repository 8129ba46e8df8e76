"""Corners of a path: where a blend begins and ends, and how fast every corner is taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt

import numpy as np

from hil.core import FloatArray
from hil_mock_robot.ur.pieces import Line, Parabola, Piece
from hil_mock_robot.ur.profiles import trapezoid

Size = Callable[[FloatArray], float]
"""Size of a change of the six coordinates, in the unit of the way."""

BISECTIONS = 24
TURN_RAD_M = 4.0
"""A tool turns with four times as many rad/s and rad/s² as it moves with m/s and m/s².

Source: Universal Robots forum, thread 15912, "movel tool angular speed".
"""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """One straight move between two waypoints.

    Attributes:
        leg: Index of the move in its path.
        start: (6,) coordinates of the waypoint it begins at.
        direction: (6,) change of the coordinates per unit of way.
        length: Of the way.
        v, a: Highest speed and acceleration along it.
        anchor: (3,) rotation vector of the frame it begins at; its coordinates turn that frame.
    """

    leg: int
    start: FloatArray
    direction: FloatArray
    length: float
    v: float
    a: float
    anchor: FloatArray


@dataclass(slots=True)
class Corner:
    """Where a move gives way to the next: both straight parts end that far from the waypoint.

    Attributes:
        before, after: Ways that the blend takes from both moves, both 0 for a stop.
        entry, end: Speeds along both moves at the blend's ends.
    """

    before: float = 0.0
    after: float = 0.0
    entry: float = 0.0
    end: float = 0.0

    @property
    def ratio(self) -> float:
        """Of the two speeds, so that one parabola joins both."""
        return self.after / self.before

    def slow_to(self, entry: float) -> None:
        """Take it no faster than this."""
        if self.before > 0.0 and entry < self.entry:
            self.entry, self.end = entry, entry * self.ratio


def extent(distance: Callable[[float], float], radius: float, length: float) -> float:
    """How far from a waypoint the tool is `radius` away from it; at most half the move.

    Args:
        distance: Of the tool from the waypoint [m], by way from it.
        radius: [m].
        length: Of the move.
    """
    low, high = 0.0, 0.5 * length
    if distance(high) <= radius:
        return high
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if distance(middle) < radius:
            low = middle
        else:
            high = middle
    return low


def join(stretches: Sequence[Stretch], corners: Sequence[Corner], size: Size) -> list[Piece]:
    """The pieces of a path from rest to rest.

    Args:
        stretches: n ≥ 1 moves.
        corners: n - 1 of them, with their ways; speeds are set here.
        size: Of a change of coordinates.
    """
    _limit_by_curvature(stretches, corners, size)
    _limit_by_braking(stretches, corners)
    pieces: list[Piece] = []
    came = Corner()
    for i, stretch in enumerate(stretches):
        goes = corners[i] if i < len(corners) else Corner()
        pieces.append(_line(stretch, came, goes))
        if goes.entry > 0.0:
            pieces.append(_parabola(stretch, stretches[i + 1], goes, size))
            came = goes
        else:
            came = Corner()
    return pieces


def joint_size(change: FloatArray) -> float:
    """Of the leading axis [rad]."""
    return float(np.abs(change).max())


def tool_size(change: FloatArray) -> float:
    """Way of the tool [m], or a quarter of its turn [rad] where that is more."""
    x, y, z, rx, ry, rz = change.tolist()
    turn = rx * rx + ry * ry + rz * rz
    return sqrt(max(x * x + y * y + z * z, turn / TURN_RAD_M**2))


def _limit_by_curvature(
    stretches: Sequence[Stretch], corners: Sequence[Corner], size: Size
) -> None:
    """The acceleration in a blend is (end - entry) / duration, and duration 2 · before / entry."""
    for corner, (first, second) in zip(corners, pairwise(stretches), strict=True):
        if min(corner.before, corner.after) <= 0.0:
            corner.before = corner.after = 0.0
            continue
        corner.entry = min(first.v, second.v / corner.ratio)
        corner.end = corner.entry * corner.ratio
        bend = size(corner.ratio * second.direction - first.direction)
        if bend > 0.0:
            corner.slow_to(sqrt(2.0 * corner.before * min(first.a, second.a) / bend))


def _limit_by_braking(stretches: Sequence[Stretch], corners: Sequence[Corner]) -> None:
    """Every corner can be slowed down to from the one before, and reached from it."""
    end = 0.0
    for i in reversed(range(len(corners))):
        after = stretches[i + 1]
        straight = _straight(after, corners[i], corners[i + 1] if i + 1 < len(corners) else None)
        if corners[i].before > 0.0:
            corners[i].slow_to(sqrt(end**2 + 2.0 * after.a * straight) / corners[i].ratio)
        end = corners[i].entry
    start = 0.0
    for i, corner in enumerate(corners):
        straight = _straight(stretches[i], corners[i - 1] if i else None, corner)
        corner.slow_to(sqrt(start**2 + 2.0 * stretches[i].a * straight))
        start = corner.end


def _straight(stretch: Stretch, came: Corner | None, goes: Corner | None) -> float:
    taken = (came.after if came else 0.0) + (goes.before if goes else 0.0)
    return max(0.0, stretch.length - taken)


def _line(stretch: Stretch, came: Corner, goes: Corner) -> Line:
    start = stretch.start + came.after * stretch.direction
    length = _straight(stretch, came, goes)
    profile = trapezoid(length, stretch.v, stretch.a, came.end, goes.entry)
    return Line(stretch.leg, start, stretch.direction, profile, stretch.anchor)


def _parabola(first: Stretch, second: Stretch, corner: Corner, size: Size) -> Parabola:
    waypoint = second.start.copy()
    start = waypoint - corner.before * first.direction
    entry, end = corner.entry * first.direction, corner.end * second.direction
    duration = 2.0 * corner.before / corner.entry
    return Parabola(
        second.leg, start, entry, end, duration,
        limit=min(first.a, second.a), size=size((end - entry) / duration),
        speed=max(corner.entry, corner.end), anchor=second.anchor,
    )  # fmt: skip
