"""Clear paths between poses: straight lines, or polylines over well-spread intermediate poses.

Joint space may consist of several regions that no motion within the joint ranges connects, for
example if a wrist cannot turn past the forearm. The roadmap uses the largest region of joint space,
or the region that contains most of the poses that a program must reach. The roadmap is lazy (Bohlin
and Kavraki 2000): a path is first searched over connections that are clear at a few samples. The
connections of the path found are then checked at every sample, and the search is repeated without
the blocked connections.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np

from hil.core import BoolArray, FloatArray, IntArray, PlanError
from hil.excitation.motion import STANDSTILL_RAD, Line
from hil.excitation.workspace import Workspace

STOP_COST_RAD = 0.5
"""Cost of each additional stop on a path, expressed as a joint angle [rad] of the joint with the
longest path.
"""

NEAREST = 4
"""Number of nearest roadmap poses to which the roadmap tries to connect a pose."""


class Roadmap:
    """Clear paths through a workspace, computed by a lazy roadmap.

    Args:
        workspace: Workspace in which the paths must be clear.
        poses: (M, n) clear, well-spread poses for the paths to use as intermediate poses.
        wanted: (k, n) clear poses that must be reached. The `wanted` poses also serve as
            intermediate poses of the paths. The connected region that contains most of the `wanted`
            poses is chosen.
        start: (n,) current position of the robot. If several regions contain equally many `wanted`
            poses, the largest region that a straight line from `start` reaches is chosen.

    Attributes:
        poses: (m, n) poses of the chosen region; without `wanted` and `start`, the largest region
            is chosen.
        home: (n,) pose of the chosen region with the largest distance from obstacles.

    Raises:
        PlanError: No two of the poses are connected.
    """

    def __init__(
        self,
        workspace: Workspace,
        poses: FloatArray,
        *,
        wanted: FloatArray | None = None,
        start: FloatArray | None = None,
    ) -> None:
        self.workspace = workspace
        drawn = len(poses)
        if wanted is not None:
            poses = np.vstack([poses, wanted])
        look_clear = self._seen_from_each_other(poses)
        regions = self._regions(poses, look_clear)
        most = max(_count_from(region, drawn) for region in regions)
        # The stable sort makes the choice between equally large regions depend on the poses only.
        regions = sorted(
            (region for region in regions if _count_from(region, drawn) == most),
            key=len,
            reverse=True,
        )
        region = regions[0]
        if len(region) < 2 and not most:
            raise _unconnected(workspace, poses)
        if start is not None and len(regions) > 1:
            reached = (one for one in regions if self._leads_to(start, poses[one]))
            region = next(reached, region)
        self.poses = poses[region]
        self._open = look_clear[np.ix_(region, region)]
        self.home: FloatArray = self.poses[int(workspace.room(self.poses).argmax())]

    def seem_connected(self, q: FloatArray) -> BoolArray:
        """Return for each of `q` (N, n) whether straight lines to near poses look clear; (N,)."""
        distance = np.abs(q[:, None] - self.poses[None]).max(axis=2)
        near = np.argsort(distance, axis=1, kind="stable")[:, :NEAREST]
        starts = np.repeat(q, near.shape[1], axis=0)
        looks = self.workspace.look_clear(starts, self.poses[near.ravel()])
        return np.asarray(looks.reshape(near.shape).any(axis=1))

    def straight_to(self, q: FloatArray) -> Line:
        """Return the straight line to `q` (n,) from the nearest pose of the roadmap."""
        nearest = int(np.abs(self.poses - q).max(axis=1).argmin())
        return self.workspace.line(self.poses[nearest], q)

    def way(self, start: FloatArray, goal: FloatArray) -> list[Line] | None:
        """Return clear lines from `start` to `goal`, or None if there is no clear path.

        The returned list of lines is empty if `start` and `goal` are the same position.
        """
        if np.max(np.abs(goal - start)) < STANDSTILL_RAD:
            return []
        straight = self.workspace.line(start, goal)
        if self.workspace.first_clear([straight]) == 0:
            return [straight]
        nodes = np.vstack([self.poses, start, goal])
        n = len(self.poses)
        open_ = np.zeros((n + 2, n + 2), dtype=bool)
        open_[:n, :n] = self._open
        open_[:n, n:] = self._looks_clear(nodes[n:], self.poses).T
        open_ = _symmetric(open_)
        found = self._search(nodes, open_)
        self._open &= open_[:n, :n]
        return found

    def _search(self, nodes: FloatArray, open_: BoolArray) -> list[Line] | None:
        """Return a path from the second-last of `nodes` to the last of `nodes`, or None.

        Connections that turn out to be blocked are set to false in `open_`.
        """
        last = len(nodes) - 1
        cost = np.abs(nodes[:, None] - nodes[None]).max(axis=2) + STOP_COST_RAD
        while path := _shortest(np.where(open_, cost, np.inf), last - 1, last):
            lines = [self.workspace.line(nodes[a], nodes[b]) for a, b in path]
            bad = [edge for edge, line in zip(path, lines, strict=True) if not self._is_clear(line)]
            if not bad:
                return lines
            for a, b in bad:
                open_[a, b] = open_[b, a] = False
        return None

    def _is_clear(self, line: Line) -> bool:
        return self.workspace.are_clear([line])

    def _looks_clear(self, starts: FloatArray, goals: FloatArray) -> BoolArray:
        """Return for each start and each goal whether the line between them looks clear, (S, G)."""
        s, g = np.indices((len(starts), len(goals))).reshape(2, -1)
        return self.workspace.look_clear(starts[s], goals[g]).reshape(len(starts), len(goals))

    def _seen_from_each_other(self, poses: FloatArray) -> BoolArray:
        """Return for each pair of poses (N, n) whether their line looks clear, (N, N)."""
        one, other = np.triu_indices(len(poses), 1)
        looks = np.zeros((len(poses), len(poses)), dtype=bool)
        looks[one, other] = self.workspace.look_clear(poses[one], poses[other])
        return _symmetric(looks)

    def _regions(self, poses: FloatArray, open_: BoolArray) -> list[IntArray]:
        """Return the indices of the poses in each connected region; all connections are checked.

        The method is Kruskal's algorithm: the shortest connections are checked first, and only
        connections that join two regions.
        """
        region = np.arange(len(poses))
        for a, b in _by_length(poses, open_):
            if region[a] != region[b]:
                if self._is_clear(self.workspace.line(poses[a], poses[b])):
                    region[region == region[b]] = region[a]
                else:
                    open_[a, b] = open_[b, a] = False
        return [np.flatnonzero(region == name) for name in np.unique(region)]

    def _leads_to(self, start: FloatArray, poses: FloatArray) -> bool:
        """Return whether a straight line from `start` (n,) to one of `poses` (m, n) is clear.

        For a region with a single pose, the return value is always False, because such a region is
        not useful.
        """
        near = poses[self._looks_clear(start[None], poses)[0]]
        lines = [self.workspace.line(start, q) for q in near]
        return len(poses) > 1 and self.workspace.first_clear(lines) is not None


def _count_from(region: IntArray, first: int) -> int:
    """Return how many indices of a region are greater than or equal to `first`."""
    return int(np.count_nonzero(region >= first))


def _unconnected(workspace: Workspace, poses: FloatArray) -> PlanError:
    """Return the error for poses (M, n) that are all unconnected."""
    everywhere = np.ones((len(poses), len(poses)), dtype=bool)
    a, b = next(_by_length(poses, everywhere), (0, 0))
    why = workspace.obstacle([workspace.line(poses[a], poses[b])])
    return PlanError(
        "no collision-free motion leads from one pose to another"
        + (f"; between the nearest two: {why}" if why else ""),
        hint=f"{workspace.larger_space}check the station's surroundings",
    )


def _by_length(poses: FloatArray, open_: BoolArray) -> Iterator[tuple[int, int]]:
    distance = np.abs(poses[:, None] - poses[None]).max(axis=2)
    pairs = np.argwhere(np.triu(open_, 1))
    order = np.argsort(distance[pairs[:, 0], pairs[:, 1]], kind="stable")
    return ((int(a), int(b)) for a, b in pairs[order])


def _symmetric(upper: BoolArray) -> BoolArray:
    """Return the symmetric matrix of connections that has the given upper triangle."""
    strict = np.triu(upper, 1)
    return np.asarray(strict | strict.T)


def _shortest(cost: FloatArray, start: int, goal: int) -> list[tuple[int, int]]:
    """Return the edges of the cheapest path (Dijkstra's algorithm), empty if there is no path."""
    best = np.full(len(cost), np.inf)
    best[start] = 0.0
    before = np.full(len(cost), -1)
    queue = [(0.0, start)]
    while queue:
        so_far, node = heapq.heappop(queue)
        if node == goal:
            return _backtrack(before, goal)
        total = so_far + cost[node]
        for other in np.flatnonzero(total < best):
            best[other], before[other] = total[other], node
            heapq.heappush(queue, (float(total[other]), int(other)))
    return []


def _backtrack(before: IntArray, node: int) -> list[tuple[int, int]]:
    edges: list[tuple[int, int]] = []
    while before[node] >= 0:
        edges.insert(0, (int(before[node]), node))
        node = int(before[node])
    return edges
