"""Interpreter of uploaded robot programs in a small part of URScript, statement by statement.

The supported part of URScript is listed in docs/reference/mock-ur-control.md. Any statement outside
the supported part ends the program with a runtime error that contains the line number.
"""

from __future__ import annotations

import ast
from collections.abc import Generator, Sequence

from hil.core import CommandRefused
from hil_mock_robot.ur.program import Steps, follow
from hil_mock_robot.ur.routes import Leg
from hil_mock_robot.ur.script_errors import ScriptError
from hil_mock_robot.ur.script_evaluation import Evaluation, Evaluator, name_of
from hil_mock_robot.ur.script_functions import ACTIONS
from hil_mock_robot.ur.script_motions import MOVES, leg_of
from hil_mock_robot.ur.script_parsing import Statement
from hil_mock_robot.ur.script_values import (
    Value,
    copied,
    effort,
    element,
    integer,
    listed,
    truth,
)

DEEPEST_CALL = 30


class Left(Exception):
    """Signal that a block is left by `break`, `continue`, `return` or `halt`."""

    def __init__(self, kind: str, value: Value = None) -> None:
        super().__init__(kind)
        self.kind, self.value = kind, value


class ScriptProgram(Evaluator):
    """Uploaded program of a client.

    Args:
        name: Name in the `def` of the program.
        statements: Statements in the body of the program.
        lines: Lines of the program text, from line 1.
        patient: Whether the program can wait for ticks; false for a secondary program.
    """

    def __init__(
        self, name: str, statements: Sequence[Statement], lines: list[str], *, patient: bool = True
    ) -> None:
        super().__init__(name, patient=patient)
        self._statements, self._lines = statements, lines

    def main(self) -> Steps:
        """Execute all statements of the program in order."""
        try:
            yield from self._block(self._statements)
        except Left:
            return

    def _block(self, statements: Sequence[Statement]) -> Steps:
        at = 0
        while at < len(statements):
            try:
                legs = yield from self._blended(statements, at)
                if not legs:
                    yield from self._statement(statements[at])
                    at += 1
                    continue
                yield from follow(self, legs)
                at += len(legs)
            except CommandRefused as error:
                raise self._placed(error, statements[at].line) from error

    def _blended(
        self, statements: Sequence[Statement], at: int
    ) -> Generator[None, None, list[Leg]]:
        """Return the moves from statement `at` on that are blended without a stop."""
        legs: list[Leg] = []
        for statement in (statements[i] for i in range(at, len(statements))):
            call = statement.value
            if statement.kind != "call" or not isinstance(call, ast.Call):
                break
            if name_of(call) not in MOVES:
                break
            given, named = yield from self._arguments(call)
            legs.append(leg_of(name_of(call), given, named))
            if legs[-1].radius == 0:
                break
        return legs

    def _statement(self, statement: Statement) -> Steps:
        yield from self._count()
        kind, value = statement.kind, statement.value
        if kind in ("break", "continue", "halt"):
            raise Left(kind)
        if kind == "return":
            raise Left(kind, None if value is None else (yield from self._value(value)))
        if kind == "def":
            self._functions[str(statement.target)] = statement
        elif kind == "while":
            yield from self._while(statement)
        elif value is not None and kind == "if":
            chosen = truth((yield from self._value(value)))
            yield from self._block(statement.body if chosen else statement.orelse)
        elif value is not None:
            result = yield from self._value(value)
            if kind == "assign":
                yield from self._assign(statement.target, result)

    def _while(self, statement: Statement) -> Steps:
        assert statement.value is not None
        while truth((yield from self._value(statement.value))):
            try:
                yield from self._block(statement.body)
            except Left as left:
                if left.kind == "break":
                    return
                if left.kind != "continue":
                    raise
            yield from self._count()

    def _assign(self, target: object, value: Value) -> Steps:
        if isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name):
            index = yield from self._value(target.slice)
            if target.value.id == "digital_out":
                ACTIONS["set_digital_out"](self, [index, value], {})
                return
            values = self._variable(target.value.id)
            element(values, index)
            assert isinstance(values, list)
            values[integer(index, 0, len(values) - 1)] = copied(value)
            yield from self._count(effort(values))
            listed(values)
            return
        if not isinstance(target, ast.Name):
            raise CommandRefused("only a variable or an element of a list can be assigned")
        yield from self._count(effort(value))
        scope = self._scopes[0] if target.id in self._scopes[0] else self._scopes[-1]
        scope[target.id] = copied(value)

    def _own(self, function: Statement, given: list[Value], named: dict[str, Value]) -> Evaluation:
        names = function.parameters
        if len(self._scopes) > DEEPEST_CALL:
            raise CommandRefused("functions call each other too deeply")
        bound = {**dict(zip(names, given, strict=False)), **named}
        if len(given) > len(names) or set(bound) != set(names):
            raise CommandRefused(f"{function.target} takes {len(names)} arguments")
        for value in bound.values():
            yield from self._count(effort(value))
        self._scopes.append({name: copied(value) for name, value in bound.items()})
        try:
            yield from self._block(function.body)
        except Left as left:
            if left.kind != "return":
                raise
            return left.value
        finally:
            self._scopes.pop()
        return None

    def _placed(self, error: CommandRefused, line: int) -> ScriptError:
        """Return the error with its line number, unless the error already has a line number."""
        if isinstance(error, ScriptError):
            return error
        return ScriptError(line, error.message).located(self._lines)
