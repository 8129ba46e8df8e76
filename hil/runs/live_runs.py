"""Which runs are live below a folder, asked many times a second: a look costs what has changed."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from hil.core import LOCK, DataError, is_live, read_json
from hil.recording import folders_in

SETTLED_NS = 2 * 10**9
"""A folder that was changed more lately may have been changed once more at the same time stamp."""


class KnownRuns:
    """Which runs there are, which are live, and which were started under a name.

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
        """The runs that processes hold.

        Args:
            within_s: So long ago those that had ended may have been looked at [s]: one that is gone
                on with is missed meanwhile. New runs never are.
        """
        with self._looking:
            sweep = time.monotonic() - self._swept >= within_s
            if sweep:
                self._swept = time.monotonic()
            runs = self._runs()
            return [run for run in runs if self._may_be_live(run, sweep) and is_live(run)]

    def started_as(self, name: str) -> list[Path]:
        """The runs that the process of that name has made, see `hil.recording.provenance`."""
        with self._looking:
            return [run for run in self._runs() if self._name_of(run) == name]

    def _runs(self) -> list[Path]:
        days = self._in(self._root)
        return [run for day in days for robot in self._in(day) for run in self._in(robot)]

    def _in(self, parent: Path) -> list[Path]:
        """As `folders_in`, listed again when the folder has changed."""
        changed, settled = _changed(parent)
        known = self._folders.get(parent)
        if known is None or not known.settled or known.changed != changed:
            known = _Folder(changed, settled, folders_in(parent))
            for gone in self._folders.get(parent, known).folders:
                # One of the same name may stand in its place.
                self._ended.pop(gone, None)
                self._started.pop(gone, None)
            self._folders[parent] = known
        return known.folders

    def _may_be_live(self, run: Path, sweep: bool) -> bool:
        if not sweep and run in self._ended:
            return False
        changed, settled = _changed(run)
        if self._ended.get(run) == changed:
            return False
        self._ended.pop(run, None)
        # Left by one that was killed: it would be held again without any change of the folder.
        if os.path.lexists(run / LOCK):
            return True
        if settled:
            self._ended[run] = changed
        return False

    def _name_of(self, run: Path) -> str:
        """Remembered from when its `start.json` is there: it is never written again."""
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
    """What was in a folder when it was last changed."""

    changed: int
    settled: bool
    folders: list[Path]


def _changed(folder: Path) -> tuple[int, bool]:
    """When a folder was changed last [ns], and whether that is long enough ago; 0 for none."""
    try:
        changed = os.stat(folder).st_mtime_ns
    except OSError:
        return 0, False
    return changed, abs(time.time_ns() - changed) > SETTLED_NS


def known_runs(root: Path) -> KnownRuns:
    """What this process remembers of a folder of runs."""
    return _known(root.absolute())


@lru_cache(maxsize=16)
def _known(root: Path) -> KnownRuns:
    return KnownRuns(root)
