"""Moves as a program commands them, and the pieces of path that follow from where the arm is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.blends import Corner, Stretch, extent, join, joint_size, tool_size
from hil_mock_robot.ur.inverse import solve
from hil_mock_robot.ur.kinematics import pose_of, tool_frame
from hil_mock_robot.ur.limits import MotionImpossible, require_within
from hil_mock_robot.ur.pieces import Piece
from hil_mock_robot.ur.poses import Numbers, compose, frame_of, inverted, rotation_vector
from hil_mock_robot.ur.profiles import timed

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


def _require_numbers(leg: Leg) -> None:
    values = np.array([*leg.target, leg.v, leg.a, leg.radius, leg.time_s])
    if not np.isfinite(values).all() or (leg.time_s <= 0.0 and min(leg.v, leg.a) <= 0.0):
        raise MotionImpossible(
            f"move{leg.kind}: a speed of {leg.v:g} and an acceleration of {leg.a:g} lead nowhere",
            hint="both must be greater than 0, and all numbers finite",
        )


def _pace_of(leg: Leg, way: float) -> tuple[float, float]:
    return timed(way, leg.time_s) if leg.time_s > 0.0 else (leg.v, leg.a)


def _limited(
    arm: ArmDescription | None, direction: FloatArray, v: float, a: float
) -> tuple[float, float]:
    """No joint beyond the arm's own speed and acceleration."""
    if arm is None:
        return v, a
    shares = np.maximum(np.abs(direction), 1e-12)
    return min(v, float((arm.qd_max / shares).min())), min(a, float((arm.qdd_max / shares).min()))


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


def _tool_corner(first: Stretch, second: Stretch, radius: float) -> Corner:
    if radius <= 0.0:
        return Corner()
    shares = (float(np.linalg.norm(each.direction[:3])) for each in (first, second))
    before, after = (radius / max(share, 1e-12) for share in shares)
    return Corner(min(before, 0.5 * first.length), min(after, 0.5 * second.length))
