"""Arguments of URScript functions, positional or by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from hil.core import CommandRefused

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_evaluation import Evaluator
    from hil_mock_robot.ur.script_values import Value

Given: TypeAlias = Sequence[Any]
Named: TypeAlias = Mapping[str, Any]
Answer: TypeAlias = "Callable[[Evaluator, Given, Named], Value]"
"""URScript function that returns a value and has no other effect."""


def bound(
    function: str,
    given: Given,
    named: Named,
    needed: Sequence[str],
    optional: Mapping[str, Any] | None = None,
) -> list[Any]:
    """Return the arguments in order, with the required arguments first.

    Raises:
        CommandRefused: An argument is missing, unknown or passed twice.
    """
    defaults = dict(optional or {})
    names = [*needed, *defaults]
    found = {**defaults, **dict(zip(names, given, strict=False)), **named}
    twice = [name for name in names[: len(given)] if name in named]
    missing = [name for name in needed if name not in found]
    if len(given) > len(names) or set(found) - set(names) or missing or twice:
        raise CommandRefused(f"{function} takes ({', '.join(names)})")
    return [found[name] for name in names]
