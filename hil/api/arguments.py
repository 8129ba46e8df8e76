"""What the functions of the API take: paths, and parameters as people type them.

Whatever else is given is told as a `SpecError` here, where it is known what was meant.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hil.errors import DataError, SpecError

AnyPath = str | Path


def path(given: AnyPath) -> Path:
    """One path.

    Raises:
        SpecError: It is none.
    """
    if isinstance(given, str | Path):
        return Path(given)
    raise SpecError(
        f"a path is wanted, not {given!r:.80}",
        hint="give it as text or pathlib.Path; that of a report is its `run`",
    )


def paths(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """One path or several; a text is a path, not a row of letters.

    Raises:
        SpecError: They are none.
    """
    if isinstance(given, str | Path) or not isinstance(given, Iterable):
        return [path(given)]
    return [path(one) for one in given]


def sources_of(given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Paths of recordings, one at least.

    Raises:
        DataError: There is none.
        SpecError: They are no paths.
    """
    found = paths(given)
    if not found:
        raise DataError(
            "no recording was given", hint="give a run directory or an MCAP file (hil.find_runs)"
        )
    return found


def mapping(given: Mapping[str, Any] | None, what: str, example: str) -> dict[str, Any]:
    """Values by name; none when nothing is given.

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


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """`name=value` texts to a dict; values are read as YAML scalars."""
    from hil.spec.yaml_values import scalar

    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}
