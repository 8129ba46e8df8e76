"""Values of URScript expressions: numbers, booleans, texts, lists and poses."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hil.core import CommandRefused

Value = bool | int | float | str | list[Any] | None

LONGEST = 10_000
"""Maximum length of a text [characters]."""
MOST_ELEMENTS = 2000
"""Maximum number of elements of a list, including nested lists; a list can be nested once."""
LONGEST_SHOWN = 1000
"""Maximum length of a list in a message [characters]."""
LARGEST_INT = 2**53
LARGEST = 1e9
"""Maximum magnitude of a coordinate or speed; larger numbers only cause overflow."""

_NUMERIC: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Mod: operator.mod,
}
_ORDER: Mapping[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


class Pose(list[Any]):
    """URScript pose `p[x, y, z, rx, ry, rz]`."""


def number(value: Any, what: str = "a number") -> float:
    """Return `value` as a float if it is a finite number.

    Raises:
        CommandRefused: The value is not a finite number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CommandRefused(f"{what} is needed, not {shown(value)}")
    return float(value)


def integer(value: Any, least: int, most: int) -> int:
    """Return `value` as an integer if it is a whole number between `least` and `most`.

    Raises:
        CommandRefused: The value is not a whole number from `least` to `most`.
    """
    found = number(value)
    if found != int(found) or not least <= found <= most:
        raise CommandRefused(f"a whole number from {least} to {most} is needed, not {found:g}")
    return int(found)


def six(value: Any) -> tuple[float, ...]:
    """Return a list of six numbers as a tuple.

    Raises:
        CommandRefused: The value is not a list of six numbers with magnitudes up to `LARGEST`.
    """
    if not isinstance(value, list) or len(value) != 6:
        raise CommandRefused(f"six numbers are needed, not {shown(value)}")
    if not all(abs(number(each)) <= LARGEST for each in value):
        raise CommandRefused(f"too large a number: {shown(value)}")
    return tuple(map(float, value))


def truth(value: Any) -> bool:
    """Return `value` if it is a boolean.

    Raises:
        CommandRefused: The value is not a boolean.
    """
    if not isinstance(value, bool):
        raise CommandRefused(f"True or False is needed, not {shown(value)}")
    return value


def shown(value: Any) -> str:
    """Return the text of a value for messages, as in `textmsg`."""
    if isinstance(value, list):
        inner = ", ".join(shown(each) for each in value[:12])[:LONGEST_SHOWN]
        return ("p[" if isinstance(value, Pose) else "[") + inner + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)[:200]


def listed(values: list[Any]) -> None:
    """Raise if a list is too long or too deeply nested for a program.

    Raises:
        CommandRefused: The list has too many elements, or lists are nested too deeply.
    """
    inner = [each for each in values if isinstance(each, list)]
    if any(isinstance(each, list) for every in inner for each in every):
        raise CommandRefused("lists are nested too deeply")
    if len(values) + sum(map(len, inner)) > MOST_ELEMENTS:
        raise CommandRefused(f"a list has more than {MOST_ELEMENTS} elements")


def copied(value: Any) -> Any:
    """Return a copy of a value, because URScript passes lists by value.

    Raises:
        CommandRefused: The list is too long or too deeply nested.
    """
    if not isinstance(value, list):
        return value
    listed(value)
    return type(value)(type(each)(each) if isinstance(each, list) else each for each in value)


def effort(value: Any) -> int:
    """Return the number of steps that processing a value takes."""
    if not isinstance(value, list):
        return 1
    return 1 + sum(len(each) if isinstance(each, list) else 1 for each in value) // 10


def constant(value: Any) -> Value:
    """Return a number, text or boolean that is a constant in the program.

    Raises:
        CommandRefused: URScript has no such constant.
    """
    if isinstance(value, bool | int | float | str):
        return _bounded(value)
    raise CommandRefused(f"{value!r} is not a value")


def combined(kind: type[ast.operator], left: Any, right: Any) -> Value:
    """Return the result of an operator on two numbers, or on two lists element by element.

    Raises:
        CommandRefused: The operator or the operands are invalid.
    """
    if kind not in _NUMERIC:
        raise CommandRefused(f"unknown operator {kind.__name__}")
    if isinstance(left, list) and isinstance(right, list) and len(left) == len(right):
        pairs = zip(left, right, strict=True)
        return type(left)(combined(kind, a, b) for a, b in pairs) if left else []
    for each in (left, right):
        number(each)
    try:
        return _bounded(_NUMERIC[kind](left, right))
    except ArithmeticError as error:
        raise CommandRefused(f"{shown(left)} and {shown(right)}: {error}") from error


def compared(kind: type[ast.cmpop], left: Any, right: Any) -> bool:
    """Return the result of a comparison.

    Raises:
        CommandRefused: The two values cannot be compared.
    """
    if kind is ast.Eq:
        return bool(left == right)
    if kind is ast.NotEq:
        return bool(left != right)
    if kind not in _ORDER:
        raise CommandRefused(f"unknown comparison {kind.__name__}")
    return _ORDER[kind](number(left), number(right))


def element(values: Any, index: Any) -> Value:
    """Return an element of a list.

    Raises:
        CommandRefused: The list has no such element.
    """
    if not isinstance(values, list) or not values:
        raise CommandRefused(f"{shown(values)} has no elements")
    found: Value = values[integer(index, 0, len(values) - 1)]
    return found


def joined(values: Sequence[Any]) -> str:
    """Return the text that `textmsg` shows for its arguments."""
    return "".join(shown(value) for value in values)[:LONGEST]


def _bounded(value: Any) -> Value:
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > LARGEST_INT:
        value = float(value) if abs(value) < 10**300 else math.inf
    if isinstance(value, float) and not math.isfinite(value):
        raise CommandRefused("a number is too large")
    if isinstance(value, str) and len(value) > LONGEST:
        raise CommandRefused("a text is too long")
    return value  # type: ignore[no-any-return]
