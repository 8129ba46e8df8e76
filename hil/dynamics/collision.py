"""How far an arm is from itself, its payload from it, and both from what stands around.

Bodies are capsules that move with the links. Distances are computed with numpy for blocks of
samples, which is faster than Pinocchio's `computeDistances` sample by sample (measured in
`benchmarks/collision.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hil.arms import ArmDescription, Capsule
from hil.dynamics.capsules import CapsuleChain
from hil.dynamics.distances import box_distance, plane_distance, segment_distance
from hil.dynamics.environment import TABLE, Box, Environment, Plane
from hil.errors import DataError, SpecError
from hil.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from hil.dynamics.robot_model import RobotModel

PAIR_BLOCK = 64
"""Samples per evaluation of all pairs: the intermediate results stay in the L2 cache."""

FRAME_BLOCK = 1024
"""Samples per forward kinematics."""

STRIDE = 16
"""Samples between those that a path search looks at first."""

NEIGHBOURS = 2
"""Links fewer than this many joints apart are built into each other and never checked."""

BUILT_TOGETHER_M = 0.03
"""Bodies that no position of the joints brings further apart than this are not checked either:
a wrist beside the next but one, the shoulder above the table that the base stands on."""

PROBES = 300
"""Random positions that tell which bodies are built together."""


@dataclass(frozen=True, slots=True, eq=False)
class _Obstacle:
    name: str
    shape: Plane | Box
    bodies: IntArray
    """Indices of the capsules that are checked against it."""


class CollisionModel:
    """Distances of an arm to itself and to its environment.

    Checked are the bodies of links that are not neighbours, and those of moving links against
    table, walls and boxes; not those that are built together (`BUILT_TOGETHER_M`).

    Args:
        arm: The arm with its capsules.
        environment: What stands around it, in the base frame; nothing by default.
        payload: Body of the load, in the flange frame: its `link` is the last one.

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
        capsules = (*arm.capsules, *(() if payload is None else (payload,)))
        names = [arm.link_names[capsule.link] for capsule in arm.capsules] + ["payload"]
        links = np.array([capsule.link for capsule in capsules])
        self._chain = CapsuleChain(arm, capsules)
        self._radii = np.array([capsule.radius for capsule in capsules])[:, None]
        self._first, self._second = _checked_pairs(links, arm.never_touch)
        self._obstacles = _obstacles(environment or Environment(), links)
        self._drop_built_together(arm)
        # One row per pair of capsules, then one per capsule and obstacle.
        pairs = list(zip(self._first, self._second, strict=True))
        near = [(o.name, body) for o in self._obstacles for body in o.bodies]
        self._names = [(names[i], names[j]) for i, j in pairs]
        self._names += [(names[body], name) for name, body in near]
        reach = [self._chain.reach(int(links[i]), capsules[j]) for i, j in pairs]
        reach += [self._chain.reach(0, capsules[body]) for _, body in near]
        self._reach = np.array(reach)

    @classmethod
    def for_model(
        cls,
        model: RobotModel,
        environment: Environment | None = None,
        payload: Capsule | None = None,
    ) -> CollisionModel:
        """The collision model of a built-in arm.

        Raises:
            SpecError: The model comes from a URDF, for which there are no capsules.
        """
        if model.arm is None:
            raise SpecError(
                f"collisions cannot be checked for {model.name}: it has no capsules",
                hint="use a built-in arm; `hil.arms` lists them",
            )
        return cls(model.arm, environment, payload)

    def clearance(self, q: FloatArray) -> FloatArray:
        """(N,) smallest distance [m] over everything checked, for `q` (N, n); negative inside."""
        return np.asarray(self._distances(q).min(axis=0))

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """The smallest distance [m] at `q` (n,) and between which two bodies."""
        distances = self._distances(np.atleast_2d(q))[:, 0]
        row = int(distances.argmin())
        return float(distances[row]), self._names[row]

    def path_clearance(self, q: FloatArray) -> tuple[float, int]:
        """The smallest distance [m] over all samples of a path `q` (N, n), and that sample's index.

        The same as the least of `clearance(q)`. Between samples a and b that were computed, a
        distance cannot fall below (d_a + d_b − s) / 2, where s is how far the two bodies can have
        moved against each other: Σ |Δq| times the reach beyond each joint. Where that is not below
        the smallest distance found so far, the samples between are skipped.

        Raises:
            DataError: The path has no samples.
        """
        if len(q) == 0:
            raise DataError("a path without samples has no clearance")
        turned = np.vstack([np.zeros(q.shape[1]), np.abs(np.diff(q, axis=0)).cumsum(axis=0)])
        at = np.unique(np.append(np.arange(0, len(q), STRIDE), len(q) - 1))
        rows = self._distances(q[at])
        best, where = _least(rows, at)
        left, right = at[:-1], at[1:]
        d_left, d_right = rows[:, :-1], rows[:, 1:]
        while True:
            moved = self._reach @ (turned[right] - turned[left]).T
            bound = 0.5 * (d_left + d_right - moved).min(axis=0)
            doubtful = np.flatnonzero((right - left > 1) & (bound < best))
            if len(doubtful) == 0:
                return best, where
            left, right = left[doubtful], right[doubtful]
            middle = (left + right) // 2
            rows = self._distances(q[middle])
            best, where = min((best, where), _least(rows, middle))
            d_left = np.hstack([d_left[:, doubtful], rows])
            d_right = np.hstack([rows, d_right[:, doubtful]])
            left, right = np.append(left, middle), np.append(middle, right)

    def _drop_built_together(self, arm: ArmDescription) -> None:
        low, high = np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi)
        q = np.random.default_rng(0).uniform(low, high, (PROBES, arm.n_joints))
        p, u = self._chain.axes(q)
        apart = self._pair_distances(p, u).max(axis=1) > BUILT_TOGETHER_M
        self._first, self._second = self._first[apart], self._second[apart]
        for i, obstacle in enumerate(self._obstacles):
            if obstacle.name == TABLE:
                apart = self._gaps(obstacle, p, u).max(axis=1) > BUILT_TOGETHER_M
                self._obstacles[i] = replace(obstacle, bodies=obstacle.bodies[apart])

    def _distances(self, q: FloatArray) -> FloatArray:
        """(rows, N) distance of every pair and obstacle at every sample [m]."""
        out = np.empty((len(self._names), len(q)))
        for start in range(0, len(q), FRAME_BLOCK):
            block = slice(start, start + FRAME_BLOCK)
            p, u = self._chain.axes(q[block])
            gaps = [self._gaps(obstacle, p, u) for obstacle in self._obstacles]
            np.concatenate([self._pair_distances(p, u), *gaps], out=out[:, block])
        return out

    def _pair_distances(self, p: FloatArray, u: FloatArray) -> FloatArray:
        i, j = self._first, self._second
        out = np.empty((len(i), p.shape[2]))
        for start in range(0, p.shape[2], PAIR_BLOCK):
            some = slice(start, start + PAIR_BLOCK)
            a, v = p[:, :, some], u[:, :, some]
            out[:, some] = segment_distance(a[:, i], v[:, i], a[:, j], v[:, j])
        out -= self._radii[i] + self._radii[j]
        return out

    def _gaps(self, obstacle: _Obstacle, p: FloatArray, u: FloatArray) -> FloatArray:
        bodies, shape = obstacle.bodies, obstacle.shape
        axes = p[:, bodies], u[:, bodies]
        if isinstance(shape, Plane):
            gap = plane_distance(*axes, np.array(shape.point), shape.unit_normal)
        else:
            gap = box_distance(*axes, *shape.corners)
        return gap - self._radii[bodies]


def _checked_pairs(
    links: IntArray, never_touch: tuple[tuple[int, int], ...]
) -> tuple[IntArray, IntArray]:
    checked = links[None, :] - links[:, None] >= NEIGHBOURS
    for low, high in never_touch:
        checked &= ~np.outer(links == low, links == high)
    first, second = np.nonzero(checked)
    return first, second


def _obstacles(environment: Environment, links: IntArray) -> list[_Obstacle]:
    moving = np.flatnonzero(links > 0)
    table = () if environment.table is None else (environment.table,)
    shapes = (*table, *environment.walls, *environment.boxes)
    return [_Obstacle(shape.name, shape, moving) for shape in shapes]


def _least(rows: FloatArray, at: IntArray) -> tuple[float, int]:
    least = rows.min(axis=0)
    return float(least.min()), int(at[least.argmin()])
