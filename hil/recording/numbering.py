"""Numbers for runs, unique below a runs folder even when processes create runs at once."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hil.core import HeldFile, fsync_directory, hold, holder_of, this_process

_CLAIM, _DRAFT = ".claim-", ".draft-"
_NUMBERED = re.compile(r"(\d{4,})-.+", re.DOTALL)


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


@dataclass(frozen=True, slots=True)
class Claim:
    """A number that only this process may use, with a hidden folder in which the run is prepared.

    The number belongs to the process that holds the file `ROOT/.claim-NNNN`. Only that process
    makes, renames or removes a folder `.draft-NNNN`. A draft lies in the folder of its run, so that
    its rename stays on one file system.

    Attributes:
        number: Run number, unique under `ROOT`.
        draft: Hidden folder in which the run is prepared.
    """

    number: int
    draft: Path

    def become(self, run: Path) -> None:
        """Rename the draft to the run directory, which lies beside it. Raises `OSError`."""
        fsync_directory(self.draft)
        self.draft.rename(run)
        fsync_directory(run.parent)


@contextlib.contextmanager
def claimed(root: Path, folder: Path) -> Iterator[Claim]:
    """Hold the next free number under `root`, with a draft in `folder` (`ROOT/DAY/ROBOT`).

    Drafts of processes that died are removed before, and this draft afterwards, unless it has
    become a run.

    Raises:
        OSError: One of the folders cannot be written to.
    """
    _remove_abandoned(root)
    lock, claim = _claim(root, folder)
    with lock:
        try:
            yield claim
        finally:
            shutil.rmtree(claim.draft, ignore_errors=True)


def _claim(root: Path, folder: Path) -> tuple[HeldFile, Claim]:
    number = max((number_of(run) for run in run_folders(root)), default=0)
    while True:
        number += 1
        path = root / f"{_CLAIM}{number:04d}"
        try:
            lock = hold(path, this_process())
        except PermissionError:
            if not path.exists():
                raise
            continue  # the claim of another user
        if not isinstance(lock, HeldFile):
            continue
        with contextlib.ExitStack() as release:
            release.enter_context(lock)
            # Looked for only now: until the number was held, another process could make it a run.
            if any(number_of(run) == number for run in run_folders(root)):
                continue
            _remove_drafts(root, path)
            draft = folder / _draft_of(path)
            try:
                draft.mkdir()
            except FileExistsError:
                continue  # a draft of another user that died, and that only its owner may remove
            release.pop_all()
            return lock, Claim(number, draft)


def _remove_abandoned(root: Path) -> None:
    """Remove the claims and the drafts of processes that died while they prepared a run."""
    for path in root.glob(f"{_CLAIM}*"):
        if holder_of(path) is not None:
            continue
        with contextlib.suppress(OSError):
            lock = hold(path, this_process())
            if isinstance(lock, HeldFile):
                with lock:
                    _remove_drafts(root, path)


def _remove_drafts(root: Path, claim: Path) -> None:
    """Remove every draft of a number; the caller holds its claim."""
    for day in folders_in(root):
        for robot in folders_in(day):
            shutil.rmtree(robot / _draft_of(claim), ignore_errors=True)


def _draft_of(claim: Path) -> str:
    return _DRAFT + claim.name.removeprefix(_CLAIM)


def name_for_path(name: str) -> str:
    """A name as a folder: lower case, no separators, never empty or hidden."""
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-.") or "run"
