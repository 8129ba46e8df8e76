"""Validation of the arguments of public functions: an invalid argument raises a `HilError`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from operator import index
from pathlib import Path
from typing import Any

from hil.core.errors import DataError, SpecError

AnyPath = str | Path


def path_of(given: AnyPath) -> Path:
    """Return one path.

    Raises:
        SpecError: The argument is neither text nor a path.
    """
    if isinstance(given, str | Path):
        return Path(given)
    raise SpecError(
        f"expected a path, got {given!r:.80}",
        hint="pass text or pathlib.Path; the path of a run report is its attribute `run`",
    )


def paths_of(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Return a list of paths; a string counts as one path, not as a sequence of characters.

    Raises:
        SpecError: An entry is neither text nor a path.
    """
    if isinstance(given, str | Path) or not isinstance(given, Iterable):
        return [path_of(given)]
    return [path_of(one) for one in given]


def sources_of(*given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Return the paths of recordings; raise if there is no path.

    Raises:
        DataError: The arguments contain no path.
        SpecError: An entry is neither text nor a path.
    """
    paths = [one for some in given for one in paths_of(some)]
    if not paths:
        raise DataError(
            "no recording was passed", hint="pass a run directory or an MCAP file (hil.find_runs)"
        )
    return paths


def values_by_name(given: Mapping[str, Any] | None, what: str, example: str) -> dict[str, Any]:
    """Return a mapping argument as a dict; empty if the argument is None.

    Args:
        given: Value that the caller passed as the argument.
        what: Name of the argument, for the error message.
        example: Example of a valid value, for the error message.

    Raises:
        SpecError: The argument is not a mapping with texts as keys.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise SpecError(
            f"{what} is {given!r:.80}, not a mapping with texts as keys",
            hint=f"for example: {example}",
        )
    return dict(given)


def whole_number(given: int, what: str, least: int) -> int:
    """Return the value of an argument that must be an integer.

    Args:
        least: Smallest value that is allowed.
        what: Name of the argument, for the error message.
        given: Value that the caller passed as the argument.

    Raises:
        SpecError: The argument is not an integer, or is below `least`.
    """
    try:
        number = index(given)
    except TypeError:
        number = least - 1
    if number < least:
        raise SpecError(
            f"{what} is {given!r:.80}, not a whole number ≥ {least}",
            hint=f"for example: {what}={max(least, 3)}",
        )
    return number
