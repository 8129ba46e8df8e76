"""A run's small files, read leniently.

A report is most wanted of a run that went wrong, so nothing here raises for a bad value: what is
absent is empty, what is damaged is empty and named in `problems`, and a value of another type
than expected counts as absent (`as_object`, `as_float`, …).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from hil.core import DataError, Source, SpecError, read_json, read_source

Document: TypeAlias = Mapping[str, Any]


def document(path: Path, problems: list[str]) -> Document:
    """The JSON object in a file; empty when absent or damaged, the latter added to `problems`."""
    if not path.exists():
        return {}
    try:
        return read_json(path)
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return {}


def yaml_source(path: Path, problems: list[str]) -> Source:
    """Return the parsed YAML of a file; without data when it is absent or damaged."""
    if not path.is_file():
        return Source(str(path))
    try:
        return read_source(path)
    except SpecError as error:
        problems.append(f"{path} cannot be read: {error.message}")
        return Source(str(path))


def as_object(value: Any) -> Document:
    """A value where an object is expected; anything else is an empty one."""
    return value if isinstance(value, dict) else {}


def as_objects(value: Any) -> Sequence[Document]:
    """The objects of a list; whatever else is in it is left out."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def as_float(value: Any) -> float:
    """A value where a number is expected; anything else is NaN."""
    try:
        return float(value) if isinstance(value, int | float) else float("nan")
    except OverflowError:  # a whole number of hundreds of digits
        return float("nan")


def as_index(value: Any, default: int = -1) -> int:
    """A value where a small whole number is expected; anything else is the default."""
    fits = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**31
    return value if fits else default


def as_names(value: Any) -> tuple[str, ...]:
    """A list of names."""
    return tuple(str(item) for item in value) if isinstance(value, list) else ()
