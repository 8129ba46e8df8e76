"""Errors of uploaded programs, with their place in the text and the controller's word for them.

The words are those that URSim sends: a name that nothing defines, at its own column (UR's client
library waits for just that), and a line that is no URScript. Whatever else goes wrong is told in
this project's own words.
"""

from __future__ import annotations

import re

from hil.core import CommandRefused
from hil_mock_robot.ur.machine import NOWHERE, Place

LONGEST_TOKEN = 300


class ScriptError(CommandRefused):
    """What is wrong with a line of a program.

    Args:
        number: Of the line, from 1.
        what: Is wrong, in words.
        name: The name that is wrong, if it is one.
        syntax: Whether the line is no URScript at all.
    """

    def __init__(self, number: int, what: str, *, name: str = "", syntax: bool = False) -> None:
        super().__init__(f"line {number}: {what}")
        self.number, self.name, self.syntax = number, name, syntax
        self.place = Place(max(1, number))

    def located(self, lines: list[str]) -> ScriptError:
        """The same error, which has looked up its column in the text."""
        line = lines[self.number - 1] if 0 < self.number <= len(lines) else ""
        self.place = Place(max(1, self.number), self._column(line), self._token(line))
        return self

    def _column(self, line: str) -> int:
        found = re.search(rf"\b{re.escape(self.name)}\b", line) if self.name else None
        return 1 + (found.start() if found else len(line) - len(line.lstrip()))

    def _token(self, line: str) -> str:
        if self.name:
            return f"compile_error_name_not_found:{self.name}:"[:LONGEST_TOKEN]
        if self.syntax:
            return f"syntax_error_on_line:{self.number}:{line[:LONGEST_TOKEN]}:"
        return ""


def place_of(error: CommandRefused) -> Place:
    """Where an error is, as far as it knows."""
    return error.place if isinstance(error, ScriptError) else NOWHERE
