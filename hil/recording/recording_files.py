"""Names of recordings: attempts, parts, and what a file is called while it is unfinished or torn.

::

    recording/00.mcap            the first attempt, finished
    recording/00.001.mcap        its second part: long recordings are rotated
    recording/01.mcap.partial    the second attempt (a resumption): being written, or torn by a kill
    recording/01.mcap.torn       what was torn, after a recovery has made `01.mcap` of it

Writer, reader and recovery name recordings without knowing a run directory, which is built on them.
"""

from __future__ import annotations

import re
from pathlib import Path

PARTIAL_SUFFIX = ".partial"
TORN_SUFFIX = ".torn"

_RECORDING = re.compile(rf"(\d\d+)(?:\.(\d\d\d+))?\.mcap({re.escape(PARTIAL_SUFFIX)})?").fullmatch
_MOST_NAMED = 3


def part_name(attempt: int, part: int = 0) -> str:
    """Return `00.mcap` for the first part, `00.001.mcap`, `00.002.mcap`, … for those after it."""
    return f"{attempt:02d}.{part:03d}.mcap" if part else f"{attempt:02d}.mcap"


def recordings_in(folder: Path) -> tuple[Path, ...]:
    """Return the recordings of a folder in order of attempts and parts, unfinished ones included.

    A part that is there finished *and* unfinished counts once, finished: a recovery that was
    killed between its last two steps leaves both.
    """
    found: dict[tuple[int, int], Path] = {}
    for path in sorted(folder.iterdir(), key=lambda path: path.name, reverse=True):
        if match := _RECORDING(path.name):
            found[int(match[1]), int(match[2] or 0)] = path
    return tuple(found[key] for key in sorted(found))


def attempt_of(path: Path) -> int:
    """Return the attempt that a recording belongs to.

    Raises:
        ValueError: The file is not called like a recording of a run.
    """
    match = _RECORDING(path.name)
    if match is None:
        raise ValueError(f"{path.name} is not the name of a recording")
    return int(match[1])


def run_of(recording: Path) -> Path | None:
    """Return the run that a recording belongs to, None for a file that stands by itself."""
    folder = recording.resolve().parent
    is_part = folder.name == "recording" and (folder.parent / "start.json").is_file()
    return folder.parent if is_part else None


def hint_of_lost(path: Path) -> str:
    """Return the hint for a file of which nothing can be saved; it names the other recordings."""
    hint = "hil can save nothing of it: take it from a copy"
    if run_of(path) is None:
        return hint
    names = [other.name for other in recordings_in(path.parent) if other.name != path.name]
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    listed = ", ".join(names[:_MOST_NAMED]) + more
    return f"{hint}; usable by itself is {listed} beside it" if names else hint
