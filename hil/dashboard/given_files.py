"""Files that values from a browser may name: those below the folder that is offered, no others.

Whoever may start runs may not thereby read this computer: what a reader of poses cannot use, it
quotes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hil.core import SpecError, scalar, shown
from hil.dashboard.settings import Settings

FILE_KEYS = ("file",)
"""Keys of a spec whose values are files (a test looks for others)."""

PROSE = ("description", "prompt", "name")
"""Keys that nobody opens, whatever stands there."""

MOST_BYTES = 20_000_000
"""Of a file; as many poses as a program may have fit."""


def require_files_offered(overrides: Mapping[str, str], spec: Path, settings: Settings) -> None:
    """Refuse values that name files outside of the offered folder, symbolic links followed.

    Parameters of plug-ins may be files under any key, so every text that is a path is looked at.
    Whether a file outside exists is not told.

    Args:
        overrides: YAML text by dotted path, as a browser sent it.
        spec: What they are laid over; relative paths start at its folder.
        settings: Says what is offered.

    Raises:
        SpecError: A value is no YAML, or names a file elsewhere, or a very long one.
    """
    for place, text in overrides.items():
        for path, value in _texts(scalar(text, shown(place)), (*place.split("."),)):
            if path[-1] in PROSE or not (path[-1] in FILE_KEYS or "/" in value or "\\" in value):
                continue
            if not _is_offered(spec.parent, value, settings):
                raise SpecError(
                    f"{shown('.'.join(path))} names {shown(value)}, which is not in the folder "
                    "that is offered here",
                    hint=f"put the file into {settings.specs}, or write it into the spec there",
                )
            if path[-1] in FILE_KEYS and _bytes_of(spec.parent / value) > MOST_BYTES:
                raise SpecError(
                    f"{shown('.'.join(path))} names {shown(value)}, which is too long to be read "
                    f"here: more than {MOST_BYTES // 10**6} MB",
                    hint="is it the right file? or start it on the command line: `hil run`",
                )


def _texts(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Every text in a value, with where it is; an entry of a list is where the list is."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _texts(inner, (*path, str(key)))
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner, path)


def _is_offered(folder: Path, named: str, settings: Settings) -> bool:
    if settings.specs is None:
        return False
    try:
        return (folder / named).resolve().is_relative_to(settings.specs.resolve())
    except (OSError, ValueError, RuntimeError):  # no file system takes it, or a loop of links
        return False


def _bytes_of(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:  # whoever reads it says so
        return 0
