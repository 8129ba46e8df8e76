"""What a file or folder that is not there may have been meant to be: where it was looked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from hil.core.suggest import closest
from hil.core.text import shown

MOST_NAMED = 8
"""Files of a folder that a hint names."""

UNKNOWN = "is the path right, seen from this folder?"
_MOST_LETTERS = 300


def no_file(file: Path) -> str:
    """`there is no file poses.csv in /cell`: by its whole path, or with the folder it starts at."""
    told = f"there is no file {shown(str(file), _MOST_LETTERS)}"
    return told if file.is_absolute() else f"{told} in {shown(str(Path.cwd()), _MOST_LETTERS)}"


def neighbour_of(
    file: Path, endings: Iterable[str], fits: Callable[[Path], bool] = lambda _: True
) -> str:
    """What is there instead, as a hint: the folder missing, a near name, or the few of its kind.

    Args:
        file: What is not there.
        endings: Of what could be meant, such as `.urdf`.
        fits: Tells further whether something could be meant; `OSError` where nobody can know.
    """
    folder = file.parent
    wanted = tuple(endings)
    try:
        if not folder.is_dir():
            return f"there is no folder {shown(str(folder), _MOST_LETTERS)}"
        beside = [path for path in folder.iterdir() if path.suffix.casefold() in wanted]
        names = sorted(path.name for path in beside if fits(path))
    except (OSError, ValueError):  # ValueError: a name that no file system takes
        names = []
    if match := closest(file.name, names):
        return f"did you mean {folder / match}?"
    if 0 < len(names) <= MOST_NAMED:
        return f"there is {', '.join(names)}"
    return UNKNOWN


def no_file_but(file: Path, endings: Iterable[str]) -> str:
    """`no_file` with what is there instead, where that can be told, for a list of problems."""
    instead = neighbour_of(file, endings)
    return no_file(file) if instead == UNKNOWN else f"{no_file(file)}; {instead}"
