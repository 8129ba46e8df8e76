"""Evaluation of expressions in robot programs, as a generator because functions may take ticks."""

from __future__ import annotations

import ast
from collections.abc import Generator, Sequence
from random import Random
from typing import TYPE_CHECKING, Any

from hil.core import CommandRefused
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.motion import ServoJ
from hil_mock_robot.ur.program import IMPATIENT, Registers, Steps, Threaded
from hil_mock_robot.ur.script_functions import ACTIONS, ANSWERS
from hil_mock_robot.ur.script_values import (
    Pose,
    Value,
    combined,
    compared,
    constant,
    effort,
    element,
    listed,
    truth,
)

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_parsing import Statement

Evaluation = Generator[None, None, Value]
TOO_DEEP = "expressions and functions are nested too deeply"
STEPS_PER_TICK = 2000
"""Number of statements and calls after which a program must wait for the next tick."""


class Evaluator(Threaded):
    """Program with variables, functions and the evaluation of expressions.

    Args:
        name: Name of the program.
        patient: Whether the program can wait for ticks; false for a secondary program.

    Attributes:
        registers: Registers shared with clients; set by `begin`.
        servo: Motion of the previous `servoj`; None before the first `servoj`.
        random: Random generator, which yields the same numbers in every run of the program.
    """

    registers: Registers

    def __init__(self, name: str, *, patient: bool = True) -> None:
        super().__init__(name, patient=patient)
        self.servo: ServoJ | None = None
        self.random = Random(name)  # noqa: S311 — not used for security
        self._functions: dict[str, Statement] = {}
        self._scopes: list[dict[str, Value]] = [{}]
        self._steps = 0

    def begin(self, machine: Machine) -> None:
        """See `Program`."""
        self.registers = Registers(machine)
        super().begin(machine)

    def tick(self, machine: Machine) -> bool:
        """See `Program`."""
        self._steps = 0
        try:
            return super().tick(machine)
        except RecursionError:
            machine.fail(TOO_DEEP)
            return False

    def wait(self, ticks: int = 1) -> Steps:
        """Wait for a number of ticks.

        Raises:
            CommandRefused: A secondary program cannot wait.
        """
        if not self.patient:
            raise CommandRefused(IMPATIENT)
        for _ in range(ticks):
            yield

    def _variable(self, name: str) -> Value:
        for scope in (self._scopes[-1], self._scopes[0]):
            if name in scope:
                return scope[name]
        raise CommandRefused(f"there is no variable {name!r}")

    def _value(self, node: ast.expr) -> Evaluation:
        match node:
            case ast.Constant():
                return constant(node.value)
            case ast.Name():
                return self._variable(node.id)
            case ast.List() | ast.Tuple():
                return (yield from self._list(node.elts))
            case ast.Subscript():
                return (yield from self._subscript(node))
            case ast.BinOp():
                left = yield from self._value(node.left)
                right = yield from self._value(node.right)
                yield from self._count(effort(left))
                if isinstance(node.op, ast.BitXor):
                    return truth(left) is not truth(right)
                return combined(type(node.op), left, right)
            case ast.UnaryOp() | ast.BoolOp() | ast.Compare():
                return (yield from self._logic(node))
            case ast.Call():
                return (yield from self._call(node))
        raise CommandRefused(f"the mock does not support this URScript: {type(node).__name__}")

    def _values(self, nodes: Sequence[ast.expr]) -> Generator[None, None, list[Any]]:
        values = []
        for node in nodes:
            values.append((yield from self._value(node)))
        return values

    def _list(self, nodes: Sequence[ast.expr]) -> Generator[None, None, list[Any]]:
        values = yield from self._values(nodes)
        listed(values)
        yield from self._count(effort(values))
        return values

    def _subscript(self, node: ast.Subscript) -> Evaluation:
        if isinstance(node.value, ast.Name) and node.value.id == "p":
            inside = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
            return Pose((yield from self._list(inside)))
        values = yield from self._value(node.value)
        return element(values, (yield from self._value(node.slice)))

    def _logic(self, node: ast.UnaryOp | ast.BoolOp | ast.Compare) -> Evaluation:
        if isinstance(node, ast.UnaryOp):
            value = yield from self._value(node.operand)
            if isinstance(node.op, ast.Not):
                return not truth(value)
            return combined(ast.Sub if isinstance(node.op, ast.USub) else ast.Add, 0, value)
        if isinstance(node, ast.Compare):
            if len(node.ops) != 1:
                raise CommandRefused("a comparison must have two sides")
            left = yield from self._value(node.left)
            return compared(type(node.ops[0]), left, (yield from self._value(node.comparators[0])))
        every = isinstance(node.op, ast.And)
        for operand in node.values:
            if truth((yield from self._value(operand))) is not every:
                return not every
        return every

    def _call(self, node: ast.Call) -> Evaluation:
        yield from self._count()
        name = name_of(node)
        given, named = yield from self._arguments(node)
        if name in self._functions:
            return (yield from self._own(self._functions[name], given, named))
        if name in ANSWERS:
            return ANSWERS[name](self, given, named)
        if name not in ACTIONS:
            raise CommandRefused(f"there is no function {name!r}, or the mock does not support it")
        steps = ACTIONS[name](self, given, named)
        if steps is not None:
            yield from steps
        return None

    def _arguments(
        self, node: ast.Call
    ) -> Generator[None, None, tuple[list[Value], dict[str, Value]]]:
        given = yield from self._values(node.args)
        named = {}
        for keyword in node.keywords:
            named[keyword.arg or ""] = yield from self._value(keyword.value)
        return given, named

    def _own(self, function: Statement, given: list[Value], named: dict[str, Value]) -> Evaluation:
        """Call a function that the program itself defines."""
        raise NotImplementedError

    def _count(self, steps: int = 1) -> Steps:
        """Count steps and wait for the next tick after too many of them.

        A program that never waits would otherwise block the controller.
        """
        self._steps += steps
        if self._steps > STEPS_PER_TICK:
            yield from self.wait()


def name_of(node: ast.Call) -> str:
    """Return the name of the called function; empty if the callee is not a plain name."""
    return node.func.id if isinstance(node.func, ast.Name) else ""
