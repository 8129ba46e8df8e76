"""Numbers for runs, unique below a runs folder even when processes create runs at once."""

from __future__ import annotations

import os
import re
from pathlib import Path

_NUMBERED = re.compile(r"(\d{4,})-.+")


def number_of(run: Path) -> int:
    """The number in a run directory's name, 0 when somebody has renamed it."""
    match = _NUMBERED.fullmatch(run.name)
    return int(match[1]) if match else 0


def run_folders(runs_root: Path) -> list[Path]:
    """Every folder where a run may be, `DAY/ROBOT/RUN`; what vanishes meanwhile is left out."""
    days = folders_in(Path(runs_root))
    return [run for day in days for robot in folders_in(day) for run in folders_in(robot)]


def folders_in(parent: Path) -> list[Path]:
    """Folders in a folder, by name, without hidden ones; none where nobody can look."""
    try:
        with os.scandir(parent) as entries:
            found = [entry for entry in entries if entry.is_dir()]
    except OSError:
        return []
    return sorted(Path(entry) for entry in found if not entry.name.startswith("."))


def claim(root: Path, folder: Path, name: str) -> Path:
    """Make `folder/NNNN-name` with the next number free under `root`."""
    number = max((number_of(run) for run in run_folders(root)), default=0)
    while True:
        number += 1
        mark = root / f".claim-{number:04d}"
        try:
            mark.mkdir()
        except FileExistsError:
            continue
        try:
            # Who holds the mark is alone in looking at this number and in taking it.
            if all(number_of(run) != number for run in run_folders(root)):
                path = folder / f"{number:04d}-{name}"
                path.mkdir()
                return path
        finally:
            mark.rmdir()


def name_for_path(name: str) -> str:
    """A name as a folder: lower case, no separators, never empty or hidden."""
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-.") or "run"
