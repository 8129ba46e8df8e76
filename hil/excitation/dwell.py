"""The dwell program: many well-spread poses, approached from both sides, measured at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from hil.core import FloatArray, PlanError, SpecError
from hil.excitation.motion import Motion
from hil.excitation.poses import draw_poses
from hil.excitation.roadmap import Roadmap
from hil.excitation.visit import Program, Visit, pose_visit
from hil.excitation.waypoint_file import WaypointFile, read_waypoints, shortened
from hil.excitation.workspace import Workspace, ways_out
from hil.spec import Dwell

SPARE_SHARE = 0.05
"""Poses drawn beyond those asked for, to stand in for unreachable ones."""

MOST_TRIES, MOST_TRIES_PER_POSE = 4000, 20
"""Clear poses that are looked at before a program is given up."""


class DwellProgram:
    """Poses drawn by seed or read from a file; visited in random order, as `excitation` says.

    The order is random so that drift during the run is not mistaken for a function of the pose.

    Args:
        spec: The excitation part of an experiment.
        folder: What `file` is relative to.
    """

    def __init__(self, spec: Dwell, folder: Path = Path()) -> None:
        self.spec = spec
        self.folder = folder

    def program(self, roadmap: Roadmap) -> Program:
        """All visits, clear in themselves.

        Raises:
            SpecError: The waypoint file has mistakes; all of them are listed.
            PlanError: There are too few clear poses.
        """
        if self.spec.file is not None:
            return Program(self._from_file(roadmap), shuffle_seed=self.spec.seed)
        wanted = self.spec.waypoints
        visits = self._drawn(roadmap, wanted + max(4, int(SPARE_SHARE * wanted)))
        return Program(visits[:wanted], visits[wanted:], shuffle_seed=self.spec.seed)

    def _drawn(self, roadmap: Roadmap, count: int) -> list[Visit]:
        """`count` visits to drawn poses, the stretches to and from each pose clear as well.

        Raises:
            PlanError: Hardly any pose can be approached and reached.
        """
        workspace = roadmap.workspace
        kept: list[FloatArray] = []
        seen = 0
        drawn = draw_poses(workspace, self.spec.seed, "dwell poses")
        for q in _in_pieces(drawn, max(32, count // 2)):
            visits = self._visits(workspace, q[roadmap.seem_connected(q)])
            kept += [pose for pose, visit in visits if workspace.are_clear(visit.motions)]
            seen += len(q)
            if len(kept) >= count:
                break
            if seen > MOST_TRIES_PER_POSE * count + MOST_TRIES:
                raise self._unreachable(
                    roadmap, q, f"dwell poses: only {len(kept)} of {seen} clear poses"
                )
        return [self._visit(workspace, q, f"pose {i}", i) for i, q in enumerate(kept[:count])]

    def _unreachable(self, roadmap: Roadmap, poses: FloatArray, few: str) -> PlanError:
        """Return the error for too `few` poses, with what is in the way of one of `poses`."""
        connected = roadmap.seem_connected(poses)
        ways: list[list[Motion]] = [
            self._visit(roadmap.workspace, q, "", -1).motions if near else [roadmap.straight_to(q)]
            for q, near in zip(poses, connected, strict=True)
        ]
        why = next(filter(None, map(roadmap.workspace.obstacle, ways)), "")
        return PlanError(
            f"{few} can be reached and approached"
            + (f"; on the way to a rejected one: {why}" if why else ""),
            hint=f"{roadmap.workspace.larger_space}ask for fewer waypoints, a smaller "
            "approach_deg or a wider range_deg",
        )

    def _visits(self, workspace: Workspace, poses: FloatArray) -> list[tuple[FloatArray, Visit]]:
        """Each of `poses` (m, n) with its visit; their distances are computed in one go."""
        visits = [self._visit(workspace, q, "", -1) for q in poses]
        workspace.clearances([motion for visit in visits for motion in visit.motions])
        return list(zip(poses, visits, strict=True))

    def _from_file(self, roadmap: Roadmap) -> list[Visit]:
        workspace = roadmap.workspace
        file = read_waypoints(
            self.folder / str(self.spec.file), workspace.joint_names, self.spec.stated_unit
        )
        visits = [self._visit(workspace, q, file.place(row), row) for row, q in enumerate(file.q)]
        problems = list(file.problems)
        for q, visit in zip(file.q, visits, strict=True):
            problems += _complaints(roadmap, q, visit)
        if problems:
            raise SpecError(shortened(problems), hint=self._hint(workspace, file))
        return visits

    def _visit(self, workspace: Workspace, q: FloatArray, label: str, pose: int) -> Visit:
        delta = float(np.radians(self.spec.approach_deg))
        return pose_visit(workspace, q, self.spec.approach, delta, label=label, pose=pose)

    def _hint(self, workspace: Workspace, file: WaypointFile) -> str:
        outside = int(np.count_nonzero(~workspace.within_limits(file.q)))
        ways = ways_out(workspace.space, file.q, workspace.clearance_m)
        return file.suspected(outside) or (
            ", or ".join(["mend or drop these poses", *ways]) + "; nothing was planned"
        )


def _in_pieces(blocks: Iterable[FloatArray], rows: int) -> Iterator[FloatArray]:
    """The rows of `blocks` in order, at most `rows` at a time: a short program needs few."""
    for block in blocks:
        for begin in range(0, len(block), rows):
            yield block[begin : begin + rows]


def _complaints(roadmap: Roadmap, q: FloatArray, visit: Visit) -> list[str]:
    """What is wrong with a pose of a file, else with the way to it."""
    workspace = roadmap.workspace
    if complaint := workspace.complaint(q):
        return [f"{visit.label}: {complaint}"]
    for motion in visit.motions:
        if complaint := workspace.complaint(motion.q_start):
            return [f"{visit.label}: where the pose is approached from, {complaint}"]
    if not workspace.are_clear(visit.motions):
        return [f"{visit.label}: on its approach: {workspace.obstacle(visit.motions)}"]
    if roadmap.way(roadmap.home, visit.entry) is None:
        straight = workspace.obstacle([workspace.line(roadmap.home, visit.entry)])
        return [f"{visit.label}: no clear path leads there; on the straight path: {straight}"]
    return []
