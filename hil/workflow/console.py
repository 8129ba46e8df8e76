"""Terminal of the operator: read typed lines and write text.

A read from the terminal does not block longer than requested, because the robot is read while a
question waits for its answer. A background process reads nothing from the terminal. Text that was
typed before a question does not count as its answer. The modules for prompts (`operator`) and for
confirmations (`motion_confirmation`, `arming`) use this module.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import sys
import termios
import time
from collections.abc import Iterable
from textwrap import wrap

WIDEST = 90


class Console:
    """Terminal of a process, from which lines are read; texts are written to standard error.

    A background process (`hil run … &`) reads nothing, because the operating system would suspend
    the whole process, including the control of the robot.

    Args:
        read: Whether typed lines are read from the terminal.
    """

    def __init__(self, *, read: bool = True) -> None:
        self._read = read
        self._typed = b""
        self._ended = False

    @property
    def present(self) -> bool:
        """Whether a terminal at which an operator can answer is attached."""
        return self._read and not self._ended and sys.stdin is not None and sys.stdin.isatty()

    def forget_typed(self) -> None:
        """Discard the text that was typed before a question, because this text is not an answer."""
        self._typed = b""
        if self.present and self._in_foreground():
            with contextlib.suppress(termios.error, OSError):
                termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)

    def line(self, wait_s: float) -> str | None:
        """Return the line typed within `wait_s` [s]; None if the user typed no complete line.

        The returned line has neither a line end nor surrounding white space.
        """
        if not self.present or not self._in_foreground():
            time.sleep(wait_s)
            return None
        if not select.select([sys.stdin.fileno()], [], [], wait_s)[0]:
            return None
        new = os.read(sys.stdin.fileno(), 4096)
        self._ended = not new
        self._typed += new
        line, end, _ = self._typed.partition(b"\n")
        if not end:
            return None
        self._typed = b""
        return line.decode("utf-8", "replace").strip()

    def say(self, *paragraphs: str, ask: str = "") -> None:
        """Write paragraphs and a question, and ring the terminal bell.

        The answer is typed on the line of the question.
        """
        width = min(WIDEST, shutil.get_terminal_size().columns) - 1
        lines = [line for text in paragraphs for line in wrap(text, max(width, 20))]
        start = "\r\x1b[K\a" if sys.stderr.isatty() else "\n"
        sys.stderr.write(start + "".join(f"{line}\n" for line in lines) + ask)
        sys.stderr.flush()

    def show(self, lines: Iterable[str]) -> None:
        """Write lines to the terminal.

        Unprintable characters, such as terminal codes from a robot, are replaced by `?`.
        """
        start = "\r\x1b[K" if sys.stderr.isatty() else ""
        plain = ("".join(c if c.isprintable() else "?" for c in line) for line in lines)
        sys.stderr.write(start + "".join(f"{line}\n" for line in plain))
        sys.stderr.flush()

    @staticmethod
    def _in_foreground() -> bool:
        try:
            return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
        except OSError:  # not the controlling terminal, which alone can suspend the process
            return True
