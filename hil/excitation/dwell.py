"""The dwell program: many well-spread poses, approached from both sides, measured at rest.

The poses are drawn by seed or read from a lab's own CSV file, of which every mistake is reported
at once with its line.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from hil.core import FloatArray, PlanError, SpecError, shown
from hil.excitation.motion import Motion
from hil.excitation.program import Program, Visit, pose_visit
from hil.excitation.roadmap import Roadmap
from hil.excitation.workspace import Workspace, draw_poses, ways_out
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
        workspace.keep_clear([motion for visit in visits for motion in visit.motions])
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


AngleUnit: TypeAlias = Literal["deg", "rad"]

MOST_PROBLEMS = 20
"""A file with more mistakes than this has one mistake, made often."""

RADIAN_SUSPICION = 0.5
"""Share of poses beyond the limits from which degrees read as radians are suspected."""

MOST_QUOTED = 40
"""Characters of a line: enough to find it, and to give no foreign file away."""


@dataclass(frozen=True, slots=True, eq=False)
class WaypointFile:
    """Poses as read.

    Attributes:
        path: The file.
        q: (N, n) poses [rad], joints in the robot's order.
        unit: Of the numbers in the file.
        lines: Line number of each pose.
        problems: What cannot be read, one message per mistake, each beginning `file:line:`.
    """

    path: Path
    q: FloatArray
    unit: AngleUnit
    lines: tuple[int, ...]
    problems: tuple[str, ...]

    def suspected(self, outside: int) -> str:
        """Return what may be wrong with the unit if so many poses are beyond the limits."""
        if self.unit == "deg" or outside < RADIAN_SUSPICION * max(1, len(self.q)):
            return ""
        return "if these numbers are degrees, say excitation.file_unit: deg"

    def place(self, row: int) -> str:
        """`file:line` of pose `row`."""
        return f"{self.path}:{self.lines[row]}"


def read_waypoints(
    path: Path, joint_names: Sequence[str], unit: AngleUnit | None = None
) -> WaypointFile:
    """Read poses: one per line, one column per joint, separated by commas.

    Blank lines and lines that begin with `#` are skipped. A first line may name the joints, in any
    order (elbow-first orders are common), by their names or as `q1` to `qn`, and the unit by the
    ending `_deg` or `_rad` of every name.

    Args:
        path: The file.
        joint_names: Of the robot, in its order.
        unit: As the spec states it; without, that of the first line, else degrees.

    Raises:
        SpecError: The file cannot be opened or read as text, its first line names joints that the
            robot does not have, or its unit is not the stated one.
    """
    rows = _rows(path)
    order, named = list(range(len(joint_names))), None
    if rows and not any(_number(cell) is not None for cell in rows[0][1]):
        order, named = _header(path, rows.pop(0), joint_names)
    if unit and named and unit != named:
        raise SpecError(
            f"{path}: the first line says {named}, excitation.file_unit says {unit}",
            hint="leave excitation.file_unit out, or correct one of the two",
        )
    problems: list[str] = []
    q, lines = [], []
    for line, cells in rows:
        if complaint := _complaint(cells, joint_names):
            problems.append(f"{path}:{line}: {complaint}")
        else:
            q.append([float(cells[column]) for column in order])
            lines.append(line)
    if not rows:
        problems.append(f"{path}: there is no pose in this file")
    poses = np.array(q, dtype=np.float64).reshape(len(q), len(joint_names))
    if not (unit or named) and 0.0 < np.max(np.abs(poses), initial=0.0) <= 2 * np.pi:
        problems.append(
            f"{path}: no angle is beyond 2π, so these may be radians: "
            "write excitation.file_unit: rad, or deg if they are degrees"
        )
    known: AngleUnit = unit or named or "deg"
    q_rad = np.radians(poses) if known == "deg" else poses
    return WaypointFile(path, q_rad, known, tuple(lines), tuple(problems))


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and stripped cells of every line that says something."""
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise SpecError(
            f"excitation.file: {path} cannot be read: {reason}",
            hint="the path is relative to the folder of the experiment's YAML",
        ) from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            rows.append((number, _cells(path, number, line)))
    return rows


def _cells(path: Path, number: int, line: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise SpecError(
            f"{path}:{number}: {error}", hint="a line has a pose: numbers, separated by commas"
        ) from None


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _header(
    path: Path, header: tuple[int, list[str]], joint_names: Sequence[str]
) -> tuple[list[int], AngleUnit | None]:
    """Return the column of each joint by the names in the first line, and the unit they end in."""
    line, cells = header
    numbered = [f"q{number}" for number in range(1, len(joint_names) + 1)]
    units: tuple[AngleUnit | None, ...] = (None, "deg", "rad")
    for unit in units:
        for names in (list(joint_names), numbered):
            wanted = [f"{name}_{unit}" if unit else name for name in names]
            if sorted(cells) == sorted(wanted):
                return [cells.index(name) for name in wanted], unit
    raise SpecError(
        f"{path}:{line}: the first line is neither a pose nor the joints' names: "
        f"{shown(', '.join(cells), MOST_QUOTED)}",
        hint=f"the joints are {', '.join(joint_names)}, or {numbered[0]} to {numbered[-1]}; all of "
        "them may end in _deg or all in _rad",
    )


def _complaint(cells: Sequence[str], joint_names: Sequence[str]) -> str:
    if len(cells) != len(joint_names):
        return f"{len(cells)} columns, but the robot has {len(joint_names)} joints"
    for column, cell in enumerate(cells, start=1):
        value = _number(cell)
        if value is None:
            return f"column {column} is '{shown(cell, MOST_QUOTED)}', not a number"
        if not math.isfinite(value):
            return f"column {column} is {shown(cell, MOST_QUOTED)}, not a finite number"
    return ""


def shortened(problems: Sequence[str]) -> str:
    """The problems, one per line, the end of a very long list left out."""
    more = len(problems) - MOST_PROBLEMS
    shown = list(problems[:MOST_PROBLEMS]) + ([f"… and {more} more"] if more > 0 else [])
    return "\n".join(shown)
