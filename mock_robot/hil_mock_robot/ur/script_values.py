"""Values of URScript expressions: numbers, truth, texts, lists and poses; nothing else."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hil.core import CommandRefused

Value = bool | int | float | str | list[Any] | None

LONGEST = 10_000
"""Letters of a text."""
MOST_ELEMENTS = 2000
"""Of a list, with those of the lists in it; matrices are as deep as lists may be."""
LONGEST_SHOWN = 1000
"""Letters of a list in a message."""
LARGEST_INT = 2**53
LARGEST = 1e9
"""What no coordinate and no speed is beyond: larger numbers only overflow."""

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
    """URScript `p[x, y, z, rx, ry, rz]`."""


def number(value: Any, what: str = "a number") -> float:
    """`value` if it is a finite number.

    Raises:
        CommandRefused: It is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CommandRefused(f"{what} is needed, not {shown(value)}")
    return float(value)


def integer(value: Any, least: int, most: int) -> int:
    """`value` if it is a whole number between the two.

    Raises:
        CommandRefused: It is none.
    """
    found = number(value)
    if found != int(found) or not least <= found <= most:
        raise CommandRefused(f"a whole number from {least} to {most} is needed, not {found:g}")
    return int(found)


def six(value: Any) -> tuple[float, ...]:
    """Six numbers.

    Raises:
        CommandRefused: They are none.
    """
    if not isinstance(value, list) or len(value) != 6:
        raise CommandRefused(f"six numbers are needed, not {shown(value)}")
    if not all(abs(number(each)) <= LARGEST for each in value):
        raise CommandRefused(f"too large a number: {shown(value)}")
    return tuple(map(float, value))


def truth(value: Any) -> bool:
    """A condition.

    Raises:
        CommandRefused: It is none.
    """
    if not isinstance(value, bool):
        raise CommandRefused(f"True or False is needed, not {shown(value)}")
    return value


def shown(value: Any) -> str:
    """For messages, as `textmsg` shows it."""
    if isinstance(value, list):
        inner = ", ".join(shown(each) for each in value[:12])[:LONGEST_SHOWN]
        return ("p[" if isinstance(value, Pose) else "[") + inner + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)[:200]


def listed(values: list[Any]) -> None:
    """Look whether a list is one that a program may have.

    Raises:
        CommandRefused: They are too many, or lists are too deep in each other.
    """
    inner = [each for each in values if isinstance(each, list)]
    if any(isinstance(each, list) for every in inner for each in every):
        raise CommandRefused("lists are nested too deeply")
    if len(values) + sum(map(len, inner)) > MOST_ELEMENTS:
        raise CommandRefused(f"a list has more than {MOST_ELEMENTS} elements")


def copied(value: Any) -> Any:
    """A value for somebody else to keep: lists are passed on by value.

    Raises:
        CommandRefused: It is a list that cannot be.
    """
    if not isinstance(value, list):
        return value
    listed(value)
    return type(value)(type(each)(each) if isinstance(each, list) else each for each in value)


def effort(value: Any) -> int:
    """Steps that it takes to go through a value."""
    if not isinstance(value, list):
        return 1
    return 1 + sum(len(each) if isinstance(each, list) else 1 for each in value) // 10


def constant(value: Any) -> Value:
    """A number, text or truth that stands in the program.

    Raises:
        CommandRefused: URScript has no such constant.
    """
    if isinstance(value, bool | int | float | str):
        return _bounded(value)
    raise CommandRefused(f"{value!r} is no value")


def combined(kind: type[ast.operator], left: Any, right: Any) -> Value:
    """Two numbers, or two lists added element by element.

    Raises:
        CommandRefused: They cannot be combined so.
    """
    if kind not in _NUMERIC:
        raise CommandRefused(f"no operator {kind.__name__}")
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
    """Whether a comparison holds.

    Raises:
        CommandRefused: The two cannot be compared.
    """
    if kind is ast.Eq:
        return bool(left == right)
    if kind is ast.NotEq:
        return bool(left != right)
    if kind not in _ORDER:
        raise CommandRefused(f"no comparison {kind.__name__}")
    return _ORDER[kind](number(left), number(right))


def element(values: Any, index: Any) -> Value:
    """One of a list.

    Raises:
        CommandRefused: There is no such element.
    """
    if not isinstance(values, list) or not values:
        raise CommandRefused(f"{shown(values)} has no elements")
    found: Value = values[integer(index, 0, len(values) - 1)]
    return found


def joined(values: Sequence[Any]) -> str:
    """What `textmsg` makes of its arguments."""
    return "".join(shown(value) for value in values)[:LONGEST]


def _bounded(value: Any) -> Value:
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > LARGEST_INT:
        value = float(value) if abs(value) < 10**300 else math.inf
    if isinstance(value, float) and not math.isfinite(value):
        raise CommandRefused("a number is too large")
    if isinstance(value, str) and len(value) > LONGEST:
        raise CommandRefused("a text is too long")
    return value  # type: ignore[no-any-return]
