"""Which runs are there? A view of the disk that nothing damaged on it can break."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hil.errors import DataError
from hil.record.numbering import number_of, run_folders
from hil.record.rundir import RunDirectory, RunStatus


@dataclass(frozen=True, slots=True)
class RunListing:
    """One line of the catalogue.

    Attributes:
        path: The run directory.
        number: Its running number, 0 when somebody has renamed it.
        date: Folder of the day it was started, ISO 8601.
        robot: Folder of the robot.
        status: How it ended, or `damaged`.
        uid: Identity from the start document, empty when damaged.
        problem: Why it is damaged, else empty.
    """

    path: Path
    number: int
    date: str
    robot: str
    status: RunStatus | Literal["damaged"]
    uid: str = ""
    problem: str = ""


def list_runs(runs_root: Path) -> list[RunListing]:
    """Every run under `runs_root`, by number; damaged directories are listed as such.

    Raises:
        DataError: `runs_root` is a file. A folder that does not exist holds no runs.
    """
    if runs_root.exists() and not runs_root.is_dir():
        raise DataError(
            f"{runs_root} is not a folder of runs but a file",
            hint="give the folder that holds them: --runs DIR",
        )
    listings = [
        _listing(path)
        for path in run_folders(runs_root)
        if number_of(path) or (path / "start.json").exists()
    ]
    return sorted(listings, key=lambda run: (run.number, run.path))


def _listing(path: Path) -> RunListing:
    status, uid, problem = _state_of(path)
    return RunListing(
        path=path,
        number=number_of(path),
        date=path.parents[1].name,
        robot=path.parent.name,
        status=status,
        uid=uid,
        problem=problem,
    )


def _state_of(path: Path) -> tuple[RunStatus | Literal["damaged"], str, str]:
    try:
        run = RunDirectory.open(path)
        return run.status, str(run.start.get("uid", "")), ""
    except DataError as error:
        return "damaged", "", error.message
    except OSError as error:
        return "damaged", "", str(error)
