"""File names of recordings: attempts, parts, and suffixes of unfinished and torn files.

::

    recording/00.mcap            the first attempt, finished
    recording/00.001.mcap        its second part: long recordings are rotated
    recording/01.mcap.partial    the second attempt (a resumption): being written, or torn by a kill
    recording/01.mcap.torn       the torn file, after a recovery has rebuilt it as `01.mcap`

Writer, reader and recovery use the file names of this module without depending on the run directory
module.
"""

from __future__ import annotations

import re
from pathlib import Path

PARTIAL_SUFFIX = ".partial"
TORN_SUFFIX = ".torn"

_RECORDING = re.compile(rf"(\d\d+)(?:\.(\d\d\d+))?\.mcap({re.escape(PARTIAL_SUFFIX)})?").fullmatch
_MOST_NAMED = 3


def part_name(attempt: int, part: int = 0) -> str:
    """Return the file name of a part: `00.mcap` for the first, `00.001.mcap`, … for later ones."""
    return f"{attempt:02d}.{part:03d}.mcap" if part else f"{attempt:02d}.mcap"


def recordings_in(folder: Path) -> tuple[Path, ...]:
    """Return the recordings of a folder in order of attempts and parts, including unfinished files.

    If a part exists both finished and unfinished, only the finished file is returned: a recovery
    that was killed between its last two steps leaves both files.
    """
    found: dict[tuple[int, int], Path] = {}
    for path in sorted(folder.iterdir(), key=lambda path: path.name, reverse=True):
        if match := _RECORDING(path.name):
            found[int(match[1]), int(match[2] or 0)] = path
    return tuple(found[key] for key in sorted(found))


def attempt_of(path: Path) -> int:
    """Return the number of the attempt to which a recording belongs.

    Raises:
        ValueError: The file name is not the name of a recording.
    """
    match = _RECORDING(path.name)
    if match is None:
        raise ValueError(f"{path.name} is not the name of a recording")
    return int(match[1])


def run_of(recording: Path) -> Path | None:
    """Return the run that contains a recording; None if the file does not belong to a run."""
    folder = recording.resolve().parent
    is_part = folder.name == "recording" and (folder.parent / "start.json").is_file()
    return folder.parent if is_part else None


def hint_of_lost(path: Path) -> str:
    """Return the hint for a file without recoverable data; the hint lists the other recordings."""
    hint = "no data in it can be recovered: restore it from a backup"
    if run_of(path) is None:
        return hint
    names = [other.name for other in recordings_in(path.parent) if other.name != path.name]
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    listed = ", ".join(names[:_MOST_NAMED]) + more
    return f"{hint}; these recordings of the run are usable: {listed}" if names else hint
