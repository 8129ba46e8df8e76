"""Routes: moves as a program commands them, and the pieces of path that follow.

`Leg` is one `movej`, `movel` or `movep`. `joint_route` and `tool_route` turn legs into `Piece`s:
straight `Line`s with trapezoidal speed and, at corners with a blend radius, `Parabola`s. A motion
that cannot be ends in `MotionImpossible`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Literal, Protocol

import numpy as np

from hil.arms import ArmDescription
from hil.core import CommandRefused, FloatArray
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

NO_SOLUTION = "Inverse kinematics: unable to find a solution"
LEAST_WAY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """One `movej`, `movel` or `movep`.

    Attributes:
        kind: `j` leads straight in joint space, `l` and `p` in tool space.
        target: (6,) joint position [rad], or a pose.
        v, a: Of the leading axis [rad/s, rad/s²], or of the tool [m/s, m/s²].
        radius: Blend radius at the target [m].
        time_s: How long it takes from rest to rest, in place of `v` and `a`, unless 0.
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
        """Whether its way is straight in joint space."""
        return self.kind == "j"


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """Whose moves they are.

    Attributes:
        arm: Its lengths and limits; None for joint moves without limits.
        tcp: (6,) tool in the flange frame.
    """

    arm: ArmDescription | None = None
    tcp: FloatArray | None = None

    @property
    def known(self) -> tuple[ArmDescription, FloatArray]:
        """Arm and tool.

        Raises:
            MotionImpossible: No arm was named, and this needs one.
        """
        if self.arm is None:
            raise MotionImpossible("a pose without an arm leads nowhere")
        return self.arm, np.zeros(6) if self.tcp is None else self.tcp


def alike(legs: Sequence[Leg]) -> int:
    """How many legs at the front can be blended: those in the same space as the first."""
    kind = legs[0].joint_space
    return next((i for i, leg in enumerate(legs) if leg.joint_space != kind), len(legs))


def joint_route(site: Site, legs: Sequence[Leg], first: int, q: FloatArray) -> list[Piece]:
    """Pieces of moves that are straight in joint space.

    Args:
        site: Whose.
        legs: The moves.
        first: Index of the first of them.
        q: (6,) where the arm stands [rad].

    Raises:
        MotionImpossible: A target lies beyond the joint limits or out of reach.
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
    return join(stretches, corners, joint_size)


def _require_numbers(leg: Leg) -> None:
    values = np.array([*leg.target, leg.v, leg.a, leg.radius, leg.time_s])
    if not np.isfinite(values).all() or (leg.time_s <= 0.0 and min(leg.v, leg.a) <= 0.0):
        raise MotionImpossible(
            f"move{leg.kind}: a speed of {leg.v:g} and an acceleration of {leg.a:g} lead nowhere",
            hint="both must be greater than 0, and all numbers finite",
        )


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
    """No joint beyond the arm's own speed and acceleration."""
    if arm is None:
        return v, a
    shares = np.maximum(np.abs(direction), 1e-12)
    return min(v, float((arm.qd_max / shares).min())), min(a, float((arm.qdd_max / shares).min()))


def _pace_of(leg: Leg, way: float) -> tuple[float, float]:
    return timed(way, leg.time_s) if leg.time_s > 0.0 else (leg.v, leg.a)


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
    """Pieces of moves that are straight for the tool; see `joint_route`."""
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
    return join(stretches, corners, tool_size)


def _tool_corner(first: Stretch, second: Stretch, radius: float) -> Corner:
    if radius <= 0.0:
        return Corner()
    shares = (float(np.linalg.norm(each.direction[:3])) for each in (first, second))
    before, after = (radius / max(share, 1e-12) for share in shares)
    return Corner(min(before, 0.5 * first.length), min(after, 0.5 * second.length))


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


def joint_size(change: FloatArray) -> float:
    """Of the leading axis [rad]."""
    return float(np.abs(change).max())


def tool_size(change: FloatArray) -> float:
    """Way of the tool [m], or a quarter of its turn [rad] where that is more."""
    x, y, z, rx, ry, rz = change.tolist()
    turn = rx * rx + ry * ry + rz * rz
    return sqrt(max(x * x + y * y + z * z, turn / TURN_RAD_M**2))


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


JOINT_LIMITS, SINGULARITY, SUDDEN_CHANGE = 150, 154, 204

TEXTS = {
    JOINT_LIMITS: "Position close to joint limits",
    SINGULARITY: "Position in singularity",
    SUDDEN_CHANGE: "Path sanity check: Sudden change in target position",
}
"""UR's error codes C… that motions lead to, and what they are called.

Source: Universal Robots, "Service Manual", chapter on error codes.
"""

TOLERANCE_RAD = 1e-6


class MotionImpossible(CommandRefused):
    """A motion cannot begin or cannot go on; raised by `advance` alone.

    Args:
        text: What is wrong, as the pendant would say it.
        code: UR's code of a protective stop, or 0 for a runtime error of the program.

    Attributes:
        text, code: The same.
    """

    def __init__(self, text: str, code: int = 0, *, hint: str = "") -> None:
        named = f"C{code}: {TEXTS[code]}: {text}" if code else text
        super().__init__(named, hint=hint or "command a motion that the arm can make")
        self.text, self.code = named, code


def require_within(arm: ArmDescription, q: FloatArray) -> None:
    """Refuse a target (6,) [rad] beyond the joint limits.

    Raises:
        MotionImpossible: With code 150.
    """
    beyond = (q > arm.q_max + TOLERANCE_RAD) | (q < arm.q_min - TOLERANCE_RAD)
    if beyond.any():
        raise out_of(arm, int(beyond.argmax()))


def out_of(arm: ArmDescription, joint: int) -> MotionImpossible:
    """What is raised when a joint would leave its range."""
    low, high = arm.q_min[joint], arm.q_max[joint]
    return MotionImpossible(
        f"joint {joint + 1} must stay between {low:.4f} and {high:.4f} rad", JOINT_LIMITS
    )


def require_finite(*numbers: float | FloatArray) -> None:
    """Refuse what is no number.

    Raises:
        MotionImpossible: With code 204.
    """
    if not all(np.isfinite(each).all() for each in numbers):
        raise MotionImpossible("a target is not a finite number", SUDDEN_CHANGE)


def leaving(arm: ArmDescription, q: FloatArray, qd: FloatArray) -> int | None:
    """The joint that is beyond its range and goes on outwards, or None."""
    beyond = (q > arm.q_max + TOLERANCE_RAD) & (qd > 0)
    beyond |= (q < arm.q_min - TOLERANCE_RAD) & (qd < 0)
    return int(beyond.argmax()) if beyond.any() else None
