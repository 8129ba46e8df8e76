"""Numbers for runs, unique below a runs folder even when processes create runs at once."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from hil.held_file import HeldFile, hold, holder_of
from hil.holder import this_process
from hil.record.files import fsync_directory
from hil.record.lock import LOCK

_CLAIM = ".claim-"
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


class Claim:
    """A number of this process alone, with a hidden folder in which the run is prepared.

    The folder is `ROOT/.claim-NNNN`: making it takes the number, renaming it makes it the run.
    Nothing lists it. One whose process died is removed by the next process that claims a number.

    Attributes:
        number: Run number, unique under `root`.
        draft: Hidden folder `ROOT/.claim-NNNN` in which the run is prepared.
    """

    def __init__(self, number: int, draft: Path, lock: HeldFile) -> None:
        self.number = number
        self.draft = draft
        self._lock = lock
        self._is_run = False

    def become(self, run: Path) -> None:
        """Give the prepared folder its name. Raises `OSError`."""
        fsync_directory(self.draft)
        self.draft.rename(run)
        self._lock.path, self._is_run = run / LOCK, True
        fsync_directory(run.parent)

    def release(self) -> None:
        """Let the number go; what was prepared is removed unless it has become a run."""
        if not self._is_run:
            shutil.rmtree(self.draft, ignore_errors=True)
        self._lock.release()


@contextlib.contextmanager
def claimed(root: Path) -> Iterator[Claim]:
    """Hold the next number that is free under `root` while inside.

    Raises:
        OSError: The folder cannot be written to.
    """
    _remove_abandoned(root)
    claim = _claim(root)
    try:
        yield claim
    finally:
        claim.release()


def _claim(root: Path) -> Claim:
    number = max((number_of(run) for run in run_folders(root)), default=0)
    while True:
        number += 1
        draft = root / f"{_CLAIM}{number:04d}"
        try:
            draft.mkdir()
        except FileExistsError:
            continue
        try:
            lock = hold(draft / LOCK, this_process())
        except FileNotFoundError:  # taken for an abandoned one before it was locked
            continue
        except OSError:
            shutil.rmtree(draft, ignore_errors=True)
            raise
        if not isinstance(lock, HeldFile):
            continue
        claim = Claim(number, draft, lock)
        # The holder of the claim is alone in looking at this number and in taking it.
        if all(number_of(run) != number for run in run_folders(root)):
            return claim
        claim.release()


def _remove_abandoned(root: Path) -> None:
    """Remove the drafts of processes that died while they prepared a run."""
    for draft in root.glob(f"{_CLAIM}*"):
        if holder_of(draft / LOCK) is not None:
            continue
        with contextlib.suppress(OSError):
            lock = hold(draft / LOCK, this_process())
            if not isinstance(lock, HeldFile):
                continue
            # Renamed first: its number is free, and the next claim of it is another folder.
            gone = draft.with_name(f"{draft.name}.{os.getpid()}.gone")
            try:
                draft.rename(gone)
                shutil.rmtree(gone, ignore_errors=True)
            finally:
                lock.release()


def name_for_path(name: str) -> str:
    """A name as a folder: lower case, no separators, never empty or hidden."""
    return re.sub(r"[^a-z0-9._]+", "-", name.lower()).strip("-.") or "run"
