"""Parameters of the separation study, checked one by one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hil.core import SpecError
from hil.estimators import choice, number, whole
from hil.networks import Mlp

INPUTS = 4


def layouts(name: str, given: Any) -> list[list[int]]:
    """A list of layouts.

    Raises:
        SpecError: It is none, or one of them is none.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of layouts")
    return [layout(f"{name}[{i}]", one) for i, one in enumerate(given)]


def layout(name: str, given: Any) -> list[int]:
    """Units per layer, four inputs first and one output last.

    Raises:
        SpecError: It is no such list.
    """
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise SpecError(f"{name} is {given!r}, but must be a list of whole numbers")
    layers = [whole(name, units, at_least=1) for units in given]
    try:
        Mlp(layers)
    except SpecError as error:
        raise SpecError(f"{name}: {error.message}", hint=error.hint) from error
    if layers[0] != INPUTS:
        raise SpecError(
            f"{name} begins with {layers[0]}, but the paper's networks have {INPUTS} inputs, q2…q5"
        )
    return layers


def words(name: str, given: Any, known: Sequence[str]) -> list[str]:
    """Some of the known words, in the order of those.

    Raises:
        SpecError: It is no list, is empty, or holds another word.
    """
    if isinstance(given, str) or not isinstance(given, Sequence) or not given:
        raise SpecError(f"{name} is {given!r}, but must be a list of {', '.join(known)}")
    chosen = {choice(name, word, known) for word in given}
    return [word for word in known if word in chosen]


def share(name: str, given: Any) -> float | None:
    """A share in per cent, above 0 and below 100; None stays None.

    Raises:
        SpecError: It is none.
    """
    if given is None:
        return None
    found = number(name, given, above=0.0)
    if found >= 100.0:
        raise SpecError(f"{name} is {given!r}, but must be below 100")
    return found
