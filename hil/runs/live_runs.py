"""Which runs of a folder are live, looked up many times a second at the cost of what has changed.

A folder is listed again only when its time of change has moved, and a run that has ended is looked
into again only when a file in it has come or gone. Times of change are coarse: what was changed a
moment ago counts as not settled, and is looked at once more.
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
"""A folder that was changed more lately may have been changed once more at the same time stamp."""


class KnownRuns:
    """The runs of a folder: which are live, and which were started under a name.

    A run that has ended leaves no `.lock`; to hold it again one is made, which changes its folder.
    Safe from any thread.

    Args:
        root: The folder of runs.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._looking = threading.Lock()
        self._folders: dict[Path, _Folder] = {}
        self._ended: dict[Path, int] = {}
        self._swept = 0.0
        self._started: dict[Path, str] = {}

    def live(self, within_s: float = 0.0) -> list[Path]:
        """Return the runs that processes hold.

        Args:
            within_s: Age up to which the last look at ended runs still counts [s]: a run that is
                resumed meanwhile is missed. New runs never are.
        """
        with self._looking:
            sweep = time.monotonic() - self._swept >= within_s
            if sweep:
                self._swept = time.monotonic()
            runs = self._runs()
            live = [run for run in runs if self._may_be_live(run, sweep) and is_live(run)]
            return [run for run in live if is_run(run)]  # not a series or a fleet at work

    def started_as(self, name: str) -> list[Path]:
        """Return the runs made by the process of that name, see `hil.recording.provenance`."""
        with self._looking:
            return [run for run in self._runs() if self._name_of(run) == name]

    def _runs(self) -> list[Path]:
        days = self._in(self._root)
        return [run for day in days for robot in self._in(day) for run in self._in(robot)]

    def _in(self, parent: Path) -> list[Path]:
        """Return `folders_in`, listed again only when the folder has changed."""
        changed, settled = _changed(parent)
        known = self._folders.get(parent)
        if known is None or not known.settled or known.changed != changed:
            # What was known of the folders in it goes: others may have taken their names.
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
        # A killed run leaves its lock: resuming it would change nothing in the folder.
        if os.path.lexists(run / LOCK):
            return True
        if settled:
            self._ended[run] = changed
        return False

    def _name_of(self, run: Path) -> str:
        """Return the name a run was started under, remembered: `start.json` is written once."""
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
    """The folders in a folder, and when it was last changed [ns]."""

    changed: int
    settled: bool
    folders: list[Path]


def _changed(folder: Path) -> tuple[int, bool]:
    """Return when a folder was last changed [ns, 0 without one], and whether long enough ago."""
    try:
        changed = os.stat(folder).st_mtime_ns
    except OSError:
        return 0, False
    return changed, abs(time.time_ns() - changed) > SETTLED_NS


def known_runs(root: Path) -> KnownRuns:
    """Return what this process remembers of a folder of runs."""
    return _known(root.absolute())


@lru_cache(maxsize=16)
def _known(root: Path) -> KnownRuns:
    return KnownRuns(root)
