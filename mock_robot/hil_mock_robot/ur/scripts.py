"""Conversion of an uploaded text into a program: control script of `ur-rtde`, or any URScript."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable

from hil.core import CommandRefused
from hil_mock_robot.ur.control_script import ControlScript
from hil_mock_robot.ur.machine import Machine, Program
from hil_mock_robot.ur.routes import Leg
from hil_mock_robot.ur.script_errors import ScriptError, place_of
from hil_mock_robot.ur.script_evaluation import TOO_DEEP
from hil_mock_robot.ur.script_motions import MOVES, leg_of
from hil_mock_robot.ur.script_names import check_names
from hil_mock_robot.ur.script_parsing import Statement, expression, parse, stripped
from hil_mock_robot.ur.script_program import ScriptProgram
from hil_mock_robot.ur.script_values import Pose, integer

CONTROL = re.compile(r"\s*def\s+rtde_control\s*\(\s*\)\s*:")
OFFSET = re.compile(r"# int register offset\n\s*(\d{1,2})")
PATH = "# inject move path"
UNNAMED = "unnamed"
MOST_LEGS = 100_000


def play(text: str, machine: Machine) -> None:
    """Play a program sent by a client; after a compile error, only stop the present program.

    Args:
        text: URScript text: a `def` or a single statement.
        machine: Controller that plays the program.
    """
    try:
        program = program_of(text, machine)
    except CommandRefused as error:
        machine.halt()
        machine.tell("error", _name(text), error.message, place=place_of(error))
    else:
        machine.play(program)


def program_of(text: str, machine: Machine) -> Program:
    """Return the program of a text.

    Raises:
        CommandRefused: The text does not compile.
    """
    try:
        if CONTROL.match(text) and (offset := OFFSET.search(text)):
            return ControlScript(int(offset[1]), _injected(text))
        return _compiled(text, machine)
    except ScriptError as error:
        raise error.located(text.splitlines()) from error.__cause__


def run_beside(text: str, machine: Machine) -> None:
    """Run a secondary program at once, beside the playing program; it cannot wait or move."""
    name = _name(text)
    try:
        _compiled(text, machine, patient=False).run_at_once(machine)
    except CommandRefused as error:
        if isinstance(error, ScriptError):
            error.located(text.splitlines())
        machine.tell("error", name, error.message, place=place_of(error))
    except RecursionError:
        machine.tell("error", name, TOO_DEEP)


def _compiled(text: str, machine: Machine, *, patient: bool = True) -> ScriptProgram:
    statements = parse(text)
    check_names(statements, machine.series)
    return ScriptProgram(_name(text), _body(statements), text.splitlines(), patient=patient)


def _name(text: str) -> str:
    found = re.match(r"\s*(?:def|sec)\s+([A-Za-z_]\w*)", text)
    return found[1] if found else UNNAMED


def _body(statements: tuple[Statement, ...]) -> tuple[Statement, ...]:
    """Return the statements to execute: the body of the only `def`, or single statements."""
    if len(statements) == 1 and statements[0].kind == "def":
        return statements[0].body
    return statements


def _injected(text: str) -> tuple[tuple[tuple[int, ...], Leg], ...]:
    """Return the path in a control script: moves, each with the progress reported before it."""
    lines = text.splitlines()
    start = next((i for i, line in enumerate(lines) if line.strip() == PATH), len(lines))
    path: list[tuple[tuple[int, ...], Leg]] = []
    marks: list[int] = []
    for number, (name, values, named) in _calls(lines, start + 1):
        if name == "signal_async_progress" and len(values) == 1:
            marks.append(integer(values[0], 0, MOST_LEGS))
        elif name in MOVES:
            path.append((tuple(marks), leg_of(name, values, named)))
            marks = []
        else:
            raise ScriptError(number, f"not a move of a path: {name!r}")
    return tuple(path)


Call = tuple[str, list[object], dict[str, object]]


def _calls(lines: list[str], start: int) -> Iterable[tuple[int, Call]]:
    for number, line in enumerate(lines[start:], start + 1):
        text = stripped(line)
        if text == "end":
            return
        if text:
            yield number, _call(number, text)


def _call(number: int, text: str) -> Call:
    call = expression(number, text)
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
        raise ScriptError(number, f"not a move of a path: {text[:40]!r}")
    try:
        named = {each.arg or "": _literal(each.value) for each in call.keywords}
        return call.func.id, [_literal(each) for each in call.args], named
    except (ValueError, TypeError) as error:
        raise ScriptError(number, f"only numbers are permitted here: {text[:40]!r}") from error


def _literal(node: ast.expr) -> object:
    """Return the value of a number, list or pose."""
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
        return Pose(ast.literal_eval(node.slice))
    return ast.literal_eval(node)
