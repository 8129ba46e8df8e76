"""Arrangement of visits into one sequence: order, paths, warm-up and reference visits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.core import FloatArray, PlanError
from hil.excitation.motion import STANDSTILL_RAD, Line
from hil.excitation.program import Action, Program, Visit
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace

LOOK_AHEAD = 3
"""Number of remaining visits whose straight lines are checked in one call."""

PATIENCE = 60
"""Number of visits without a clear straight line, after which a path over intermediate poses is
used.
"""

MOST_PROBLEMS = 20
"""Maximum number of unreachable visits that one message names."""

REPETITION_PENALTY = 0.2
"""Penalty for each earlier use of a warm-up pose, as a share of the joint range."""


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Rules by which visits are arranged into a sequence.

    Attributes:
        roadmap: Clear paths between the poses of the visits.
        reference: Visit that is repeated to detect drift; None for no reference visits.
        every: Number of program visits between two reference visits.
        weighing: Visits for the payload check, repeated with every payload.
        nearest_first: Flag; if true, the visits are sorted by their distance from the current
            position instead of shuffled, unless the program defines the order.
    """

    roadmap: Roadmap
    reference: Visit | None = None
    every: int = 50
    weighing: Sequence[Visit] = ()
    nearest_first: bool = False

    @property
    def workspace(self) -> Workspace:
        """Workspace in which the roadmap was built."""
        return self.roadmap.workspace

    def go_home(self, here: FloatArray) -> list[Action]:
        """Return the clear path from `here` (n,) to the home pose of the roadmap.

        Raises:
            PlanError: There is no clear path to the home pose.
        """
        lines = self.roadmap.way(here, self.roadmap.home)
        if lines is None:
            raise PlanError(
                f"no collision-free path leads away from the pose {_degrees(here)}",
                hint="jog the robot to a less obstructed pose and plan again",
            )
        return _moves(lines)

    def warm_up(self, here: FloatArray, duration_s: float) -> list[Action]:
        """Return clear motions of every joint over large angles, lasting at least `duration_s`.

        Raises:
            PlanError: No motion of every joint over large angles is clear.
        """
        out: list[Action] = []
        used = np.zeros(len(self.roadmap.poses))
        left_s = duration_s
        while left_s > 0:
            line, index = self._far_away(here, used)
            out.append(Action("warmup", line, checkpoint=True))
            used[index] += 1
            left_s -= line.duration_s
            here = line.q_end
        return out

    def measure(self, program: Program, here: FloatArray) -> Iterator[Action]:
        """Yield the program's visits and the reference visits, from the position `here` (n,).

        Raises:
            PlanError: One of the visits cannot be reached.
        """
        remaining, spares = _ordered(program), list(program.spares)
        since_reference, last = self.every, ""
        while remaining:
            if since_reference >= self.every and (group := self._see_reference(here)):
                yield from group
                here, since_reference = group[-1].motion.q_end, 0
                last = "the reference pose"
            if self.nearest_first and program.shuffle_seed is not None:
                remaining = _by_distance(remaining, here)
            ahead = remaining if program.shuffle_seed is not None else remaining[:1]
            found = self._next(here, ahead)
            if found is None:
                if len(spares) < len(ahead):
                    raise self._out_of_reach(ahead, here, last)
                n = len(ahead)
                remaining, spares = spares[:n] + remaining[n:], spares[n:]
                continue
            index, lines = found
            visit = remaining.pop(index)
            yield from _group(lines, visit)
            here, last = visit.exit, visit.label
            since_reference += 1
        if since_reference:
            yield from self._see_reference(here)

    def tour(self, visits: Sequence[Visit], here: FloatArray) -> list[Action]:
        """Return the paths and visits of `visits` in their order, from the position `here` (n,).

        Raises:
            PlanError: One of `visits` cannot be reached.
        """
        out: list[Action] = []
        last = ""
        for visit in visits:
            lines = self.roadmap.way(here, visit.entry)
            if lines is None:
                raise self._out_of_reach([visit], here, last)
            out += _group(lines, visit)
            here, last = visit.exit, visit.label
        return out

    def _out_of_reach(self, visits: Sequence[Visit], here: FloatArray, last: str) -> PlanError:
        """Return the error for visits to which no clear path leads from `here` (n,).

        Args:
            visits: Unreachable visits, at least one of them.
            here: (n,) current position of the arm.
            last: Name of the current position in messages; empty for no name.
        """
        workspace, start = self.workspace, last or f"the pose {_degrees(here)}"
        problems = [
            f"{visit.label}: no collision-free path leads there from {start}; on the straight "
            "path: "
            f"{workspace.obstacle([workspace.line(here, visit.entry)])}"
            for visit in visits[:MOST_PROBLEMS]
        ]
        if len(visits) > MOST_PROBLEMS:
            problems.append(f"… and {len(visits) - MOST_PROBLEMS} more")
        return PlanError(
            "\n".join(problems),
            hint=f"{workspace.larger_space}remove these poses, or check the station's surroundings",
        )

    def _next(self, here: FloatArray, visits: Sequence[Visit]) -> tuple[int, list[Line]] | None:
        """Return the first visit with a clear straight line, or else with any clear path."""
        for i in range(0, min(len(visits), PATIENCE), LOOK_AHEAD):
            some = visits[i : min(i + LOOK_AHEAD, PATIENCE)]
            lines = [self.workspace.line(here, visit.entry) for visit in some]
            if (found := self.workspace.first_clear(lines)) is not None:
                return i + found, [lines[found]]
        for i, visit in enumerate(visits):
            if (way := self.roadmap.way(here, visit.entry)) is not None:
                return i, way
        return None

    def _see_reference(self, here: FloatArray) -> list[Action]:
        if self.reference is None:
            return []
        lines = self.roadmap.way(here, self.reference.entry)
        return [] if lines is None else _group(lines, self.reference)

    def _far_away(self, here: FloatArray, used: FloatArray) -> tuple[Line, int]:
        """Return a clear line on which every joint moves far, and the index of its goal pose."""
        poses = self.roadmap.poses
        share = np.abs(poses - here) / (self.workspace.high - self.workspace.low)
        order = np.argsort(REPETITION_PENALTY * used - share.min(axis=1), kind="stable")
        order = order[share[order].min(axis=1) > 0]
        lines = [self.workspace.line(here, poses[i]) for i in order]
        found = self.workspace.first_clear(lines)
        if found is None:
            why = f"; on the widest line: {self.workspace.obstacle(lines[:1])}" if lines else ""
            raise PlanError(
                f"no collision-free warm-up motion was found{why}",
                hint=f"{self.workspace.larger_space}set warm_up.duration_s to 0 or widen "
                "excitation.range_deg",
            )
        return lines[found], int(order[found])


def _degrees(q: FloatArray) -> str:
    return f"({', '.join(f'{angle:.1f}' for angle in np.degrees(q))})°"


def _moves(lines: Sequence[Line]) -> list[Action]:
    return [Action("move", line) for line in lines if line.distance >= STANDSTILL_RAD]


def _ordered(program: Program) -> list[Visit]:
    if program.shuffle_seed is None:
        return list(program.visits)
    order = np.random.default_rng(program.shuffle_seed).permutation(len(program.visits))
    return [program.visits[i] for i in order]


def _by_distance(visits: Sequence[Visit], here: FloatArray) -> list[Visit]:
    """Return the visits sorted by the largest joint distance of each visit from `here`."""
    return sorted(visits, key=lambda visit: float(np.abs(visit.entry - here).max()))


def _group(lines: Sequence[Line], visit: Visit) -> list[Action]:
    """Return the path to a visit and the visit itself, with a checkpoint for resuming a run."""
    group = [*_moves(lines), *visit.actions]
    return [replace(group[0], checkpoint=True), *group[1:]]
