"""URScript functions of numbers, lists and texts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from hil.core import CommandRefused
from hil_mock_robot.ur.script_arguments import Answer, Given, Named, bound
from hil_mock_robot.ur.script_values import Pose, Value, joined, number, shown

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_evaluation import Evaluator


def _of_numbers(
    name: str, function: Callable[..., float], arguments: tuple[str, ...] = ("f",)
) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        values = [number(each) for each in bound(name, given, named, arguments)]
        try:
            found = function(*values)
            # `number` raises for a non-finite or complex result.
            return found if isinstance(found, int) else number(found)
        except (ArithmeticError, ValueError) as error:
            said = ", ".join(f"{each:g}" for each in values)
            raise CommandRefused(f"{name}({said}): {error}") from error

    return answer


def _log(base: float, value: float) -> float:
    return math.log(value, base)


def _norm(program: Evaluator, given: Given, named: Named) -> Value:
    (value,) = bound("norm", given, named, ["a"])
    if not isinstance(value, list):
        return abs(number(value))
    return math.hypot(*(number(each) for each in value[: 3 if isinstance(value, Pose) else None]))


def _random(program: Evaluator, given: Given, named: Named) -> Value:
    """Return the next random number.

    The numbers are the same in every run of a program, so tests are repeatable.
    """
    bound("random", given, named, [])
    return program.random.random()


def _length(name: str, argument: str, *kinds: type[list[Any]] | type[str]) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        (value,) = bound(name, given, named, [argument])
        if not isinstance(value, kinds):
            raise CommandRefused(f"{name} of {shown(value)}")
        return len(value)

    return answer


def _to_str(program: Evaluator, given: Given, named: Named) -> Value:
    (value,) = bound("to_str", given, named, ["val"])
    return shown(value)


def _str_cat(program: Evaluator, given: Given, named: Named) -> Value:
    return joined(given)


MATHS: dict[str, Answer] = {
    "acos": _of_numbers("acos", math.acos),
    "asin": _of_numbers("asin", math.asin),
    "atan": _of_numbers("atan", math.atan),
    "atan2": _of_numbers("atan2", math.atan2, ("x", "y")),
    "ceil": _of_numbers("ceil", math.ceil),
    "cos": _of_numbers("cos", math.cos),
    "d2r": _of_numbers("d2r", math.radians),
    "floor": _of_numbers("floor", math.floor),
    "get_list_length": _length("get_list_length", "v", list),
    "length": _length("length", "v", list, str),
    "log": _of_numbers("log", _log, ("b", "f")),
    "norm": _norm,
    "pow": _of_numbers("pow", math.pow, ("base", "exponent")),
    "r2d": _of_numbers("r2d", math.degrees),
    "random": _random,
    "sin": _of_numbers("sin", math.sin),
    "sqrt": _of_numbers("sqrt", math.sqrt),
    "str_cat": _str_cat,
    "str_len": _length("str_len", "str", str),
    "tan": _of_numbers("tan", math.tan),
    "to_str": _to_str,
}
