"""Check of a program for undefined names, for which a controller refuses the whole program."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping, Set

from hil_mock_robot.ur.rtde_variables import Series
from hil_mock_robot.ur.script_errors import ScriptError
from hil_mock_robot.ur.script_functions import ACTIONS, ANSWERS
from hil_mock_robot.ur.script_motions import MOVES
from hil_mock_robot.ur.script_parsing import Statement

SINCE: Mapping[str, tuple[tuple[int, int] | None, tuple[int, int] | None]] = {
    "get_inverse_kin_has_solution": ((3, 15), (5, 10)),
    "set_target_payload": (None, (5, 10)),
}
"""First software versions of newer functions: CB3, e-Series."""
POSE, OUTPUTS = "p", "digital_out"
FUNCTIONS = frozenset((*ACTIONS, *ANSWERS, *MOVES))


def check_names(statements: Iterable[Statement], series: Series) -> None:
    """Raise if a name is neither assigned in the program nor defined by the controller.

    Args:
        statements: Statements of the program.
        series: Controller software, which determines the available functions.

    Raises:
        ScriptError: A name is undefined.
    """
    every = list(_flat(statements))
    absent = {name for name, since in SINCE.items() if not series.at_least(*since)}
    functions = (FUNCTIONS - absent) | {str(s.target) for s in every if s.kind == "def"}
    variables = {POSE, OUTPUTS}
    for statement in every:
        variables.update(statement.parameters)
        if isinstance(statement.target, ast.Name):
            variables.add(statement.target.id)
    for statement in every:
        _check(statement, functions, variables)


def _flat(statements: Iterable[Statement]) -> Iterator[Statement]:
    for statement in statements:
        yield statement
        yield from _flat(statement.body)
        yield from _flat(statement.orelse)


def _check(statement: Statement, functions: Set[str], variables: Set[str]) -> None:
    for name, called in _names(statement):
        if called and name not in functions:
            what = f"there is no function {name!r}, or the mock does not support it"
            raise ScriptError(statement.line, what, name=name)
        if not called and name not in variables and name not in functions:
            raise ScriptError(statement.line, f"there is no variable {name!r}", name=name)


def _names(statement: Statement) -> Iterator[tuple[str, bool]]:
    """Yield every name in a statement, and whether it is called."""
    for root in (statement.target, statement.value):
        if not isinstance(root, ast.expr):
            continue
        called = set()
        for node in ast.walk(root):
            if isinstance(node, ast.Call):
                called.add(node.func)
            elif isinstance(node, ast.Name):
                yield node.id, node in called
