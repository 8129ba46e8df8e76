"""Tolerant reading of the small files of a run.

Reports matter most for failed runs, so that no function of this module raises an error for an
invalid value. A missing file yields an empty result. A damaged file also yields an empty result,
and the error of the file is added to `problems`. A value of an unexpected type is treated as
missing (`as_object`, `as_float`, …).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from hil.core import DataError, Source, SpecError, read_json, read_source

Document: TypeAlias = Mapping[str, Any]


def document(path: Path, problems: list[str]) -> Document:
    """Return the JSON object in a file; an empty object if the file is missing or damaged.

    The error of a damaged file is added to the list `problems`.
    """
    if not path.exists():
        return {}
    try:
        return read_json(path)
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return {}


def yaml_source(path: Path, problems: list[str]) -> Source:
    """Return the parsed YAML of a file; without data if the file is missing or damaged."""
    if not path.is_file():
        return Source(str(path))
    try:
        return read_source(path)
    except SpecError as error:
        problems.append(f"{path} cannot be read: {error.message}")
        return Source(str(path))


def as_object(value: Any) -> Document:
    """Return a value that should be a JSON object; an empty object replaces any other value."""
    return value if isinstance(value, dict) else {}


def as_objects(value: Any) -> Sequence[Document]:
    """Return the JSON objects in a list; items of other types are omitted."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def as_float(value: Any) -> float:
    """Return a value that should be a number as a float; NaN replaces any other value."""
    try:
        return float(value) if isinstance(value, int | float) else float("nan")
    except OverflowError:  # an integer that is too large for a float
        return float("nan")


def as_index(value: Any, default: int = -1) -> int:
    """Return a value that should be a small integer; the default replaces any other value."""
    fits = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**31
    return value if fits else default


def as_names(value: Any) -> tuple[str, ...]:
    """Return a list of names as a tuple; an empty tuple replaces any other value."""
    return tuple(str(item) for item in value) if isinstance(value, list) else ()
