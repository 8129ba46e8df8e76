"""Script text as it comes over a connection: cut into programs, which are played.

Some lines are no URScript: they act on the controller, beside any program (`LINES`). No page of the
maker lists them all; these are the ones that clients send (UR's client library, python-urx and its
predecessors).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping

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


SPEED = "set speed "


def _nothing(machine: Machine) -> None:
    """Accepted without effect: the mock has no second arm to simulate, and nobody pushes it."""


def _run(machine: Machine) -> None:
    """Switch on and release the brakes; an arm that runs already goes on with what it does."""
    machine.modes.release_brakes()


LINES: Mapping[str, Callable[[Machine], object]] = {
    "pause program": lambda machine: machine.pause(),
    "power off": lambda machine: machine.modes.power_off(),
    "power on": lambda machine: machine.modes.power_on(),
    "resume program": lambda machine: machine.resume(),
    "run program": _nothing,
    "set real": _nothing,
    "set robotmode freedrive": _nothing,
    "set robotmode run": _run,
    "set sim": _nothing,
    "set unlock protective stop": lambda machine: machine.modes.unlock(),
    "stop program": lambda machine: machine.halt(),
}


def obey(line: str, machine: Machine) -> bool:
    """Do what a line says; False when it is none of these, and so a program.

    Args:
        line: Without comment and space around it.
        machine: The controller.
    """
    words = " ".join(line.split())
    if words.startswith(SPEED):
        return _set_speed(words.removeprefix(SPEED), machine)
    action = LINES.get(words)
    if action is None:
        return False
    action(machine)
    return True


def _set_speed(text: str, machine: Machine) -> bool:
    try:
        fraction = float(text)
    except ValueError:
        return False
    if math.isfinite(fraction):
        machine.speed_fraction = min(max(fraction, 0.0), 1.0)
    return True
