"""Signed distances of an arm to itself, to its payload and to its surroundings.

The bodies of the arm are capsules that move with the links. All distances are computed with numpy
for blocks of samples. With numpy the computation is as fast as Pinocchio's `computeDistances` for
single samples (2 to 3 µs for the 39 pairs of a UR5, `benchmarks/collision.py`). The computation
yields all distances at no extra cost, which allows the search along a path to skip most samples.

An `Environment` consists of planes and boxes around the arm. A `FlangeSpace` limits the space in
which the flange may move. The functions for distances use arrays of points with the shape (3, P,
N): coordinate, pair, sample. The coordinate is the first axis of the arrays, so that every
operation processes one contiguous block.
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
    """Plane that bounds the half-space in which the arm must stay.

    Attributes:
        point: Any point of the plane [m].
        normal: Normal vector of any length that points to the permitted side of the plane.
        name: Name of the plane in messages.
    """

    point: Vector
    normal: Vector
    name: str = "wall"

    @property
    def unit_normal(self) -> FloatArray:
        """Unit normal (3,)."""
        normal = np.array(self.normal, dtype=np.float64)
        return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, slots=True)
class Box:
    """Solid box whose edges are parallel to the axes of the base frame.

    Attributes:
        centre: Centre of the box [m].
        size: Full edge lengths of the box [m].
        name: Name of the box in messages.
    """

    centre: Vector
    size: Vector
    name: str = "box"

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest corner of the box, each (3,) [m]."""
        centre, half = np.array(self.centre, dtype=np.float64), 0.5 * np.array(self.size)
        return centre - half, centre + half


@dataclass(frozen=True, slots=True)
class Environment:
    """Obstacles around the arm.

    Attributes:
        table_z: Height of the table on which the base stands [m]; None if there is no table.
        walls: Planes in front of which the arm must stay.
        boxes: Boxes that the arm must not enter.
    """

    table_z: float | None = None
    walls: tuple[Plane, ...] = ()
    boxes: tuple[Box, ...] = ()

    @property
    def table(self) -> Plane | None:
        """Plane of the table top; None if there is no table."""
        if self.table_z is None:
            return None
        return Plane((0.0, 0.0, self.table_z), (0.0, 0.0, 1.0), "table")


PAYLOAD_RADIUS_MIN = 0.03
"""Minimum radius of a payload capsule [m]."""


def payload_capsule(payload: Payload, link: int, radius: float | None = None) -> Capsule | None:
    """Return a capsule for a load with known mass and centre of mass, or None without a load.

    The capsule of the load begins at the flange and extends through the centre of mass to twice
    that distance. If `radius` is None, the capsule has the radius of an aluminium bar of the same
    length and mass, but at least 3 cm.

    Args:
        payload: Payload.
        link: Number n of the last link.
        radius: True radius of the load [m] if it is known.
    """
    if payload.is_empty:
        return None
    com = np.array(payload.com)
    length = 2.0 * float(np.linalg.norm(com))
    sized = max(_bar_radius(payload.mass, length), PAYLOAD_RADIUS_MIN)
    x, y, z = (float(2.0 * c) for c in com)
    return Capsule(link, (0.0, 0.0, 0.0), (x, y, z), sized if radius is None else radius)


PAYLOAD_DENSITY = 2700.0
"""Density of aluminium [kg/m³]; most real loads are denser, so the payload capsule is usually too
large rather than too small.
"""


def _bar_radius(mass: float, length: float) -> float:
    """Return the radius [m] of a bar of this length and mass, or of a sphere if that is smaller."""
    volume = mass / PAYLOAD_DENSITY
    ball = float(np.cbrt(0.75 * volume / np.pi))
    return ball if length == 0.0 else min(ball, float(np.sqrt(volume / (np.pi * length))))


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle:
    """Plane or box near an arm, with the bodies that are checked against it.

    Attributes:
        name: Name of the obstacle in messages.
        shape: Plane or box that the obstacle consists of.
        bodies: Indices of the capsules that are checked against the obstacle.
    """

    name: str
    shape: Plane | Box
    bodies: IntArray


NEIGHBOURS = 1
"""Number of joints between links that are mounted to each other; the distance of such links is
never checked.
"""

FRAME_BLOCK = 1024
"""Number of samples per call of the forward kinematics."""

PAIR_BLOCK = 64
"""Number of samples per evaluation of all pairs, small enough for intermediate results to fit into
the L2 cache.
"""

BUILT_TOGETHER_M = 0.03
"""Distance [m] that two bodies must exceed in some position for their pair to be checked.

Bodies that are always closer than this distance are built together, such as the lower end of the
upper arm and the base, or the shoulder and the table on which the base stands.
"""

NEXT_BUT_ONE = 2
"""Number of joints between two links up to which all positions are sampled.

The distance of links with two joints between them depends on these two joints only.
"""


class CollisionModel:
    """Distances of an arm to itself, to its payload and to its environment.

    All pairs of non-neighbouring links are checked, as well as each moving link against table,
    walls and boxes. A pair of links with two joints between them is not checked if the links cannot
    touch in any position, or if their distance never exceeds `BUILT_TOGETHER_M`.

    Args:
        arm: Arm description that contains capsules.
        environment: Obstacles in the base frame; None for no obstacles.
        payload: Capsule of the load in the flange frame; its `link` is the number of the last link.

    Attributes:
        arm: Arm description.
        capsules: Capsules of the arm, followed by the capsule of the load if there is a load.
        obstacles: Obstacles, each with the bodies that are checked against it.
        pairs: (P, 2) indices of the capsules that are checked against each other.
        names: Names of the two bodies of each of the R distances: first the pairs of capsules, then
            each capsule with each obstacle.
        reach: (R, n) upper limit of the change of each distance per radian of each joint [m/rad].

    Raises:
        SpecError: The arm description contains no capsules.
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
        """Return the smallest distance (N,) [m] at `q` (N, n); negative values mean penetration."""
        return np.asarray(self.distances(q).min(axis=0, initial=np.inf))

    def clearances(self, paths: Sequence[FloatArray], enough: float | None = None) -> FloatArray:
        """Return the smallest distance [m] of each path over all samples (N, n) of the path.

        Args:
            paths: Joint positions (N, n) of each path.
            enough: Required clearance [m]. If `enough` is passed, the returned distance of a path
                may be any one of its distances; it is below `enough` if any distance of the path is
                below `enough`.
        """
        return smallest_along_paths(paths, self.distances, self.reach, enough)[0]

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """Return the smallest distance [m] at `q` (n,) and the names of the two bodies.

        The distance is infinite if no pair of bodies is checked.
        """
        distances = self.distances(np.atleast_2d(q))[:, 0]
        if len(distances) == 0:
            return np.inf, ("", "")
        row = int(distances.argmin())
        return float(distances[row]), self.names[row]

    def copy_for_thread(self) -> CollisionModel:
        """Return the same object, because the model has no scratch memory."""
        return self

    def distances(self, q: FloatArray) -> FloatArray:
        """Return the distances (R, N) [m] of all pairs and obstacles at `q` (N, n)."""
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
        """Return a mask (P,) that is true for the pairs of capsules to check.

        A pair with two joints between its links is excluded if the links never or always touch. The
        links of a pair never touch if their distance at every sampled position exceeds their
        largest relative motion in half a grid step.
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
"""Number of grid points per joint in the search for pairs of bodies that never or always touch."""


def _every_two_joints(arm: ArmDescription) -> tuple[FloatArray, FloatArray]:
    """Return joint positions (GRID², n) with all combinations of any two consecutive joints.

    Returns:
        Pair of the positions (GRID², n) and half the grid step (n,) [rad].
    """
    low, high = np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 1.0, GRID)]), axis=-1).reshape(-1, 2)
    turns = np.tile(grid, (1, arm.n_joints // 2 + 1))[:, : arm.n_joints]
    return low + turns * (high - low), 0.5 * (high - low) / (GRID - 1)


class FlangeSpace:
    """Signed distances of points at the flange to planes; a distance is negative behind its plane.

    Args:
        arm: Arm description.
        faces: Planes in the base frame, in front of which the points of the flange must stay.
        tip_m: Distance of the payload tip from the flange along the flange axis [m]; 0 if there is
            no tip.

    Attributes:
        names: Name of the point and name of the plane of each of the R distances.
        reach: (R, n) upper limit of the change of each distance per radian of each joint [m/rad].
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
        """Return the same object, because a flange space has no scratch memory."""
        return self

    def distances(self, q: FloatArray) -> FloatArray:
        """Return the distances (R, N) [m] of the points to the faces at `q` (N, n)."""
        axes = self._chain.axes(q)
        gaps = [plane_distance(*axes, np.array(f.point), f.unit_normal) for f in self._faces]
        return np.concatenate(gaps)


class CapsuleChain:
    """Axes of capsules that move with the links of a DH arm.

    Args:
        arm: Arm description.
        capsules: Capsules in the frames of their links; link 0 is the base of the arm.
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
        """Return the starts and directions of all capsule axes, each (3, C, N), at `q` (N, n).

        Starts and directions of the axes are expressed in the base frame.
        """
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
        """Return the largest distance (n,) [m] of the axis of capsule `body` from each joint axis.

        The distance is 0 for joints that do not move the capsule relative to link `fixed`.
        """
        capsule = self._capsules[body]
        tip = max(float(np.linalg.norm(end)) for end in (capsule.a, capsule.b))
        out = np.zeros(len(self._dh))
        for joint in range(capsule.link - 1, fixed - 1, -1):
            a, _, d, _ = self._dh[joint]
            # d lies along the joint's own axis, so it only counts for joints further inwards.
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
    """Return a capsule axis (2, 4): start as homogeneous point, direction as homogeneous vector."""
    a, b = np.array(capsule.a, dtype=np.float64), np.array(capsule.b, dtype=np.float64)
    return np.array([[*a, 1.0], [*(b - a), 0.0]])


def _next_frame(
    frame: FloatArray, a: float, alpha: float, d: float, angle: FloatArray
) -> FloatArray:
    """Return the next standard DH frame: rotation and shift along z, then along the new x axis."""
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
"""Small squared length that replaces zero in divisions, so a sphere is treated as a segment with
coinciding ends.
"""


def segment_distance(p: FloatArray, u: FloatArray, q: FloatArray, v: FloatArray) -> FloatArray:
    """Return the distances of the segments p + s u and q + t v with 0 ≤ s, t ≤ 1.

    The parameters of the closest points are clamped to the first segment, then to the second, then
    again to the first (Ericson, Real-Time Collision Detection, 2005, section 5.1.9).

    Args:
        p: (3, P, N) start of the first segment [m].
        u: (3, P, N) vector from the start to the end of the first segment [m].
        q: (3, P, N) start of the second segment [m].
        v: (3, P, N) vector from the start to the end of the second segment [m].

    Returns:
        Distances (P, N) [m].
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
    """Return the signed distances (P, N) [m] of the segments p + s u to a plane.

    The normal (3,) of the plane must have length 1.
    """
    start = np.tensordot(normal, p, axes=1) - normal @ point
    return np.asarray(start + np.minimum(np.tensordot(normal, u, axes=1), 0.0))


BISECTIONS = 20
"""Number of bisections in the search for a minimum; they reduce an interval of 1 m to one
micrometre.
"""


def box_distance(p: FloatArray, u: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the distances (P, N) [m] of the segments p + s u to a box; 0 inside the box.

    The edges of the box are parallel to the axes of the frame. The squared distance to the box is
    convex in s, so bisection on the sign of its derivative finds the minimum.
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
    """Return the vector from the nearest point of the box to the point x."""
    return np.asarray(x - np.clip(x, low[:, None, None], high[:, None, None]))


def dot(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the scalar products (P, N) of two arrays of vectors."""
    return np.asarray(np.einsum("kpn,kpn->pn", x, y))


STRIDE = 16
"""Distance of the samples that are evaluated first in the search along a path [samples]."""

TIE_M = 1e-9
"""Improvement of a distance [m] below which the improvement is ignored."""


def smallest_along_paths(
    paths: Sequence[FloatArray],
    distances: Callable[[FloatArray], FloatArray],
    reach: FloatArray,
    enough: float | None = None,
) -> tuple[FloatArray, IntArray]:
    """Return the smallest of all distances over the samples of each path, and its sample index.

    Between two evaluated samples a and b, a distance cannot be less than (d_a + d_b − s) / 2. In
    the lower bound, s is the upper limit of the relative motion of the two bodies: Σ |Δq| times the
    reach of each joint. If the lower bound is not below the smallest distance found so far on the
    path, the samples between a and b are skipped; otherwise the middle sample is evaluated next.

    Args:
        paths: Joint positions (N, n) of each path, N ≥ 1.
        distances: Function that returns the distances (R, N) [m] at joint positions (N, n).
        reach: (R, n) upper limit of the change of each distance per radian of each joint [m/rad].
        enough: Required distance [m]. If `enough` is passed, the search along a path stops as soon
            as it is known whether the path keeps this distance. With `enough`, the returned
            distance of a path may be any one of its distances; it is below `enough` if any distance
            of the path is below `enough`.

    Returns:
        Distances [m] and sample indices within each path, two arrays (P,).

    Raises:
        DataError: A path has no samples, or its joint positions are not finite.
    """
    if any(len(q) == 0 or not np.isfinite(q).all() for q in paths):
        raise DataError(
            "the path has no samples, or positions that are not finite",
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
        if len(doubtful) > len(q) // 8:  # skipping saves nothing, as for a constant distance
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
