"""Routes: conversion of the moves of a program into the pieces of a path.

A `Leg` is one `movej`, `movel` or `movep`. `joint_route` and `tool_route` convert legs into
straight segments in joint or tool coordinates, compute the maximum speed of each blended corner,
and join segments and corners as `path_pieces`. An impossible motion raises `MotionImpossible`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Literal

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.kinematics import (
    Numbers,
    compose,
    frame_of,
    inverted,
    pose_of,
    rotation_vector,
    solve,
    tool_frame,
)
from hil_mock_robot.ur.motion_limits import MotionImpossible, require_within
from hil_mock_robot.ur.path_pieces import (
    Line,
    Parabola,
    Piece,
    Size,
    joint_size,
    pace_for_duration,
    tool_size,
    trapezoid,
)


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """Single `movej`, `movel` or `movep`.

    Attributes:
        kind: Kind of the move: `j` is straight in joint space, `l` and `p` in tool space.
        target: Joint position [rad] or pose, (6,).
        v, a: Speed and acceleration of the leading axis [rad/s, rad/s²] or of the tool [m/s, m/s²].
        radius: Blend radius at the target [m].
        time_s: Duration from rest to rest, which replaces `v` and `a` unless it is 0 [s].
        is_pose: Whether `target` is a pose.
    """

    kind: Literal["j", "l", "p"]
    target: Numbers
    v: float
    a: float
    radius: float = 0.0
    time_s: float = 0.0
    is_pose: bool = False

    @property
    def joint_space(self) -> bool:
        """Whether the path is straight in joint space."""
        return self.kind == "j"


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Arm and tool of the moves.

    Attributes:
        arm: Arm with its lengths and limits; None for joint moves without limits.
        tcp: Tool in the flange frame, (6,).
    """

    arm: ArmDescription | None = None
    tcp: FloatArray | None = None

    @property
    def known(self) -> tuple[ArmDescription, FloatArray]:
        """Arm and tool.

        Raises:
            MotionImpossible: No arm was specified, although the move needs an arm.
        """
        if self.arm is None:
            raise MotionImpossible("a pose as target needs an arm")
        return self.arm, np.zeros(6) if self.tcp is None else self.tcp


def blendable(legs: Sequence[Leg]) -> int:
    """Return the number of initial legs that move in the same space as the first leg.

    Only consecutive legs in the same space can be blended.
    """
    kind = legs[0].joint_space
    return next((i for i, leg in enumerate(legs) if leg.joint_space != kind), len(legs))


LEAST_WAY = 1e-9


def joint_route(site: Site, legs: Sequence[Leg], first: int, q: FloatArray) -> list[Piece]:
    """Return the pieces of moves that are straight in joint space.

    Args:
        site: Arm and tool of the moves.
        legs: Moves to convert to pieces of a path.
        first: Index in the path of the first of the moves to convert.
        q: Joint position at the start, (6,) [rad].

    Raises:
        MotionImpossible: A target is beyond the joint limits or out of reach.
    """
    stretches, radii, at = [], [], q
    for i, leg in enumerate(legs):
        _require_numbers(leg)
        target = _joints_of(site, leg, at)
        way = joint_size(target - at)
        if way > LEAST_WAY:
            direction = (target - at) / way
            v, a = _limited(site.arm, direction, *_pace_of(leg, way))
            stretches.append(Stretch(first + i, at, direction, way, v, a, np.zeros(3)))
            radii.append(leg.radius)
            at = target
    corners = [
        _joint_corner(site, before, after, radius)
        for (before, after), radius in zip(pairwise(stretches), radii, strict=False)
    ]
    return join_stretches(stretches, corners, joint_size)


def _require_numbers(leg: Leg) -> None:
    values = np.array([*leg.target, leg.v, leg.a, leg.radius, leg.time_s])
    if not np.isfinite(values).all() or (leg.time_s <= 0.0 and min(leg.v, leg.a) <= 0.0):
        raise MotionImpossible(
            f"move{leg.kind}: invalid speed {leg.v:g} or acceleration {leg.a:g}",
            hint="both must be greater than 0, and all numbers finite",
        )


NO_SOLUTION = "Inverse kinematics: unable to find a solution"


def _joints_of(site: Site, leg: Leg, near: FloatArray) -> FloatArray:
    if leg.is_pose:
        arm, tcp = site.known
        found = solve(arm, leg.target, near, tcp, position_m=1e-6, orientation_rad=1e-6)
        if found is None:
            raise MotionImpossible(NO_SOLUTION, hint="the target of a move is out of reach")
        return found
    target = np.array(leg.target, dtype=np.float64)
    if site.arm is not None:
        require_within(site.arm, target)
    return target


def _limited(
    arm: ArmDescription | None, direction: FloatArray, v: float, a: float
) -> tuple[float, float]:
    """Return `v` and `a` reduced so that no joint exceeds its speed and acceleration limits."""
    if arm is None:
        return v, a
    shares = np.maximum(np.abs(direction), 1e-12)
    return min(v, float((arm.qd_max / shares).min())), min(a, float((arm.qdd_max / shares).min()))


def _pace_of(leg: Leg, way: float) -> tuple[float, float]:
    return pace_for_duration(way, leg.time_s) if leg.time_s > 0.0 else (leg.v, leg.a)


def _joint_corner(site: Site, first: Stretch, second: Stretch, radius: float) -> Corner:
    if radius <= 0.0:
        return Corner()
    arm, tcp = site.known
    waypoint = second.start
    centre = np.array(tool_frame(arm, waypoint, tcp)[9:])

    def away(direction: FloatArray) -> float:
        there = tool_frame(arm, waypoint + direction, tcp)[9:]
        return float(np.linalg.norm(np.array(there) - centre))

    return Corner(
        extent(lambda way: away(-way * first.direction), radius, first.length),
        extent(lambda way: away(way * second.direction), radius, second.length),
    )


def tool_route(site: Site, legs: Sequence[Leg], first: int, q: FloatArray) -> list[Piece]:
    """Return the pieces of moves that are straight in tool space; see `joint_route`."""
    arm, tcp = site.known
    stretches, radii, at = [], [], pose_of(arm, q, tcp)
    for i, leg in enumerate(legs):
        _require_numbers(leg)
        target = np.array(leg.target) if leg.is_pose else pose_of(arm, leg.target, tcp)
        if solve(arm, target, q, tcp, position_m=1e-6, orientation_rad=1e-6) is None:
            raise MotionImpossible(NO_SOLUTION, hint="the target of a move is out of reach")
        turn = rotation_vector(compose(inverted(frame_of(at)), frame_of(target)))
        change = np.concatenate((target[:3] - at[:3], turn))
        way = tool_size(change)
        if way > LEAST_WAY:
            start = np.concatenate((at[:3], np.zeros(3)))
            pace = _pace_of(leg, way)
            stretches.append(Stretch(first + i, start, change / way, way, *pace, at[3:]))
            radii.append(leg.radius)
            at = target
    corners = [
        _tool_corner(before, after, radius)
        for (before, after), radius in zip(pairwise(stretches), radii, strict=False)
    ]
    return join_stretches(stretches, corners, tool_size)


def _tool_corner(first: Stretch, second: Stretch, radius: float) -> Corner:
    if radius <= 0.0:
        return Corner()
    shares = (float(np.linalg.norm(each.direction[:3])) for each in (first, second))
    before, after = (radius / max(share, 1e-12) for share in shares)
    return Corner(min(before, 0.5 * first.length), min(after, 0.5 * second.length))


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Straight segment of a move between two waypoints.

    Attributes:
        leg: Index of the move in its path.
        start: Coordinates of the waypoint at the start, (6,).
        direction: Change of the coordinates per unit of path length, (6,).
        length: Path length.
        v, a: Maximum speed and acceleration along the move.
        anchor: Rotation vector of the frame at the start, (3,); the coordinates rotate this frame.
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
    """Blend between two consecutive moves.

    Attributes:
        before, after: Path lengths that the blend replaces in both moves; both are 0 if the arm
            stops between the moves.
        entry, end: Speeds along the two moves at the start and at the end of the blend.
    """

    before: float = 0.0
    after: float = 0.0
    entry: float = 0.0
    end: float = 0.0

    @property
    def ratio(self) -> float:
        """Ratio of the two speeds for which a single parabola joins the two moves."""
        return self.after / self.before

    def slow_to(self, entry: float) -> None:
        """Reduce the entry speed to at most `entry`."""
        if self.before > 0.0 and entry < self.entry:
            self.entry, self.end = entry, entry * self.ratio


def join_stretches(
    stretches: Sequence[Stretch], corners: Sequence[Corner], size: Size
) -> list[Piece]:
    """Return the pieces of a path from rest to rest.

    Args:
        stretches: n ≥ 1 straight moves.
        corners: Blended corners between the n moves, n - 1 in number; this function sets the speeds
            of the corners.
        size: Function for the size of a change of coordinates.
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


def _limit_by_curvature(
    stretches: Sequence[Stretch], corners: Sequence[Corner], size: Size
) -> None:
    """Limit the corner speeds by the acceleration in the blend.

    The acceleration is (end - entry) / duration, and the duration is 2 · before / entry.
    """
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
    """Limit the corner speeds so that each speed is reachable from the neighbouring corners."""
    end = 0.0
    for i in reversed(range(len(corners))):
        after = stretches[i + 1]
        straight = _straight_length(
            after, corners[i], corners[i + 1] if i + 1 < len(corners) else None
        )
        if corners[i].before > 0.0:
            corners[i].slow_to(sqrt(end**2 + 2.0 * after.a * straight) / corners[i].ratio)
        end = corners[i].entry
    start = 0.0
    for i, corner in enumerate(corners):
        straight = _straight_length(stretches[i], corners[i - 1] if i else None, corner)
        corner.slow_to(sqrt(start**2 + 2.0 * stretches[i].a * straight))
        start = corner.end


def _straight_length(stretch: Stretch, came: Corner | None, goes: Corner | None) -> float:
    taken = (came.after if came else 0.0) + (goes.before if goes else 0.0)
    return max(0.0, stretch.length - taken)


def _line(stretch: Stretch, came: Corner, goes: Corner) -> Line:
    start = stretch.start + came.after * stretch.direction
    length = _straight_length(stretch, came, goes)
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


BISECTIONS = 24


def extent(distance: Callable[[float], float], radius: float, length: float) -> float:
    """Return the path length from a waypoint to where the tool is `radius` away from it.

    The returned path length is at most half the length of the move.

    Args:
        distance: Function from path length to the distance of the tool from the waypoint [m].
        radius: Blend radius [m].
        length: Path length of the move.
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
