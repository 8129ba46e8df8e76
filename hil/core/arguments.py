"""Arguments of public functions, checked at their entry: a mistake is a `HilError` with a hint."""

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
        f"a path is wanted, not {given!r:.80}",
        hint="give it as text or pathlib.Path; that of a report is its `run`",
    )


def paths_of(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Return a list of paths; a string counts as one path, not as a sequence of characters.

    Raises:
        SpecError: One is neither text nor a path.
    """
    if isinstance(given, str | Path) or not isinstance(given, Iterable):
        return [path_of(given)]
    return [path_of(one) for one in given]


def sources_of(*given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Return paths of recordings, one at least.

    Raises:
        DataError: There is none.
        SpecError: One is neither text nor a path.
    """
    paths = [one for some in given for one in paths_of(some)]
    if not paths:
        raise DataError(
            "no recording was given", hint="give a run directory or an MCAP file (hil.find_runs)"
        )
    return paths


def values_by_name(given: Mapping[str, Any] | None, what: str, example: str) -> dict[str, Any]:
    """Return values by name; none when nothing is given.

    Args:
        given: The argument.
        what: Its name.
        example: What it may look like.

    Raises:
        SpecError: It is no mapping of names.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise SpecError(
            f"{what} is {given!r:.80}, not values by name", hint=f"for example: {example}"
        )
    return dict(given)


def whole_number(given: int, what: str, least: int) -> int:
    """Return a whole number.

    Args:
        given: The argument.
        what: Its name.
        least: The smallest number allowed.

    Raises:
        SpecError: It is no whole number, or too small.
    """
    try:
        number = index(given)
    except TypeError:
        number = least - 1
    if number < least:
        raise SpecError(
            f"{what} is {given!r:.80}, not a whole number from {least} on",
            hint=f"for example: {what}={max(least, 3)}",
        )
    return number
