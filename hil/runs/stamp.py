"""Has a run directory changed since it was read? Told by names, times and sizes alone."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

from hil.core import LOCK

SETTLED_S = 2.0
"""What was changed less long ago may change again within the same tick of a clock [s]."""

ALWAYS_READ = ""
"""Stamp of a run that has to be read again whatever its files look like."""

_FOLDERS = ("fit", "study")
_PARTS = ("evaluation.json", "model.json", "study.json")


def stamp_of(run: Path) -> str:
    """A text that changes whenever what the catalogue says of a run may have changed.

    `ALWAYS_READ` where that cannot be told: of a run that was changed a moment ago (as one that a
    process holds: it touches its lock), and of one that cannot be looked into.
    """
    try:
        seen = sorted(_seen(run))
    except OSError:
        return ALWAYS_READ
    newest = max((changed for _, changed, _ in seen), default=0)
    if newest > time.time_ns() - int(SETTLED_S * 1e9):
        return ALWAYS_READ
    return ";".join(f"{name}:{changed}:{size}" for name, changed, size in seen)


def _seen(run: Path) -> Iterator[tuple[str, int, int]]:
    """Name, time of change [ns] and size of whatever tells something about a run."""
    home = os.fspath(run)  # there are thousands: paths as text are several times quicker
    yield _look("", home)
    with os.scandir(home) as entries:
        inside = [entry for entry in entries if entry.name[0] != "." or entry.name == LOCK]
    for entry in inside:
        told = entry.stat()
        yield entry.name, told.st_mtime_ns, 0 if entry.is_dir() else told.st_size
        if entry.name in _FOLDERS and entry.is_dir():
            yield from _below(entry.name, entry.path)


def _below(name: str, folder: str) -> Iterator[tuple[str, int, int]]:
    with os.scandir(folder) as entries:
        inside = [entry for entry in entries if entry.is_dir()]
    for entry in inside:
        yield _look(f"{name}/{entry.name}", entry.path)
        for part in _PARTS:
            try:
                yield _look(f"{name}/{entry.name}/{part}", f"{entry.path}/{part}")
            except FileNotFoundError:
                continue


def _look(name: str, path: str) -> tuple[str, int, int]:
    told = os.stat(path)
    return name, told.st_mtime_ns, told.st_size
