"""What the functions of the API take: paths, and parameters as people type them.

Whatever else is given is told as a `SpecError` here, where it is known what was meant.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from hil.core.errors import DataError, SpecError

if TYPE_CHECKING:
    from hil.arms.payload import Payload

AnyPath = str | Path
AnyPayload: TypeAlias = "str | float | Payload"
"""`MASS` or `MASS,X,Y,Z` [kg, m], the mass alone as a number [kg], or a `hil.arms.Payload`."""


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


def sources_of(*given: AnyPath | Iterable[AnyPath]) -> list[Path]:
    """Paths of recordings, one at least.

    Raises:
        DataError: There is none.
        SpecError: They are no paths.
    """
    found = [one for some in given for one in paths(some)]
    if not found:
        raise DataError(
            "no recording was given", hint="give a run directory or an MCAP file (hil.find_runs)"
        )
    return found


def payload_of(given: AnyPayload | None) -> Payload | None:
    """A load, as `--payload` reads it; that of a mass alone is at the flange's origin.

    Returns:
        None when nothing was said; of 0, that nothing is mounted.

    Raises:
        SpecError: It is none.
    """
    if given is None:
        return None
    from hil.arms.payload import Payload
    from hil.evaluation.fitting import parse_payload

    if isinstance(given, Payload):
        read = parse_payload(",".join(f"{number}" for number in (given.mass, *given.com)))
        return replace(read, inertia=given.inertia)
    return parse_payload(f"{given}")


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


def waivers_of(given: Mapping[str, str] | None) -> dict[str, str]:
    """Why which check's failure is accepted; a waiver without a reason is none.

    Raises:
        SpecError: They are no reasons by check.
    """
    example = "{'disk': 'another disk comes on Monday'}"
    waivers = mapping(given, "waivers", example)
    for check, reason in waivers.items():
        if not (isinstance(reason, str) and reason.strip()):
            raise SpecError(
                f"the waiver of {check!r} gives no reason", hint=f"for example: waivers={example}"
            )
    return {check: reason.strip() for check, reason in waivers.items()}


def whole(given: int, what: str, least: int) -> int:
    """A whole number.

    Raises:
        SpecError: It is none, or too small.
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


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """`name=value` texts to a dict; values are read as YAML scalars."""
    from hil.core.yaml_values import scalar

    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}
