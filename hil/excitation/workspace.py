"""Where the arm may be and how fast it may go there: limits, distances, and the flange's space.

Well-spread clear poses are scrambled Sobol points of the joint ranges, less the colliding ones.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hil.core import BoolArray, FloatArray, PlanError
from hil.excitation.motion import Line, Motion

ROWS_AT_ONCE = 16_384
"""Joint positions per call of the collision model: enough to amortise it, few enough to stay in
the cache."""

COARSE = 24
"""Points of a line looked at before all its samples, to drop hopeless lines early."""

LIMIT_TOLERANCE_RAD = 1e-9


class Clearance(Protocol):
    """What is needed of a collision model (`hil.dynamics.CollisionModel`)."""

    def clearance(self, q: FloatArray) -> FloatArray:
        """(N,) smallest distance [m] at each of `q` (N, n); negative where bodies overlap."""

    def clearances(self, paths: Sequence[FloatArray], enough: float | None = None) -> FloatArray:
        """(len(paths),) smallest distance [m] over all samples (N, n) of each path.

        With `enough` [m], may stop early: returns any distance below `enough` if one exists.
        """

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """The smallest distance [m] at `q` (n,) and between which two bodies."""


def beyond_range(
    q: FloatArray, joint_names: Sequence[str], q_min: FloatArray, q_max: FloatArray
) -> str:
    """Return which joints of the position `q` (n,) are beyond their limits; empty if none is."""
    return "; ".join(
        f"{name} at {np.degrees(angle):.1f}° is beyond its range of "
        f"{np.degrees(low):.1f}° to {np.degrees(high):.1f}°"
        for name, angle, low, high in zip(joint_names, q, q_min, q_max, strict=True)
        if not low - LIMIT_TOLERANCE_RAD <= angle <= high + LIMIT_TOLERANCE_RAD
    )


class Distances(Protocol):
    """Distances that follow from the joint positions.

    `hil.dynamics.CollisionModel` and `hil.dynamics.FlangeSpace` are such: between bodies, and of
    the flange to the faces it has to stay inside.
    """

    @property
    def names(self) -> Sequence[tuple[str, str]]:
        """(R,) the two things of each distance: two bodies, or a point at the flange and a face."""

    @property
    def reach(self) -> FloatArray:
        """(R, n) metres that each distance can change per radian of each joint, at most."""

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distances [m] at `q` (N, n); negative where bodies overlap, or beyond a face."""


def outside(space: Distances, q: FloatArray, required_m: float) -> str:
    """Return which face of a space is nearest to the flange at `q` (n,), if nearer than required.

    Args:
        space: Where the flange has to stay.
        q: (n,) joint position [rad].
        required_m: Distance that is kept to every face.
    """
    distances = space.distances(q[None])[:, 0]
    nearest = int(distances.argmin())
    (point, face), depth = space.names[nearest], float(distances[nearest])
    if depth >= required_m:
        return ""
    if depth < 0:
        return f"the {point} is {-1e3 * depth:.1f} mm beyond {face}"
    required = f"{1e3 * required_m:.1f} mm are required"
    return f"the {point} is only {1e3 * depth:.1f} mm inside {face}, {required}"


def ways_out(space: Distances | None, q: FloatArray, required_m: float) -> list[str]:
    """Return what helps where poses `q` (N, n) are too near to faces, beside other poses.

    Args:
        space: Where the flange has to stay; None if it may go anywhere.
        q: (N, n) joint positions [rad].
        required_m: Distance that is kept to every face.
    """
    if space is None or not len(q):
        return []
    depth = space.distances(q).min(axis=0)
    near = depth < required_m
    ways = ["move that side of the workspace interlock outwards"] if near.any() else []
    # Below 0 no smaller distance helps.
    return ways + (["lower the station's clearance_m"] if (near & (depth > 0)).any() else [])


@dataclass(frozen=True, eq=False)
class Workspace:
    """A robot in its surroundings, as excitation and plan see it.

    Attributes:
        joint_names: Length n.
        q_min, q_max: The robot's position limits [rad], (n,).
        low, high: Range that excitation draws from [rad], (n,), inside the limits.
        collision: Distances of the arm with the largest payload of the experiment.
        clearance_m: Distance that is kept to everything, and by the flange to the faces of `space`.
        velocity, acceleration, jerk: Limits for every joint [rad/s, rad/s², rad/s³].
        rate_hz: Command rate; motions are checked at each of its samples.
        condition: Condition number of the base regressor at q, qd, qdd, each (N, n); lets an
            excitation choose between draws. None if it is not known.
        space: What the flange must not leave; None if it may go anywhere.
    """

    joint_names: tuple[str, ...]
    q_min: FloatArray
    q_max: FloatArray
    low: FloatArray
    high: FloatArray
    collision: Clearance
    clearance_m: float
    velocity: float
    acceleration: float
    jerk: float
    rate_hz: float
    condition: Callable[[FloatArray, FloatArray, FloatArray], float] | None = None
    space: Distances | None = None
    _known: dict[Motion, float] = field(default_factory=dict, init=False, repr=False)
    _known_depth: dict[Motion, float] = field(default_factory=dict, init=False, repr=False)
    _known_clear: dict[Motion, float] = field(default_factory=dict, init=False, repr=False)

    def line(self, start: FloatArray, goal: FloatArray) -> Line:
        """The straight way from `start` to `goal`, each (n,)."""
        ends = (tuple(map(float, start)), tuple(map(float, goal)))
        return Line(*ends, self.velocity, self.acceleration, self.jerk, self.rate_hz)

    def within_limits(self, q: FloatArray) -> BoolArray:
        """(N,) whether each of `q` (N, n) respects the robot's position limits."""
        inside = (q >= self.q_min - LIMIT_TOLERANCE_RAD) & (q <= self.q_max + LIMIT_TOLERANCE_RAD)
        return np.asarray(inside.all(axis=1))

    def is_clear(self, q: FloatArray) -> BoolArray:
        """(N,) whether each of `q` (N, n) is within limits and keeps its distance."""
        clear = self.within_limits(q)
        clear[clear] = self.depth(q[clear]) >= self.clearance_m
        clear[clear] = self.clearance(q[clear]) >= self.clearance_m
        return clear

    def depth(self, q: FloatArray) -> FloatArray:
        """Return how far [m] the flange is inside its space at each of `q` (N, n); (N,).

        Negative outside, infinite without a space.
        """
        if self.space is None:
            return np.full(len(q), np.inf)
        return np.asarray(self.space.distances(q).min(axis=0))

    def room(self, q: FloatArray) -> FloatArray:
        """Return the smaller of `clearance` and `depth` at each of `q` (N, n); (N,) [m]."""
        return np.minimum(self.clearance(q), self.depth(q))

    def clearance(self, q: FloatArray) -> FloatArray:
        """(N,) smallest distance [m] at each of `q` (N, n), computed in blocks."""
        blocks = [
            self.collision.clearance(q[i : i + ROWS_AT_ONCE])
            for i in range(0, len(q), ROWS_AT_ONCE)
        ]
        return np.concatenate(blocks) if blocks else np.empty(0)

    def clearances(self, motions: Sequence[Motion]) -> FloatArray:
        """(len(motions),) smallest distance [m] over every sample of each motion.

        Every motion is computed once; asking again costs nothing.
        """
        return self._least(motions, self.collision.clearances, self._known)

    def keep_clear(self, motions: Sequence[Motion]) -> BoolArray:
        """Return whether each motion keeps clear of bodies at every sample; (len(motions),).

        The faces of `space` do not count, see `depths`. Takes less than `clearances`, and asking
        again costs nothing here either.
        """
        kept = self.clearance_m
        least = self._least(
            motions, lambda paths: self.collision.clearances(paths, kept), self._known_clear
        )
        return np.asarray(least >= kept)

    def depths(self, motions: Sequence[Motion]) -> FloatArray:
        """Return the smallest `depth` over every sample of each motion; (len(motions),) [m]."""
        if self.space is None:
            return np.full(len(motions), np.inf)
        return self._least(motions, self._depths, self._known_depth)

    def are_clear(self, motions: Sequence[Motion]) -> bool:
        """Whether motions keep their distance at every sample and have their ends within limits."""
        ends = np.array([end for motion in motions for end in (motion.q_start, motion.q_end)])
        return bool(
            self.within_limits(ends).all()
            and np.all(self.depths(motions) >= self.clearance_m)
            and self.keep_clear(motions).all()
        )

    def look_clear(self, starts: FloatArray, goals: FloatArray) -> BoolArray:
        """(N,) whether the straight lines from `starts` to `goals`, each (N, n), may be clear.

        Only `COARSE` points of each are looked at: a no is final, a yes is not.
        """
        share = np.linspace(0.0, 1.0, COARSE)[:, None]
        points = starts[:, None] + share * (goals - starts)[:, None]
        clear = self.is_clear(points.reshape(-1, points.shape[2]))
        return np.asarray(clear.reshape(-1, COARSE).all(axis=1))

    def first_clear(self, lines: Sequence[Line]) -> int | None:
        """Index of the first line that is clear at every sample, or None."""
        if not lines:
            return None
        starts = np.array([motion.start for motion in lines])
        goals = np.array([motion.goal for motion in lines])
        for i in np.flatnonzero(self.look_clear(starts, goals)):
            if self.are_clear([lines[int(i)]]):
                return int(i)
        return None

    def complaint(self, q: FloatArray) -> str:
        """What is wrong with the position `q` (n,), or an empty string."""
        if beyond := beyond_range(q, self.joint_names, self.q_min, self.q_max):
            return beyond
        beyond_face = outside(self.space, q, self.clearance_m) if self.space else ""
        return "; ".join(filter(None, (beyond_face, self._too_close(q))))

    def obstacle(self, motions: Sequence[Motion]) -> str:
        """Describe what is wrong at the sample with the least room.

        If that room is enough, describe the sample furthest beyond the position limits; empty if
        all are within them. There must be at least one motion.
        """
        q = np.concatenate([motion.sample(self.rate_hz).q for motion in motions])
        if complaint := self.complaint(q[int(self.room(q).argmin())]):
            return complaint
        beyond = np.maximum(self.q_min - q, q - self.q_max).max(axis=1)
        return beyond_range(q[int(beyond.argmax())], self.joint_names, self.q_min, self.q_max)

    @property
    def larger_space(self) -> str:
        """Return how hints begin where the flange is confined; empty where it is not."""
        if self.space is None:
            return ""
        return "move that side of the workspace interlock outwards, or "

    def _too_close(self, q: FloatArray) -> str:
        """Return which bodies are too close to each other at `q` (n,)."""
        distance, bodies = self.collision.closest(q)
        if distance >= self.clearance_m:
            return ""
        state = (
            f"only {1e3 * distance:.1f} mm apart, {1e3 * self.clearance_m:.1f} mm are required"
            if distance > 0
            else f"in collision ({-1e3 * distance:.1f} mm deep)"
        )
        return f"{' and '.join(bodies)} are {state}"

    def _least(
        self,
        motions: Sequence[Motion],
        measure: Callable[[list[FloatArray]], FloatArray],
        known: dict[Motion, float],
    ) -> FloatArray:
        """Return `measure` of the samples of each motion, from `known` where it is there."""
        new = list(dict.fromkeys(motion for motion in motions if motion not in known))
        for some in _in_blocks(new, self.rate_hz):
            least = measure([motion.sample(self.rate_hz).q for motion in some])
            known.update(zip(some, map(float, least), strict=True))
        return np.array([known[motion] for motion in motions])

    def _depths(self, paths: Sequence[FloatArray]) -> FloatArray:
        """Return the smallest `depth` on each path; (len(paths),) [m]."""
        begins = np.cumsum([0, *map(len, paths[:-1])])
        return np.asarray(np.minimum.reduceat(self.depth(np.concatenate(paths)), begins))


def _in_blocks(motions: Sequence[Motion], rate_hz: float) -> Iterator[list[Motion]]:
    """Lists of motions with about `ROWS_AT_ONCE` samples together."""
    block: list[Motion] = []
    rows = 0.0
    for motion in motions:
        block.append(motion)
        rows += motion.duration_s * rate_hz + 1
        if rows >= ROWS_AT_ONCE:
            yield block
            block, rows = [], 0.0
    if block:
        yield block


BLOCK = 1024

HARDLY_ANY = 0.002
"""Share of clear poses below which there is no use in drawing on."""

HARDLY_ANY_INSIDE = 0.0003
"""The same where the flange is confined: most poses are then dropped by their flange alone, which
costs little, and a box of 0.3 m holds one in a thousand poses of a UR5."""

FEWEST_INSIDE = 64
"""Poses of a block where the flange is confined: fewer are not worth a look at their ways."""

ENOUGH = 8
"""The share is judged once so many poses were drawn that the minimum share would give this many
clear ones."""


def draw_poses(workspace: Workspace, seed: int, part: str = "poses") -> Iterator[FloatArray]:
    """Blocks (m, n) of clear poses within the workspace's range, well spread, without end.

    Sobol points fill the range evenly for any number of them (Sobol 1967, scrambled after Owen),
    so does what is left of them fill the clear part of the range.

    Args:
        workspace: Where they must be clear.
        seed: Of the scrambling.
        part: What messages call them, e.g. `dwell poses`.

    Raises:
        PlanError: Hardly any pose is clear.
    """
    from scipy.stats import qmc

    points = qmc.Sobol(len(workspace.low), scramble=True, rng=np.random.default_rng(seed))
    confined = workspace.space is not None
    least, fewest = (HARDLY_ANY_INSIDE, FEWEST_INSIDE) if confined else (HARDLY_ANY, 0)
    waiting: list[FloatArray] = []
    found = 0
    for drawn in itertools.count(BLOCK, BLOCK):
        q = workspace.low + points.random(BLOCK) * (workspace.high - workspace.low)
        clear = q[workspace.is_clear(q)]
        found += len(clear)
        if found < least * drawn and least * drawn >= ENOUGH:
            raise _too_few(workspace, q, f"{part}: only {found} of {drawn} well-spread poses")
        waiting.append(clear)
        if sum(map(len, waiting)) >= fewest:
            yield np.concatenate(waiting)
            waiting.clear()


def _too_few(workspace: Workspace, q: FloatArray, few: str) -> PlanError:
    """Return the error for the poses `few`, of which `q` (N, n) are the last that were drawn."""
    around = f"keep {1e3 * workspace.clearance_m:.0f} mm from everything around and the arm itself"
    free = q[workspace.clearance(q) >= workspace.clearance_m]
    depth = workspace.depth(free)
    if workspace.space is None or not len(free) or np.all(depth >= workspace.clearance_m):
        return PlanError(
            f"{few} {around}",
            hint="widen excitation.range_deg, or see whether the station's surroundings are "
            "as described",
        )
    nearest = workspace.complaint(free[int(depth.argmax())])
    return PlanError(
        f"{few} {around}, and the flange inside its workspace; closest rejected pose: {nearest}",
        hint=f"{workspace.larger_space}widen excitation.range_deg",
    )


def roomy_poses(workspace: Workspace, count: int, seed: int) -> FloatArray:
    """(count, n) well-spread poses from the roomier half of the clear ones."""
    blocks: list[FloatArray] = []
    for block in draw_poses(workspace, seed, "poses to travel over"):
        blocks.append(block)
        if sum(map(len, blocks)) >= 2 * count:
            break
    q = np.concatenate(blocks)
    room = workspace.room(q)
    return q[room >= np.median(room)][:count]
