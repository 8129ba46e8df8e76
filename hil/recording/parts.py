"""How the files of a run are called: attempts after the first, and parts of a long recording."""

from __future__ import annotations

import re
from pathlib import Path

from hil.recording.writer import PARTIAL_SUFFIX

_RECORDING = re.compile(rf"(\d\d+)(?:\.(\d\d\d+))?\.mcap({re.escape(PARTIAL_SUFFIX)})?").fullmatch


def name_of_attempt(name: str, attempt: int) -> str:
    """`stop.json` for the first attempt, `stop-01.json`, … for those after it."""
    path = Path(name)
    return f"{path.stem}-{attempt:02d}{path.suffix}" if attempt else name


def part_name(attempt: int, part: int = 0) -> str:
    """`00.mcap` for the first part, `00.001.mcap`, `00.002.mcap`, … for those after it."""
    return f"{attempt:02d}.{part:03d}.mcap" if part else f"{attempt:02d}.mcap"


def recordings_in(folder: Path) -> tuple[Path, ...]:
    """The recordings of a folder in order of attempts and parts, unfinished ones included.

    A part that stands there finished *and* unfinished counts once, finished: a recovery that was
    killed between its last two steps leaves both.
    """
    found: dict[tuple[int, int], Path] = {}
    for path in sorted(folder.iterdir(), key=lambda path: path.name, reverse=True):
        if match := _RECORDING(path.name):
            found[int(match[1]), int(match[2] or 0)] = path
    return tuple(found[key] for key in sorted(found))


def attempt_of(path: Path) -> int:
    """Which attempt a recording belongs to.

    Raises:
        ValueError: The file is not called like a recording of a run.
    """
    match = _RECORDING(path.name)
    if match is None:
        raise ValueError(f"{path.name} is not the name of a recording")
    return int(match[1])
