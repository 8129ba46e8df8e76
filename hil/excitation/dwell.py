"""Dwell program: static measurements at well-spread poses, approached from both directions.

The poses of a dwell program are drawn with a seed or read from a CSV file. All mistakes in the CSV
file are reported together, each with its line number.
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
"""Ratio of the number of spare poses to the number of requested poses; a spare pose replaces an
unreachable pose.
"""

MOST_TRIES, MOST_TRIES_PER_POSE = 4000, 20
"""Numbers of clear poses to check before the search for a dwell program is given up: a fixed
number, and a number per requested pose.
"""


class DwellProgram:
    """Dwell program with poses drawn by seed or read from a file, visited in random order.

    The poses are visited in random order because a drift during the run could otherwise be mistaken
    for a dependence on the pose.

    Args:
        spec: Excitation section of an experiment.
        folder: Folder to which the path `file` of the spec is relative.
    """

    def __init__(self, spec: Dwell, folder: Path = Path()) -> None:
        self.spec = spec
        self.folder = folder

    def program(self, roadmap: Roadmap) -> Program:
        """Return a program of visits whose motions are all clear of collisions.

        Raises:
            SpecError: The waypoint file contains mistakes; the message lists them.
            PlanError: Too few poses are clear of collisions.
        """
        if self.spec.file is not None:
            return Program(self._from_file(roadmap), shuffle_seed=self.spec.seed)
        wanted = self.spec.waypoints
        visits = self._drawn(roadmap, wanted + max(4, int(SPARE_SHARE * wanted)))
        return Program(visits[:wanted], visits[wanted:], shuffle_seed=self.spec.seed)

    def poses(self, workspace: Workspace) -> Iterator[FloatArray]:
        """Yield blocks (m, n) of clear candidate poses; a plug-in can override this method."""
        return draw_poses(workspace, self.spec.seed, "dwell poses")

    def _drawn(self, roadmap: Roadmap, count: int) -> list[Visit]:
        """Return `count` visits to drawn poses whose approach motions are clear as well.

        Raises:
            PlanError: Too few of the drawn poses can be approached and reached.
        """
        workspace = roadmap.workspace
        kept: list[FloatArray] = []
        seen = 0
        for q in _in_pieces(self.poses(workspace), max(32, count // 2)):
            visits = self._visits(workspace, q[roadmap.seem_connected(q)])
            kept += [pose for pose, visit in visits if workspace.are_clear(visit.motions)]
            seen += len(q)
            if len(kept) >= count:
                break
            if seen > MOST_TRIES_PER_POSE * count + MOST_TRIES:
                raise self._unreachable(
                    roadmap, q, f"dwell poses: only {len(kept)} of {seen} clear poses"
                )
        else:
            raise PlanError(
                f"only {len(kept)} of the {seen} poses of {type(self).__name__} can be reached; "
                f"{count} are needed, spare poses included",
                hint="yield more poses, or lower excitation.waypoints",
            )
        return [self._visit(workspace, q, f"pose {i}", i) for i, q in enumerate(kept[:count])]

    def _unreachable(self, roadmap: Roadmap, poses: FloatArray, few: str) -> PlanError:
        """Return the error for too few poses; it names an obstacle on the path to `poses`."""
        connected = roadmap.seem_connected(poses)
        ways: list[list[Motion]] = [
            self._visit(roadmap.workspace, q, "", -1).motions if near else [roadmap.straight_to(q)]
            for q, near in zip(poses, connected, strict=True)
        ]
        why = next(filter(None, map(roadmap.workspace.obstacle, ways)), "")
        return PlanError(
            f"{few} can be reached and approached"
            + (f"; on the way to a rejected one: {why}" if why else ""),
            hint=f"{roadmap.workspace.larger_space}lower excitation.waypoints or approach_deg, "
            "or widen range_deg",
        )

    def _visits(self, workspace: Workspace, poses: FloatArray) -> list[tuple[FloatArray, Visit]]:
        """Return each of `poses` (m, n) with its visit; all distances are computed in one call."""
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
            ", or ".join(["correct or remove these poses", *ways]) + "; nothing was planned"
        )


def _in_pieces(blocks: Iterable[FloatArray], rows: int) -> Iterator[FloatArray]:
    """Yield the rows of `blocks` in order, in pieces of at most `rows` rows.

    Small pieces of `blocks` save computing time, because a short program needs few poses.
    """
    for block in blocks:
        for begin in range(0, len(block), rows):
            yield block[begin : begin + rows]


def _complaints(roadmap: Roadmap, q: FloatArray, visit: Visit) -> list[str]:
    """Return the problems of a pose from the file or, if there are none, of the path to it."""
    workspace = roadmap.workspace
    if complaint := workspace.complaint(q):
        return [f"{visit.label}: {complaint}"]
    for motion in visit.motions:
        if complaint := workspace.complaint(motion.q_start):
            return [f"{visit.label}: at the start of its approach, {complaint}"]
    if not workspace.are_clear(visit.motions):
        return [f"{visit.label}: on its approach: {workspace.obstacle(visit.motions)}"]
    if roadmap.way(roadmap.home, visit.entry) is None:
        straight = workspace.obstacle([workspace.line(roadmap.home, visit.entry)])
        return [
            f"{visit.label}: no collision-free path leads there; on the straight path: {straight}"
        ]
    return []


AngleUnit: TypeAlias = Literal["deg", "rad"]

MOST_PROBLEMS = 20
"""Maximum number of problems in a message; a longer list is usually one mistake repeated."""

RADIAN_SUSPICION = 0.5
"""Share of poses beyond the joint limits above which a wrong unit is suspected (degrees read as
radians).
"""

MOST_QUOTED = 40
"""Maximum number of characters quoted from a line of the file: enough to find the line, but too few
to disclose an unrelated file.
"""


@dataclass(frozen=True, slots=True, eq=False)
class WaypointFile:
    """Poses of a waypoint file.

    Attributes:
        path: Path of the file.
        q: (N, n) poses [rad], with the joints in the order of the robot.
        unit: Unit of the numbers in the file.
        lines: Line number of each pose in the file.
        problems: Error messages, one per mistake in the file; each begins with `file:line:`.
    """

    path: Path
    q: FloatArray
    unit: AngleUnit
    lines: tuple[int, ...]
    problems: tuple[str, ...]

    def suspected(self, outside: int) -> str:
        """Return a hint about a wrong unit if many poses (`outside`) are beyond the limits."""
        if self.unit == "deg" or outside < RADIAN_SUSPICION * max(1, len(self.q)):
            return ""
        return "if these numbers are degrees, set excitation.file_unit: deg"

    def place(self, row: int) -> str:
        """Return the location `file:line` of the pose with index `row`."""
        return f"{self.path}:{self.lines[row]}"


def read_waypoints(
    path: Path, joint_names: Sequence[str], unit: AngleUnit | None = None
) -> WaypointFile:
    """Read poses from a CSV file with one line per pose and one column per joint.

    Blank lines and lines that begin with `#` are skipped. A header line is optional. The header
    line contains the names of the joints, or `q1` to `qn`, in any order (elbow-first orders are
    common). The ending `_deg` or `_rad`, common to all names of the header line, sets the unit.

    Args:
        path: Path of the file.
        joint_names: Names of the robot's joints, in the order of the robot.
        unit: Unit stated in the spec; None to use the unit of the header line, or degrees if the
            header line states no unit.

    Raises:
        SpecError: The file cannot be opened or read as text, its header line names joints that the
            robot does not have, or the unit of the header line differs from `unit`.
    """
    rows = _rows(path)
    order, named = list(range(len(joint_names))), None
    if rows and not any(_number(cell) is not None for cell in rows[0][1]):
        order, named = _header(path, rows.pop(0), joint_names)
    if unit and named and unit != named:
        raise SpecError(
            f"{path}: the first line says {named}, excitation.file_unit says {unit}",
            hint="remove excitation.file_unit, or correct one of the two",
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
            "set excitation.file_unit: rad, or deg if they are degrees"
        )
    known: AngleUnit = unit or named or "deg"
    q_rad = np.radians(poses) if known == "deg" else poses
    return WaypointFile(path, q_rad, known, tuple(lines), tuple(problems))


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return line number and stripped cells of every line except blank lines and comments."""
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
            f"{path}:{number}: {error}", hint="write one pose per line: numbers separated by commas"
        ) from None


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _header(
    path: Path, header: tuple[int, list[str]], joint_names: Sequence[str]
) -> tuple[list[int], AngleUnit | None]:
    """Return the column of each joint and the unit, both derived from the header line."""
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
    """Return the problems as text, one per line; a very long list is cut off."""
    more = len(problems) - MOST_PROBLEMS
    shown = list(problems[:MOST_PROBLEMS]) + ([f"… and {more} more"] if more > 0 else [])
    return "\n".join(shown)
