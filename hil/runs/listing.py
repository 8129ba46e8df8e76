"""Which runs are there? A view of the disk that nothing damaged on it can break."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hil.core import DataError, closest, is_live
from hil.recording import (
    PARTIAL_SUFFIX,
    RunDirectory,
    RunStatus,
    name_for_path,
    number_of,
    run_folders,
)

LAST = "last"
"""Names the newest run."""

ListedStatus = RunStatus | Literal["running", "damaged"]


@dataclass(frozen=True, slots=True)
class RunListing:
    """One line of the catalogue.

    Attributes:
        path: The run directory.
        number: Its running number, 0 when somebody has renamed it.
        date: Folder of the day it was started, ISO 8601.
        robot: Folder of the robot.
        status: How it ended, `running` while a process holds it, or `damaged`.
        uid: Identity from the start document, empty when damaged or not written yet.
        problem: Why it is damaged, else empty.
    """

    path: Path
    number: int
    date: str
    robot: str
    status: ListedStatus
    uid: str = ""
    problem: str = ""


def run_listings(runs_root: Path) -> list[RunListing]:
    """Every run under `runs_root`, by number; damaged directories are listed as such.

    Raises:
        DataError: `runs_root` is a file. A folder that does not exist holds no runs.
    """
    listings = [listing_of(path) for path in run_paths(runs_root)]
    return sorted(listings, key=lambda run: (run.number, run.path))


def run_paths(runs_root: Path) -> list[Path]:
    """Every run directory under `runs_root`, damaged ones too; nothing in them is read.

    Raises:
        DataError: `runs_root` is a file.
    """
    if runs_root.exists() and not runs_root.is_dir():
        raise DataError(
            f"{runs_root} is not a folder of runs but a file",
            hint="give the folder that holds them: --runs DIR",
        )
    return [
        path for path in run_folders(runs_root) if number_of(path) or (path / "start.json").exists()
    ]


def find_run(named: str, runs_root: Path) -> Path:
    """The run directory somebody means.

    Args:
        named: A path, a directory's name, a number (`42`), the name of an experiment, of which the
            newest run is meant, or `last` for the newest of all.
        runs_root: The folder of runs.

    Raises:
        DataError: It is a recording instead of a run, or no run under `runs_root` is called so.
    """
    path = Path(named)
    if path.is_dir():
        return path
    if path.is_file():
        raise _no_run(path)
    folders = run_folders(runs_root)
    number = int(named) if named.isdecimal() else 0
    found = [run for run in folders if run.name == named or (number and number_of(run) == number)]
    if len(found) == 1:
        return found[0]
    if found:
        listed = ", ".join(str(run) for run in found)
        raise DataError(f"{len(found)} runs are called {named}: {listed}", hint="give the path")
    if (newest := _newest(named, folders)) is not None:
        return newest
    guess = None if number else closest(named, [run.name for run in folders])
    hint = f"did you mean {guess!r}?" if guess else f"list them with: hil runs --runs {runs_root}"
    raise DataError(f"there is no run {named}, here or under {runs_root}", hint=hint)


def _newest(named: str, folders: Iterable[Path]) -> Path | None:
    """The newest run of an experiment of that name; `last` stands for any."""
    own = name_for_path(named)
    of_it = [run for run in folders if number_of(run)]
    if named != LAST:
        of_it = [run for run in of_it if run.name.partition("-")[2] == own]
    return max(of_it, key=number_of, default=None)


def _no_run(file: Path) -> DataError:
    """What to do with a file that was given where a run directory is needed."""
    if not file.name.endswith((".mcap", f".mcap{PARTIAL_SUFFIX}")):
        return DataError(f"{file} is a file, not a run directory", hint="list them with: hil runs")
    run = file.resolve().parent.parent
    if (run / "start.json").is_file():
        hint = f"its run: hil show {run}"
    else:
        hint = f"it is data, not a run; fit it: hil fit {file} --estimator NAME"
    return DataError(f"{file} is a recording, not a run directory", hint=hint)


def listing_of(path: Path) -> RunListing:
    """The line of one run directory."""
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


def _state_of(path: Path) -> tuple[ListedStatus, str, str]:
    live = is_live(path)
    try:
        run = RunDirectory.open(path)
        return "running" if live else run.status, str(run.start.get("uid", "")), ""
    except DataError as error:
        # A run that has just begun has not written its start document yet.
        return ("running", "", "") if live else ("damaged", "", error.message)
    except OSError as error:
        return "damaged", "", str(error)
