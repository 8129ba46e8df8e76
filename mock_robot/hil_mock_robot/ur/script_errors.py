"""Errors of uploaded programs, with their position in the text and the controller's own token.

URSim sends one token for an undefined name, with the column of the name, and one token for a line
that is not URScript; UR's client library waits for the token of an undefined name. Other errors
have messages of this project.
"""

from __future__ import annotations

import re

from hil.core import CommandRefused
from hil_mock_robot.ur.machine import NOWHERE, Place

LONGEST_TOKEN = 300


class ScriptError(CommandRefused):
    """Error in a line of a program.

    Args:
        number: Line number, from 1.
        what: Description of the error.
        name: Undefined name, if the error is about a name.
        syntax: Whether the error is a line that is not URScript.
    """

    def __init__(self, number: int, what: str, *, name: str = "", syntax: bool = False) -> None:
        super().__init__(f"line {number}: {what}")
        self.number, self.name, self.syntax = number, name, syntax
        self.place = Place(max(1, number))

    def located(self, lines: list[str]) -> ScriptError:
        """Return this error after setting its column and token from the text."""
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
    """Return the position of an error, or `NOWHERE` if it is unknown."""
    return error.place if isinstance(error, ScriptError) else NOWHERE
