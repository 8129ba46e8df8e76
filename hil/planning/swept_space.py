"""Space swept by the motions of a plan, shown to the operator before the motion."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hil.arms import ArmDescription, Capsule
from hil.core import FloatArray
from hil.dynamics import CapsuleChain
from hil.planning.plan import Plan

BLOCK = 16_384
"""Number of joint positions in one forward-kinematics call; a call is efficient, and its data
fit into the cache."""

NOISE_DEG = 0.01
"""Tolerance for rounding joint angles to whole degrees [deg], so that encoder noise has no
effect."""


class Box(NamedTuple):
    """Axis-aligned box in base coordinates: minimum and maximum corner, each (3,) [m]."""

    low: FloatArray
    high: FloatArray

    def __str__(self) -> str:
        return ", ".join(f"{axis} {text}" for axis, text in self.ranges())

    def ranges(self) -> list[tuple[str, str]]:
        """Return the name of each axis and its range as text."""
        # Rounded outwards, so that the displayed ranges contain the whole swept space.
        return [
            (axis, f"{math.floor(100 * a) / 100:.2f} to {math.ceil(100 * b) / 100:.2f} m")
            for axis, a, b in zip("xyz", self.low, self.high, strict=True)
        ]

    def to_dict(self) -> dict[str, list[float]]:
        """Return the JSON form of the box."""
        return {"min_m": self.low.tolist(), "max_m": self.high.tolist()}


@dataclass(frozen=True, slots=True, eq=False)
class Swept:
    """Space that the motions of a plan sweep.

    Attributes:
        duration_s: Estimated duration of the whole plan [s].
        joint_names: Names of the n joints.
        q_min, q_max: (n,) smallest and largest position of every joint [rad].
        tool: Bounding box of the flange and of every load with a known size.
        elbow: Bounding box of the body at the elbow.
        payload: Whether the box `tool` includes a load.
    """

    duration_s: float
    joint_names: tuple[str, ...]
    q_min: FloatArray
    q_max: FloatArray
    tool: Box
    elbow: Box
    payload: bool = False

    def lines(self) -> list[str]:
        """Return plain text with one line per entry, in degrees, metres, minutes and seconds."""
        return aligned(self.rows())

    def rows(self) -> list[tuple[str, str]]:
        """Return the name and the text of every entry; see `lines`."""
        return [
            ("duration", _minutes(self.duration_s)),
            *self._joints,
            *((name, str(box)) for name, box in self._boxes),
        ]

    def narrow_rows(self) -> list[tuple[str, str]]:
        """Return the ranges of joints and boxes, one row for each axis, for narrow tables."""
        boxes = [
            (f"{name} {axis}", text) for name, box in self._boxes for axis, text in box.ranges()
        ]
        return [*self._joints, *boxes]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, in radians, and in metres in base coordinates."""
        ranges = zip(self.joint_names, self.q_min.tolist(), self.q_max.tolist(), strict=True)
        return {
            "duration_s": self.duration_s,
            "joints": [
                {"name": name, "min_rad": low, "max_rad": high} for name, low, high in ranges
            ],
            "tool": self.tool.to_dict(),
            "elbow": self.elbow.to_dict(),
        }

    @property
    def _joints(self) -> list[tuple[str, str]]:
        ranges = zip(self.joint_names, np.degrees(self.q_min), np.degrees(self.q_max), strict=True)
        return [(name, f"{_floor(low)}° to {_ceil(high)}°") for name, low, high in ranges]

    @property
    def _boxes(self) -> list[tuple[str, Box]]:
        return [("flange and load" if self.payload else "flange", self.tool), ("elbow", self.elbow)]


def aligned(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return pairs of name and text as lines of two columns."""
    wide = max(len(name) for name, _ in rows)
    return [f"{name.ljust(wide)}  {text}" for name, text in rows]


def swept(plan: Plan, arm: ArmDescription) -> Swept:
    """Return the space that the motions of a plan sweep, over all set-points and the initial pose.

    Args:
        plan: Exactly the plan that will be executed.
        arm: Arm for which the plan was computed.
    """
    sizes = [load.size_m for load in plan.loads if load.size_m is not None]
    flange = (0.0, 0.0, 0.0)
    tool = [Capsule(arm.n_joints, flange, flange, 0.0)]
    for length, radius in sizes:
        ends = (flange, (0.0, 0.0, length))
        tool += [Capsule(arm.n_joints, end, end, radius) for end in ends]
    elbow = elbow_bodies(arm)
    goes = plan.extremes
    tool_box, elbow_box = _boxes(plan, arm, tool, elbow)
    return Swept(
        duration_s=plan.duration_s,
        joint_names=plan.joint_names,
        q_min=goes.q_min,
        q_max=goes.q_max,
        tool=tool_box,
        elbow=elbow_box,
        payload=bool(sizes),
    )


def elbow_bodies(arm: ArmDescription) -> list[Capsule]:
    """Return the end points of the upper-arm bodies at the elbow axis, as spheres.

    The elbow axis is the middle joint: the third of six joints, the fourth of seven joints. If the
    description of the arm has no body at the elbow axis, the returned sphere is a point on the
    axis.
    """
    link = (arm.n_joints - 1) // 2
    bodies = [body for body in arm.capsules if body.link == link]
    ends = [(end, body.radius) for body in bodies for end in (body.a, body.b)]
    if not ends:
        return [Capsule(link, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)]
    # The frame of a link in DH convention has the axis of the next joint as its z axis.
    nearest = min(math.hypot(*end[:2]) for end, _ in ends)
    return [Capsule(link, end, end, r) for end, r in ends if math.hypot(*end[:2]) <= nearest + 1e-9]


def _boxes(plan: Plan, arm: ArmDescription, *groups: list[Capsule]) -> list[Box]:
    """Return the bounding box of each group of spheres, which move with the links of the arm."""
    bodies = [body for group in groups for body in group]
    chain, radius = CapsuleChain(arm, bodies), np.array([body.radius for body in bodies])
    low, high = np.full((3, len(bodies)), np.inf), np.full((3, len(bodies)), -np.inf)
    for q in _positions(plan):
        centres, _ = chain.axes(q)
        low = np.minimum(low, centres.min(axis=2))
        high = np.maximum(high, centres.max(axis=2))
    ends = np.cumsum([len(group) for group in groups])
    parts = [slice(end - len(group), end) for end, group in zip(ends, groups, strict=True)]
    return [
        Box((low - radius)[:, part].min(axis=1), (high + radius)[:, part].max(axis=1))
        for part in parts
    ]


def _positions(plan: Plan) -> Iterator[FloatArray]:
    """Yield the initial position and every set-point as blocks (N, n) [rad]."""
    yield plan.q_start[None]
    for motion in dict.fromkeys(plan.motions):
        q = motion.sample(plan.rate_hz).q
        yield from (q[i : i + BLOCK] for i in range(0, len(q), BLOCK))


def _minutes(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _floor(angle_deg: float) -> int:
    return math.floor(angle_deg + NOISE_DEG)


def _ceil(angle_deg: float) -> int:
    return math.ceil(angle_deg - NOISE_DEG)
