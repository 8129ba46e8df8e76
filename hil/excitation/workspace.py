"""Workspace of a robot: joint limits, distances between bodies, and the space of the flange.

Well-spread clear poses are scrambled Sobol points of the joint ranges; colliding points are left
out.
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
"""Number of joint positions per call of the collision model: enough to make the overhead of a call
small, and few enough for the data to fit in the processor cache.
"""

COARSE = 24
"""Number of points of a line that are checked before all its samples, because they reject most
blocked lines early.
"""

LIMIT_TOLERANCE_RAD = 1e-9


class Clearance(Protocol):
    """Interface of the collision model of a workspace (`hil.dynamics.CollisionModel`)."""

    def clearance(self, q: FloatArray) -> FloatArray:
        """Return the smallest distance [m] at each of `q` (N, n); negative if bodies overlap."""

    def clearances(self, paths: Sequence[FloatArray], enough: float | None = None) -> FloatArray:
        """Return the smallest distance [m] over all samples (N, n) of each path; (len(paths),).

        If `enough` [m] is set, the search for the minimum may stop at any distance below `enough`.
        """

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """Return the smallest distance [m] at `q` (n,) and the names of the two closest bodies."""


def beyond_range(
    q: FloatArray, joint_names: Sequence[str], q_min: FloatArray, q_max: FloatArray
) -> str:
    """Return a text naming the joints of `q` (n,) beyond their limits; empty if there are none."""
    return "; ".join(
        f"{name} at {np.degrees(angle):.1f}° is beyond its range of "
        f"{np.degrees(low):.1f}° to {np.degrees(high):.1f}°"
        for name, angle, low, high in zip(joint_names, q, q_min, q_max, strict=True)
        if not low - LIMIT_TOLERANCE_RAD <= angle <= high + LIMIT_TOLERANCE_RAD
    )


class Distances(Protocol):
    """Interface for distances that depend only on the joint positions.

    The interface has two implementations: `hil.dynamics.CollisionModel` computes distances between
    bodies, and `hil.dynamics.FlangeSpace` computes distances of the flange to the faces of its
    space.
    """

    @property
    def names(self) -> Sequence[tuple[str, str]]:
        """Names of the pair of each distance, (R,): two bodies, or a flange point and a face."""

    @property
    def reach(self) -> FloatArray:
        """Largest change of each distance per radian of each joint [m/rad], (R, n)."""

    def distances(self, q: FloatArray) -> FloatArray:
        """Return the distances [m] at each of `q` (N, n); (R, N), negative for penetration."""


def outside(space: Distances, q: FloatArray, required_m: float) -> str:
    """Return a text about the face nearest to the flange; empty if the distance is large enough.

    Args:
        space: Distances of the flange to the faces of its space.
        q: (n,) joint position [rad].
        required_m: Required distance to every face [m].
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
    """Return hints for poses that are too close to faces, except the hint to choose other poses.

    Args:
        space: Distances of the flange to the faces of its space; None if the flange is not
            confined.
        q: (N, n) joint positions [rad].
        required_m: Required distance to every face [m].
    """
    if space is None or not len(q):
        return []
    depth = space.distances(q).min(axis=0)
    near = depth < required_m
    ways = ["move that side of the workspace interlock outwards"] if near.any() else []
    # A smaller required distance does not help a flange outside its space (depth < 0).
    return ways + (["lower the station's clearance_m"] if (near & (depth > 0)).any() else [])


@dataclass(frozen=True, eq=False)
class Workspace:
    """Robot and its surroundings, as used for excitation and planning.

    Attributes:
        joint_names: Names of the n joints.
        q_min, q_max: Position limits of the robot [rad], (n,).
        low, high: Position range of the excitation [rad], (n,), within the position limits.
        collision: Distances between the bodies for the arm with the largest payload of the
            experiment.
        clearance_m: Required distance [m] between bodies, and between the flange and the faces of
            `space`.
        velocity, acceleration, jerk: Limits for every joint [rad/s, rad/s², rad/s³].
        rate_hz: Command rate [Hz]; motions are checked at every sample of this rate.
        condition: Function that returns the condition number of the base regressor at q, qd, qdd,
            each (N, n); an excitation uses it to choose between draws. The value of `condition` is
            None if no condition number is available.
        space: Distances of the flange to the faces of its space; None if the flange is not
            confined.
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
        """Return the straight line in joint space from `start` to `goal`, each (n,)."""
        ends = (tuple(map(float, start)), tuple(map(float, goal)))
        return Line(*ends, self.velocity, self.acceleration, self.jerk, self.rate_hz)

    def within_limits(self, q: FloatArray) -> BoolArray:
        """Return whether each of `q` (N, n) is within the position limits of the robot, (N,)."""
        inside = (q >= self.q_min - LIMIT_TOLERANCE_RAD) & (q <= self.q_max + LIMIT_TOLERANCE_RAD)
        return np.asarray(inside.all(axis=1))

    def is_clear(self, q: FloatArray) -> BoolArray:
        """Return whether each of `q` (N, n) is within limits and clear of bodies and faces."""
        clear = self.within_limits(q)
        clear[clear] = self.depth(q[clear]) >= self.clearance_m
        clear[clear] = self.clearance(q[clear]) >= self.clearance_m
        return clear

    def depth(self, q: FloatArray) -> FloatArray:
        """Return the distance [m] of the flange to the nearest face of its space; (N,).

        The distance of the flange is negative outside the space, and infinite if there is no space.
        `q` is (N, n).
        """
        if self.space is None:
            return np.full(len(q), np.inf)
        return np.asarray(self.space.distances(q).min(axis=0))

    def room(self, q: FloatArray) -> FloatArray:
        """Return the smaller of `clearance` and `depth` at each of `q` (N, n); (N,) [m]."""
        return np.minimum(self.clearance(q), self.depth(q))

    def clearance(self, q: FloatArray) -> FloatArray:
        """Return the smallest distance [m] at each of `q` (N, n), computed in blocks; (N,)."""
        blocks = [
            self.collision.clearance(q[i : i + ROWS_AT_ONCE])
            for i in range(0, len(q), ROWS_AT_ONCE)
        ]
        return np.concatenate(blocks) if blocks else np.empty(0)

    def clearances(self, motions: Sequence[Motion]) -> FloatArray:
        """Return the smallest distance between bodies [m] over all samples of each motion.

        The smallest distance of each motion is cached.
        """
        return self._least(motions, self.collision.clearances, self._known)

    def keep_clear(self, motions: Sequence[Motion]) -> BoolArray:
        """Return whether each motion keeps clear of bodies at every sample; (len(motions),).

        The faces of `space` are not checked here, see `depths`. The check is faster than
        `clearances`, and the check results are cached, too.
        """
        kept = self.clearance_m
        least = self._least(
            motions, lambda paths: self.collision.clearances(paths, kept), self._known_clear
        )
        return np.asarray(least >= kept)

    def depths(self, motions: Sequence[Motion]) -> FloatArray:
        """Return the smallest `depth` over all samples of each motion; (len(motions),) [m]."""
        if self.space is None:
            return np.full(len(motions), np.inf)
        return self._least(motions, self._depths, self._known_depth)

    def are_clear(self, motions: Sequence[Motion]) -> bool:
        """Return whether motions keep the required distance and end within the joint limits."""
        ends = np.array([end for motion in motions for end in (motion.q_start, motion.q_end)])
        return bool(
            self.within_limits(ends).all()
            and np.all(self.depths(motions) >= self.clearance_m)
            and self.keep_clear(motions).all()
        )

    def look_clear(self, starts: FloatArray, goals: FloatArray) -> BoolArray:
        """Return for each line from `starts` to `goals`, each (N, n), whether it looks clear; (N,).

        Only `COARSE` points of each line are checked: the value False is certain, whereas True is
        not.
        """
        share = np.linspace(0.0, 1.0, COARSE)[:, None]
        points = starts[:, None] + share * (goals - starts)[:, None]
        clear = self.is_clear(points.reshape(-1, points.shape[2]))
        return np.asarray(clear.reshape(-1, COARSE).all(axis=1))

    def first_clear(self, lines: Sequence[Line]) -> int | None:
        """Return the index of the first line that is clear at every sample, or else None."""
        if not lines:
            return None
        starts = np.array([motion.start for motion in lines])
        goals = np.array([motion.goal for motion in lines])
        for i in np.flatnonzero(self.look_clear(starts, goals)):
            if self.are_clear([lines[int(i)]]):
                return int(i)
        return None

    def complaint(self, q: FloatArray) -> str:
        """Return a text with the problems of the position `q` (n,); empty without problems."""
        if beyond := beyond_range(q, self.joint_names, self.q_min, self.q_max):
            return beyond
        beyond_face = outside(self.space, q, self.clearance_m) if self.space else ""
        return "; ".join(filter(None, (beyond_face, self._too_close(q))))

    def obstacle(self, motions: Sequence[Motion]) -> str:
        """Return a text about the sample closest to an obstacle or beyond the position limits.

        If the smallest distance is large enough, the text describes the sample furthest beyond the
        position limits. The text is empty if the distance is large enough and all samples are
        within the limits. The argument must contain at least one motion.
        """
        q = np.concatenate([motion.sample(self.rate_hz).q for motion in motions])
        if complaint := self.complaint(q[int(self.room(q).argmin())]):
            return complaint
        beyond = np.maximum(self.q_min - q, q - self.q_max).max(axis=1)
        return beyond_range(q[int(beyond.argmax())], self.joint_names, self.q_min, self.q_max)

    @property
    def larger_space(self) -> str:
        """First words of a hint to enlarge the space of the flange; empty if there is none."""
        if self.space is None:
            return ""
        return "move that side of the workspace interlock outwards, or "

    def _too_close(self, q: FloatArray) -> str:
        """Return a text about the closest bodies at `q` (n,); empty if they are far enough."""
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
        """Return the minimum of `measure` over each motion; the minima are cached in `known`."""
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
    """Yield lists of motions with about `ROWS_AT_ONCE` samples per list."""
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
"""Share of clear poses below which the drawing of poses is given up."""

HARDLY_ANY_INSIDE = 0.0003
"""Share of clear poses below which the drawing of poses is given up if the flange is confined. The
limit for a confined flange is lower, because most poses are rejected by the position of the flange
alone, which is a fast check: only one in a thousand poses of a UR5 is inside a box of 0.3 m.
"""

FEWEST_INSIDE = 64
"""Minimum number of poses per block if the flange is confined; a search for paths is not worthwhile
for smaller blocks.
"""

ENOUGH = 8
"""Expected number of clear poses at the minimum share, from which on the actual share of clear
poses is checked.
"""


def draw_poses(workspace: Workspace, seed: int, part: str = "poses") -> Iterator[FloatArray]:
    """Yield blocks (m, n) of clear, well-spread poses within the range, without end.

    Any number of Sobol points fills the joint range evenly (Sobol 1967, scrambled after Owen). The
    clear points among the Sobol points fill the clear part of the range evenly, too.

    Args:
        workspace: Workspace in which the poses must be clear.
        seed: Seed of the scrambling of the Sobol points.
        part: Name of the poses in error messages, such as `dwell poses`.

    Raises:
        PlanError: The share of clear poses is too small.
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
    """Return the error for too few poses; `q` (N, n) are the poses drawn last."""
    around = f"keep {1e3 * workspace.clearance_m:.0f} mm from the surroundings and the arm itself"
    free = q[workspace.clearance(q) >= workspace.clearance_m]
    depth = workspace.depth(free)
    if workspace.space is None or not len(free) or np.all(depth >= workspace.clearance_m):
        return PlanError(
            f"{few} {around}",
            hint="widen excitation.range_deg, or check the station's surroundings",
        )
    nearest = workspace.complaint(free[int(depth.argmax())])
    return PlanError(
        f"{few} {around}, and the flange inside its workspace; closest rejected pose: {nearest}",
        hint=f"{workspace.larger_space}widen excitation.range_deg",
    )


def roomy_poses(workspace: Workspace, count: int, seed: int) -> FloatArray:
    """Return well-spread clear poses (count, n) with at least the median distance to obstacles."""
    blocks: list[FloatArray] = []
    for block in draw_poses(workspace, seed, "poses to travel over"):
        blocks.append(block)
        if sum(map(len, blocks)) >= 2 * count:
            break
    q = np.concatenate(blocks)
    room = workspace.room(q)
    return q[room >= np.median(room)][:count]
