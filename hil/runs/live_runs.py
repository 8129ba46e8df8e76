"""Cached detection of active runs in a folder, fast enough for many calls per second.

A folder is listed again only if its modification time has changed since the last listing. A
finished run is examined again only if a file was added to or removed from its directory.
Modification times are coarse; therefore, a folder that was changed less than `SETTLED_NS` ago is
examined again on the next call.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from hil.core import LOCK, DataError, is_live, read_json
from hil.recording import folders_in, is_run

SETTLED_NS = 2 * 10**9
"""Minimum time since the last change of a folder before its listing is reused [ns].

A folder that was changed more recently can change again with the same modification time.
"""


class KnownRuns:
    """Cache of the runs in a folder, for finding active runs and runs started under a given name.

    A finished run has no `.lock` file. A process that resumes a run creates the file `.lock`, which
    changes the modification time of the run directory. All methods of this class are thread-safe.

    Args:
        root: Path of the folder of runs.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._looking = threading.Lock()
        self._folders: dict[Path, _Folder] = {}
        self._ended: dict[Path, int] = {}
        self._swept = 0.0
        self._started: dict[Path, str] = {}

    def live(self, within_s: float = 0.0) -> list[Path]:
        """Return the active runs, whose locks are held by a process.

        Args:
            within_s: Maximum time since the last check of finished runs [s]. A finished run that
                was resumed after the last check is missed; new runs are always found.
        """
        with self._looking:
            sweep = time.monotonic() - self._swept >= within_s
            if sweep:
                self._swept = time.monotonic()
            runs = self._runs()
            live = [run for run in runs if self._may_be_live(run, sweep) and is_live(run)]
            return [run for run in live if is_run(run)]  # exclude active series and fleets

    def started_as(self, name: str) -> list[Path]:
        """Return the runs that were started under a given name (see `hil.recording.provenance`)."""
        with self._looking:
            return [run for run in self._runs() if self._name_of(run) == name]

    def _runs(self) -> list[Path]:
        days = self._in(self._root)
        return [run for day in days for robot in self._in(day) for run in self._in(robot)]

    def _in(self, parent: Path) -> list[Path]:
        """Return the subfolders of a folder; the folder is listed again only if it has changed."""
        changed, settled = _changed(parent)
        known = self._folders.get(parent)
        if known is None or not known.settled or known.changed != changed:
            # Forget the subfolders: other runs may now have the same names.
            for folder in known.folders if known is not None else ():
                self._ended.pop(folder, None)
                self._started.pop(folder, None)
            known = self._folders[parent] = _Folder(changed, settled, folders_in(parent))
        return known.folders

    def _may_be_live(self, run: Path, sweep: bool) -> bool:
        if not sweep and run in self._ended:
            return False
        changed, settled = _changed(run)
        if self._ended.get(run) == changed:
            return False
        self._ended.pop(run, None)
        # A killed run leaves its lock file, so resuming the run does not change the folder.
        if os.path.lexists(run / LOCK):
            return True
        if settled:
            self._ended[run] = changed
        return False

    def _name_of(self, run: Path) -> str:
        """Return the name under which a run was started, cached after the first read."""
        name = self._started.get(run)
        if name is None:
            try:
                name = str(read_json(run / "start.json").get("started_as", ""))
            except (OSError, DataError):
                return ""
            self._started[run] = name
        return name


@dataclass(slots=True)
class _Folder:
    """Names of the subfolders of a folder, and the time of the folder's last change [ns]."""

    changed: int
    settled: bool
    folders: list[Path]


def _changed(folder: Path) -> tuple[int, bool]:
    """Return the modification time of a folder, and whether it is older than `SETTLED_NS`.

    The modification time of the folder is in nanoseconds, or 0 if the folder does not exist.
    """
    try:
        changed = os.stat(folder).st_mtime_ns
    except OSError:
        return 0, False
    return changed, abs(time.time_ns() - changed) > SETTLED_NS


def known_runs(root: Path) -> KnownRuns:
    """Return the cache that this process uses for a folder of runs."""
    return _known(root.absolute())


@lru_cache(maxsize=16)
def _known(root: Path) -> KnownRuns:
    return KnownRuns(root)
