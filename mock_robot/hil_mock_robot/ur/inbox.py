"""Script text as it comes over a connection: cut into programs, which are played."""

from __future__ import annotations

import re

from hil_mock_robot.ur.interface_lines import obey
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.script_parsing import opens_block, stripped
from hil_mock_robot.ur.scripts import play, run_beside

LARGEST_TEXT = 1_000_000
"""Bytes of one program; nobody uploads more."""
MOST_LINES = 20_000
"""Of one program: they are all read between two ticks."""
_BEGINS = re.compile(r"(def|sec)\b")
_SECONDARY = re.compile(r"\s*sec\b")


class ScriptInbox:
    """What one client sends to port 30001, 30002 or 30003.

    A program is over with the `end` of its `def`, or with an `end` at the very left where what is
    inside is indented. A statement outside any `def` is a program of its own. Whatever arrives
    stops the program that plays, except secondary programs (`sec`), which run beside it, and the
    lines of `interface_lines`, which are no program. In local control nothing arrives, as on
    e-Series.

    Args:
        machine: Which plays the programs.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._rest = bytearray()
        self._lines: list[str] = []
        self._size = self._open = 0
        self._indented = self._deaf = False

    def feed(self, data: bytes) -> None:
        """Some bytes came, cut anywhere; after too long a program none of them count any more."""
        if self._deaf:
            return
        self._rest += data
        *lines, rest = self._rest.split(b"\n")
        self._rest = bytearray(rest)
        if len(rest) > LARGEST_TEXT:
            self._drop()
        for line in lines:
            if self._deaf:
                return
            self._take(line.decode("utf-8", "replace").rstrip("\r").replace("\0", ""))

    def _take(self, line: str) -> None:
        bare = stripped(line)
        if not self._lines and not bare:
            return
        self._lines.append(line)
        self._size += len(line) + 1
        if self._size > LARGEST_TEXT or len(self._lines) > MOST_LINES:
            self._drop()
        elif len(self._lines) == 1:
            self._open = int(_BEGINS.match(bare) is not None)
            self._indented = False
        else:
            self._count(line, bare)
        if self._lines and self._open == 0:
            self._play()

    def _count(self, line: str, bare: str) -> None:
        if len(self._lines) == 2:
            self._indented = line[:1].isspace()
        if opens_block(bare):
            self._open += 1
        elif bare == "end":
            outermost = self._indented and not line[:1].isspace()
            self._open = 0 if outermost else self._open - 1

    def _play(self) -> None:
        text = "\n".join(self._lines) + "\n"
        self._forget()
        machine = self._machine
        if machine.series.is_e and not machine.modes.remote:
            return
        if obey(stripped(text) if text.count("\n") == 1 else "", machine):
            return
        if _SECONDARY.match(text):
            run_beside(text, machine)
        else:
            play(text, machine)

    def _drop(self) -> None:
        self._deaf = True
        self._rest.clear()
        self._forget()
        most = f"{LARGEST_TEXT} bytes or {MOST_LINES} lines"
        self._machine.tell("error", text=f"a program is longer than {most}")

    def _forget(self) -> None:
        self._lines, self._size, self._open = [], 0, 0
