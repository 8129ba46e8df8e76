"""How far an arm is from itself, its payload from it, and both from what stands around.

Bodies are capsules that move with the links. Distances are computed with numpy for blocks of
samples, which is as fast as Pinocchio's `computeDistances` sample by sample (3 µs for the UR5's
39 pairs, `benchmarks/collision.py`), and yields all distances at no extra cost: that is what lets
the search along a path skip most samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hil.arms import ArmDescription, Capsule
from hil.core import BoolArray, DataError, FloatArray, IntArray, SpecError
from hil.dynamics.capsules import CapsuleChain
from hil.dynamics.distances import box_distance, plane_distance, segment_distance
from hil.dynamics.environment import Box, Environment, Plane
from hil.dynamics.path_search import least_along

if TYPE_CHECKING:
    from hil.dynamics.robot_model import RobotModel

PAIR_BLOCK = 64
"""Samples per evaluation of all pairs: the intermediate results stay in the L2 cache."""

FRAME_BLOCK = 1024
"""Samples per forward kinematics."""

NEIGHBOURS = 1
"""Links so many joints apart are built into each other and never checked."""

NEXT_BUT_ONE = 2
"""Between links so many joints apart, distances depend on two joints: all positions are tried."""

BUILT_TOGETHER_M = 0.03
"""Bodies that no position brings further apart than this are not checked: the foot of the upper
arm beside the base, the shoulder above the table that the base stands on."""

GRID = 96
"""Positions per joint that are tried to find such bodies."""


@dataclass(frozen=True, slots=True, eq=False)
class Obstacle:
    """Something that stands around an arm.

    Attributes:
        name: For messages.
        shape: Where it is.
        bodies: Indices of the capsules that are checked against it.
    """

    name: str
    shape: Plane | Box
    bodies: IntArray


class CollisionModel:
    """Distances of an arm to itself and to its environment.

    Checked are the bodies of links that are not neighbours, and those of moving links against
    table, walls and boxes. Left out are bodies next but one to each other that cannot touch in any
    position or are always close together: no margin between them could be asked for.

    Args:
        arm: The arm with its capsules.
        environment: What stands around it, in the base frame; nothing by default.
        payload: Body of the load, in the flange frame: its `link` is the last one.

    Attributes:
        arm: The arm.
        capsules: Its bodies, then that of the load.
        obstacles: What stands around it.
        pairs: (P, 2) indices of the capsules that are checked against each other.
        names: (R,) between which two bodies each distance is: the pairs, then every capsule and
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
        self.obstacles = self._around(environment or Environment(), arm, links)
        # One row per pair of capsules, then one per capsule and obstacle.
        near = [(obstacle.name, body) for obstacle in self.obstacles for body in obstacle.bodies]
        self.names: list[tuple[str, str]] = [(names[i], names[j]) for i, j in self.pairs]
        self.names += [(names[body], name) for name, body in near]
        reach = [self._chain.reach(links[i], j) for i, j in self.pairs]
        reach += [self._chain.reach(0, body) for _, body in near]
        self.reach = np.array(reach).reshape(-1, arm.n_joints)

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
        return np.asarray(self.distances(q).min(axis=0, initial=np.inf))

    def closest(self, q: FloatArray) -> tuple[float, tuple[str, str]]:
        """The smallest distance [m] at `q` (n,) and between which two bodies."""
        distances = self.distances(np.atleast_2d(q))[:, 0]
        row = int(distances.argmin())
        return float(distances[row]), self.names[row]

    def path_clearance(self, q: FloatArray) -> tuple[float, int]:
        """The smallest distance [m] over all samples of a path `q` (N, n), and that sample's index.

        The same as the least of `clearance(q)`, to a nanometre; samples that are proven to be
        clear by more than it are not computed (`hil.dynamics.path_search`).

        Raises:
            DataError: The path has no samples.
        """
        if len(q) == 0:
            raise DataError("a path without samples has no clearance")
        return least_along(q, self.distances, self.reach)

    def own(self) -> CollisionModel:
        """The same: it keeps nothing from one call to the next."""
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
            out[:, some] = segment_distance(a[:, i], v[:, i], a[:, j], v[:, j])
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
        """(P,) whether a pair needs checking: all but those next but one that are built together.

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

    def _around(
        self, environment: Environment, arm: ArmDescription, links: IntArray
    ) -> list[Obstacle]:
        moving = np.flatnonzero(links > 0)
        shapes: list[Plane | Box] = [*environment.walls, *environment.boxes]
        obstacles = [Obstacle(shape.name, shape, moving) for shape in shapes]
        if environment.table is not None:
            table = Obstacle("table", environment.table, moving)
            highest = self._gaps(table, *self._chain.axes(_every_two_joints(arm)[0])).max(axis=1)
            off_it = moving[highest > BUILT_TOGETHER_M]
            obstacles.append(Obstacle("table", environment.table, off_it))
        return obstacles


def _every_two_joints(arm: ArmDescription) -> tuple[FloatArray, FloatArray]:
    """Positions (GRID², n) that try all combinations of any two joints in a row.

    Also returned is half the step between them, (n,).
    """
    low, high = np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi)
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0.0, 1.0, GRID)]), axis=-1).reshape(-1, 2)
    turns = np.tile(grid, (1, arm.n_joints // 2 + 1))[:, : arm.n_joints]
    return low + turns * (high - low), 0.5 * (high - low) / (GRID - 1)
