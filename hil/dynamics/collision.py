"""Signed distances of an arm to itself, its payload and its surroundings.

Bodies are capsules that move with the links. Distances are computed with numpy for blocks of
samples, which is as fast as Pinocchio's `computeDistances` sample by sample (2 to 3 µs for the 39
pairs of a UR5, `benchmarks/collision.py`), and yields all distances at no extra cost: that is what
lets the search along a path skip most samples.

What stands around is an `Environment` of planes and boxes; the space a flange has to stay in is a
`FlangeSpace`. In the functions of distances points are arrays of shape (3, P, N): coordinate, pair,
sample. The coordinate comes first so that every operation runs over one contiguous block.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hil.arms import ArmDescription, Capsule, Payload
from hil.core import BoolArray, DataError, FloatArray, IntArray, SpecError

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Plane:
    """A half-space the arm must stay in.

    Attributes:
        point: Any point of the plane [m].
        normal: Points to the side where the arm may be; its length does not matter.
        name: For messages.
    """

    point: Vector
    normal: Vector
    name: str = "wall"

    @property
    def unit_normal(self) -> FloatArray:
        """(3,) normal of length 1."""
        normal = np.array(self.normal, dtype=np.float64)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, slots=True)
class Box:
    """A solid box along the axes of the base frame.

    Attributes:
        centre: [m].
        size: Full edge lengths [m].
        name: For messages.
    """

    centre: Vector
    size: Vector
    name: str = "box"

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner, each (3,) [m]."""
        centre, half = np.array(self.centre, dtype=np.float64), 0.5 * np.array(self.size)
        return centre - half, centre + half


@dataclass(frozen=True, slots=True)
class Environment:
    """Everything around the arm.

    Attributes:
        table_z: Height of the table the base stands on [m], None when there is none.
        walls: Planes the arm must stay in front of.
        boxes: Obstacles the arm must stay out of.
    """

    table_z: float | None = None
    walls: tuple[Plane, ...] = ()
    boxes: tuple[Box, ...] = ()

    @property
    def table(self) -> Plane | None:
        """The table as a plane."""
        if self.table_z is None:
            return None
        return Plane((0.0, 0.0, self.table_z), (0.0, 0.0, 1.0), "table")


PAYLOAD_RADIUS_MIN = 0.03
"""Smallest radius of a payload's body [m]."""


def payload_capsule(payload: Payload, link: int, radius: float | None = None) -> Capsule | None:
    """A body for a load of which only mass and centre of mass are known; None without a load.

    It reaches from the flange through the centre of mass and as far again behind it, with the
    radius of an aluminium bar of that length and mass, at least 3 cm.

    Args:
        payload: The load.
        link: Number of the last link, n.
        radius: The true radius [m], where it is known.
    """
    if payload.is_empty:
        return None
    com = np.array(payload.com)
    length = 2.0 * float(np.linalg.norm(com))
    sized = max(_bar_radius(payload.mass, length), PAYLOAD_RADIUS_MIN)
    x, y, z = (float(2.0 * c) for c in com)
    return Capsule(link, (0.0, 0.0, 0.0), (x, y, z), sized if radius is None else radius)


PAYLOAD_DENSITY = 2700.0
"""kg/m³, aluminium: real loads are mostly denser, so a body sized with it is rather too large."""


def _bar_radius(mass: float, length: float) -> float:
    """Radius [m] of a bar of that length, or of a ball where that is smaller."""
    volume = mass / PAYLOAD_DENSITY
    ball = float(np.cbrt(0.75 * volume / np.pi))
    return ball if length == 0.0 else min(ball, float(np.sqrt(volume / (np.pi * length))))


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle:
    """Something that stands around an arm.

    Attributes:
        name: For messages.
        shape: Its plane or box.
        bodies: Indices of the capsules that are checked against it.
    """

    name: str
    shape: Plane | Box
    bodies: IntArray


NEIGHBOURS = 1
"""Links so many joints apart are built into each other and never checked."""

FRAME_BLOCK = 1024
"""Samples per forward kinematics."""

PAIR_BLOCK = 64
"""Samples per evaluation of all pairs: the intermediate results stay in the L2 cache."""

BUILT_TOGETHER_M = 0.03
"""Bodies that no position brings further apart than this are not checked: the foot of the upper
arm beside the base, the shoulder above the table that the base stands on."""

NEXT_BUT_ONE = 2
"""Links this many joints apart: their distance depends on two joints, so all positions are
sampled."""


class CollisionModel:
    """Distances of an arm to itself and to its environment.

    Checked: all pairs of non-neighbouring links, and moving links against table, walls and boxes.
    Not checked: pairs two joints apart that cannot touch in any position, or that are never more
    than `BUILT_TOGETHER_M` apart.

    Args:
        arm: The arm with its capsules.
        environment: What stands around it, in the base frame; nothing by default.
        payload: Body of the load, in the flange frame: its `link` is the last one.

    Attributes:
        arm: The arm.
        capsules: Its bodies, then that of the load.
        obstacles: What stands around it.
        pairs: (P, 2) indices of the capsules that are checked against each other.
        names: (R,) the two bodies of each distance: the pairs, then every capsule and
            what stands around it.
        reach: (R, n) metres that a distance can change per radian of each joint, at most.

    Raises:
        SpecError: The arm has no capsules.
    """

    def __init__(
        self,
        arm: ArmDescription,
        environment: Environment | None = None,
        payload: Capsule | None = None,
    ) -> None:
        if not arm.capsules:
            raise SpecError(
                f"the arm {arm.name} has no collision capsules", hint="add them to its description"
            )
        self.arm = arm
        self.capsules = (*arm.capsules, *(() if payload is None else (payload,)))
        names = [arm.link_names[capsule.link] for capsule in arm.capsules] + ["payload"]
        links = np.array([capsule.link for capsule in self.capsules])
        self._chain = CapsuleChain(arm, self.capsules)
        self._radii = np.array([capsule.radius for capsule in self.capsules])[:, None]
        self.pairs = np.argwhere(links[None, :] - links[:, None] > NEIGHBOURS)
        self.pairs = self.pairs[self._can_touch(arm, links)]
        self.obstacles = self._obstacles_of(environment or Environment(), arm, links)
        # One row per pair of capsules, then one per capsule and obstacle.
        near = [(obstacle.name, body) for obstacle in self.obstacles for body in obstacle.bodies]
        self.names: list[tuple[str, str]] = [(names[i], names[j]) for i, j in self.pairs]
        self.names += [(names[body], name) for name, body in near]
        reach = [self._chain.reach(links[i], j) for i, j in self.pairs]
        reach += [self._chain.reach(0, body) for _, body in near]
        self.reach = np.array(reach).reshape(-1, arm.n_joints)

    def clearance(self, q: FloatArray) -> FloatArray:
        """(N,) smallest distance [m] over everything checked, for `q` (N, n); negative inside."""
        return np.asarray(self.distances(q).min(axis=0, initial=np.inf))

    def clearances(self, paths: Sequence[FloatArray], enough: float | None = None) -> FloatArray:
        """(len(paths),) smallest clearance [m] over all samples (N, n) of each path.

        With `enough` [m] any one of a path's clearances, below `enough` if there is such a one.
        """
        return smallest_along_paths(paths, self.distances, self.reach, enough)[0]

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """The smallest distance [m] at `q` (n,) and its two bodies; inf if nothing is checked."""
        distances = self.distances(np.atleast_2d(q))[:, 0]
        if len(distances) == 0:
            return np.inf, ("", "")
        row = int(distances.argmin())
        return float(distances[row]), self.names[row]

    def copy_for_thread(self) -> CollisionModel:
        """Return self: there is no scratch memory to share between threads."""
        return self

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distance of every pair and obstacle at every sample [m], for `q` (N, n)."""
        out = np.empty((len(self.names), len(q)))
        for start in range(0, len(q), FRAME_BLOCK):
            block = slice(start, start + FRAME_BLOCK)
            p, u = self._chain.axes(q[block])
            gaps = [self._gaps(obstacle, p, u) for obstacle in self.obstacles]
            np.concatenate([self._pair_distances(p, u), *gaps], out=out[:, block])
        return out

    def _pair_distances(self, p: FloatArray, u: FloatArray) -> FloatArray:
        i, j = self.pairs.T
        out = np.empty((len(i), p.shape[2]))
        for start in range(0, p.shape[2], PAIR_BLOCK):
            some = slice(start, start + PAIR_BLOCK)
            a, v = p[:, :, some], u[:, :, some]
            first, second = (a.take(i, 1), v.take(i, 1)), (a.take(j, 1), v.take(j, 1))
            out[:, some] = segment_distance(*first, *second)
        out -= self._radii[i] + self._radii[j]
        return out

    def _gaps(self, obstacle: Obstacle, p: FloatArray, u: FloatArray) -> FloatArray:
        bodies, shape = obstacle.bodies, obstacle.shape
        axes = p[:, bodies], u[:, bodies]
        if isinstance(shape, Plane):
            gap = plane_distance(*axes, np.array(shape.point), shape.unit_normal)
        else:
            gap = box_distance(*axes, *shape.corners)
        return np.asarray(gap - self._radii[bodies])

    def _can_touch(self, arm: ArmDescription, links: IntArray) -> BoolArray:
        """(P,) which pairs to check: all, except pairs two joints apart that never or always touch.

        A pair that is apart at every position tried is apart everywhere, if it is so by more than
        it can move in half a step.
        """
        q, half_step = _every_two_joints(arm)
        distances = self._pair_distances(*self._chain.axes(q))
        reach = [self._chain.reach(links[i], j) @ half_step for i, j in self.pairs]
        never = distances.min(axis=1) > np.array(reach)
        always = distances.max(axis=1) <= BUILT_TOGETHER_M
        first, second = links[self.pairs.T]
        return np.asarray((second - first > NEXT_BUT_ONE) | ~(never | always))

    def _obstacles_of(
        self, environment: Environment, arm: ArmDescription, links: IntArray
    ) -> list[Obstacle]:
        moving = np.flatnonzero(links > 0)
        shapes: list[Plane | Box] = [*environment.walls, *environment.boxes]
        obstacles = [Obstacle(shape.name, shape, moving) for shape in shapes]
        if environment.table is not None:
            table = Obstacle("table", environment.table, moving)
            highest = self._gaps(table, *self._chain.axes(_every_two_joints(arm)[0])).max(axis=1)
            above_table = moving[highest > BUILT_TOGETHER_M]
            obstacles.append(Obstacle("table", environment.table, above_table))
        return obstacles


GRID = 96
"""Grid points per joint for finding pairs that never or always touch."""


def _every_two_joints(arm: ArmDescription) -> tuple[FloatArray, FloatArray]:
    """Positions (GRID², n) that try all combinations of any two joints in a row.

    Also returned is half the step between them, (n,).
    """
    low, high = np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 1.0, GRID)]), axis=-1).reshape(-1, 2)
    turns = np.tile(grid, (1, arm.n_joints // 2 + 1))[:, : arm.n_joints]
    return low + turns * (high - low), 0.5 * (high - low) / (GRID - 1)


class FlangeSpace:
    """Signed distances of points at the flange to planes, negative behind one.

    Args:
        arm: The arm.
        faces: The planes it must stay in front of, in the base frame.
        tip_m: How far the tip of a payload is out along the flange axis; 0 for none.

    Attributes:
        names: (R,) point and plane of each distance.
        reach: (R, n) metres that a distance can change per radian of each joint, at most.
    """

    def __init__(self, arm: ArmDescription, faces: Sequence[Plane], tip_m: float = 0.0) -> None:
        at = {"flange": 0.0} | ({"payload": tip_m} if tip_m else {})
        points = [Capsule(arm.n_joints, (0.0, 0.0, z), (0.0, 0.0, z), 0.0) for z in at.values()]
        self._chain = CapsuleChain(arm, points)
        self._faces = tuple(faces)
        self.names = [(point, face.name) for face in faces for point in at]
        reach = [self._chain.reach(0, point) for point in range(len(points))]
        self.reach = np.array(len(faces) * reach).reshape(-1, arm.n_joints)

    def copy_for_thread(self) -> FlangeSpace:
        """Return self: there is no scratch memory to share between threads."""
        return self

    def distances(self, q: FloatArray) -> FloatArray:
        """(R, N) distances [m] at `q` (N, n)."""
        axes = self._chain.axes(q)
        gaps = [plane_distance(*axes, np.array(f.point), f.unit_normal) for f in self._faces]
        return np.concatenate(gaps)


class CapsuleChain:
    """The axes of capsules that move with the links of a DH arm.

    Args:
        arm: The arm.
        capsules: Bodies in their links' frames; link 0 is the base.
    """

    def __init__(self, arm: ArmDescription, capsules: Sequence[Capsule]) -> None:
        self._dh = arm.dh
        self._capsules = tuple(capsules)
        self._of_link = [
            np.flatnonzero([capsule.link == link for capsule in capsules])
            for link in range(arm.n_joints + 1)
        ]
        self._local = [
            np.array([_ends(c) for c in capsules if c.link == link]).reshape(-1, 4)
            for link in range(arm.n_joints + 1)
        ]

    def axes(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Starts and directions of all axes in the base frame, each (3, C, N), for `q` (N, n)."""
        out = np.empty((2, 3, len(self._capsules), len(q)))
        # Columns x, y, z and origin of the current link's frame: (3, 4, N).
        frame = np.zeros((3, 4, len(q)))
        frame[[0, 1, 2], [0, 1, 2]] = 1.0
        self._place(out, 0, frame)
        for link, (a, alpha, d, theta) in enumerate(self._dh, 1):
            frame = _next_frame(frame, a, alpha, d, q[:, link - 1] + theta)
            self._place(out, link, frame)
        return out[0], out[1]

    def reach(self, fixed: int, body: int) -> FloatArray:
        """(n,) how far [m] the axis of the capsule number `body` can be from each joint axis.

        Seen from link `fixed`: joints that do not move the capsule against that link have 0.
        """
        capsule = self._capsules[body]
        tip = max(float(np.linalg.norm(end)) for end in (capsule.a, capsule.b))
        out = np.zeros(len(self._dh))
        for joint in range(capsule.link - 1, fixed - 1, -1):
            a, _, d, _ = self._dh[joint]
            # d lies along the joint's own axis, so it counts from the next joint inwards only.
            out[joint] = abs(a) + tip
            tip += float(np.hypot(a, d))
        return out

    def _place(self, out: FloatArray, link: int, frame: FloatArray) -> None:
        of_link = self._of_link[link]
        if len(of_link):
            ends = np.matmul(self._local[link], frame)
            out[:, :, of_link] = ends.reshape(3, len(of_link), 2, ends.shape[-1]).transpose(
                2, 0, 1, 3
            )


def _ends(capsule: Capsule) -> FloatArray:
    """(2, 4) start as a point and direction as a vector."""
    a, b = np.array(capsule.a, dtype=np.float64), np.array(capsule.b, dtype=np.float64)
    return np.array([[*a, 1.0], [*(b - a), 0.0]])


def _next_frame(
    frame: FloatArray, a: float, alpha: float, d: float, angle: FloatArray
) -> FloatArray:
    """Standard DH: turn about z, shift along z and the new x, turn about the new x."""
    x, y, z, origin = frame.transpose(1, 0, 2)
    c, s = np.cos(angle), np.sin(angle)
    x, y = c * x + s * y, c * y - s * x
    out = np.empty_like(frame)
    out[:, 0] = x
    out[:, 1] = np.cos(alpha) * y + np.sin(alpha) * z
    out[:, 2] = np.cos(alpha) * z - np.sin(alpha) * y
    out[:, 3] = origin + d * z + a * x
    return out


TINY = 1e-18
"""Stands for a squared length of zero, so that a sphere is a segment whose ends coincide."""


def segment_distance(p: FloatArray, u: FloatArray, q: FloatArray, v: FloatArray) -> FloatArray:
    """Distance of the segments p + s u and q + t v, 0 ≤ s, t ≤ 1.

    Closest points of the lines, clamped to one segment, then to the other, then back (Ericson,
    Real-Time Collision Detection, 2005, section 5.1.9).

    Args:
        p: (3, P, N) start of the first segment [m].
        u: (3, P, N) from its start to its end [m].
        q: (3, P, N) start of the second segment [m].
        v: (3, P, N) from its start to its end [m].

    Returns:
        (P, N) [m].
    """
    r = p - q
    uu, vv, uv = dot(u, u) + TINY, dot(v, v) + TINY, dot(u, v)
    ur, vr = dot(u, r), dot(v, r)
    s = uv * vr
    s -= ur * vv
    s /= uu * vv - uv * uv + TINY * TINY
    t = uv * _clamp(s)
    t += vr
    t /= vv
    s = uv * _clamp(t)
    s -= ur
    s /= uu
    r += _clamp(s) * u
    r -= t * v
    return np.sqrt(dot(r, r))


def _clamp(x: FloatArray) -> FloatArray:
    np.maximum(x, 0.0, out=x)
    return np.minimum(x, 1.0, out=x)


def plane_distance(
    p: FloatArray, u: FloatArray, point: FloatArray, normal: FloatArray
) -> FloatArray:
    """(P, N) signed distance [m] of the segments p + s u to a plane; normal (3,) of length 1."""
    start = np.tensordot(normal, p, axes=1) - normal @ point
    return np.asarray(start + np.minimum(np.tensordot(normal, u, axes=1), 0.0))


BISECTIONS = 20
"""What is left of a segment 1 m long is a micrometre."""


def box_distance(p: FloatArray, u: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """(P, N) distance [m] of the segments p + s u to a box along the axes; 0 inside.

    The squared distance is convex in s: bisection on the sign of its derivative.
    """
    s_low, s_high = np.zeros(p.shape[1:]), np.ones(p.shape[1:])
    for _ in range(BISECTIONS):
        s = 0.5 * (s_low + s_high)
        rising = dot(_outside(p + s * u, low, high), u) > 0
        s_high = np.where(rising, s, s_high)
        s_low = np.where(rising, s_low, s)
    gap = _outside(p + s_high * u, low, high)
    return np.sqrt(dot(gap, gap))


def _outside(x: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Vector from the nearest point of the box to x."""
    return np.asarray(x - np.clip(x, low[:, None, None], high[:, None, None]))


def dot(x: FloatArray, y: FloatArray) -> FloatArray:
    """(P, N) scalar products."""
    return np.asarray(np.einsum("kpn,kpn->pn", x, y))


STRIDE = 16
"""Coarse step of the search [samples]."""

TIE_M = 1e-9
"""Improvements smaller than this are ignored [m]."""


def smallest_along_paths(
    paths: Sequence[FloatArray],
    distances: Callable[[FloatArray], FloatArray],
    reach: FloatArray,
    enough: float | None = None,
) -> tuple[FloatArray, IntArray]:
    """The smallest of all distances over all samples of each path, and the index of its sample.

    Between samples a and b that were computed, a distance cannot fall below (d_a + d_b − s) / 2,
    where s is how far its two bodies can have moved against each other: Σ |Δq| times the reach
    beyond each joint. Where that is not below the smallest distance found so far on the path, the
    samples between are skipped; elsewhere the one in the middle is computed next.

    Args:
        paths: (N, n) positions each, N ≥ 1.
        distances: Gives (R, N) distances [m] for any positions (N, n).
        reach: (R, n) metres that a distance can change per radian of each joint.
        enough: Asks only whether each path keeps this distance [m]: found is any one of its
            distances then, and one below `enough` if there is one.

    Returns:
        Each (P,): distances [m], and samples counted from the beginning of each path.

    Raises:
        DataError: A path has no samples, or its positions are not finite.
    """
    if any(len(q) == 0 or not np.isfinite(q).all() for q in paths):
        raise DataError(
            "a path without samples, or with positions that are not finite, has no clearance",
            hint="check the positions of the path",
        )
    q = np.concatenate(paths)
    lengths = np.array([len(path) for path in paths])
    begins, path = np.cumsum(lengths) - lengths, np.repeat(np.arange(len(paths)), lengths)
    turned = np.vstack([np.zeros(q.shape[1]), np.abs(np.diff(q, axis=0)).cumsum(axis=0)])
    within = np.arange(len(q)) - begins[path]
    at = np.flatnonzero((within % STRIDE == 0) | (within == lengths[path] - 1))
    found = distances(q[at])
    nearest = np.full(len(q), np.inf)
    left, right = at[:-1], at[1:]
    d_left, d_right = found[:, :-1], found[:, 1:]
    while True:
        nearest[at] = found.min(axis=0, initial=np.inf)
        least = np.minimum.reduceat(nearest, begins)
        moved = reach @ (turned[right] - turned[left]).T
        bound = 0.5 * (d_left + d_right - moved).min(axis=0, initial=np.inf)
        unknown = right - left > 1
        sought = least - TIE_M if enough is None else np.where(least < enough, -np.inf, enough)
        doubtful = np.flatnonzero(unknown & (bound < sought[path[left]]))
        if len(doubtful) == 0:
            break
        if len(doubtful) > len(q) // 8:  # a distance that never changes: skipping does not pay
            rest = np.flatnonzero(np.isinf(nearest))
            for some in np.array_split(rest, 1 + len(rest) // FRAME_BLOCK):
                nearest[some] = distances(q[some]).min(axis=0, initial=np.inf)
            break
        left, right = left[doubtful], right[doubtful]
        at = (left + right) // 2
        found = distances(q[at])
        d_left = np.hstack([d_left[:, doubtful], found])
        d_right = np.hstack([found, d_right[:, doubtful]])
        left, right = np.append(left, at), np.append(at, right)
    samples = np.array([int(some.argmin()) for some in np.split(nearest, begins[1:])])
    return nearest[begins + samples], samples
