"""The operator's terminal: lines typed at it, text written to it.

Reading never blocks for longer than asked, as the robot is read while a question waits. Nothing is
read by a background process, and what was typed before a question is no answer to it. Prompts
(`operator`) and confirmations (`motion_confirmation`, `arming`) are built on it.
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
    """Lines typed at the terminal; written text goes to standard error.

    A background process (`hil run … &`) reads nothing: the system would suspend all of it, the
    control of the robot included.

    Args:
        read: Whether anything is read at all.
    """

    def __init__(self, *, read: bool = True) -> None:
        self._read = read
        self._typed = b""
        self._ended = False

    @property
    def present(self) -> bool:
        """Whether an operator may sit there."""
        return self._read and not self._ended and sys.stdin is not None and sys.stdin.isatty()

    def forget_typed(self) -> None:
        """Drop what was typed before a question: it is no answer to it."""
        self._typed = b""
        if self.present and self._in_foreground():
            with contextlib.suppress(termios.error, OSError):
                termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)

    def line(self, wait_s: float) -> str | None:
        """Return the line typed within that time [s], without its end; None without one."""
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
        """Write paragraphs, and a question to be answered on the same line; rings the bell."""
        width = min(WIDEST, shutil.get_terminal_size().columns) - 1
        lines = [line for text in paragraphs for line in wrap(text, max(width, 20))]
        start = "\r\x1b[K\a" if sys.stderr.isatty() else "\n"
        sys.stderr.write(start + "".join(f"{line}\n" for line in lines) + ask)
        sys.stderr.flush()

    def show(self, lines: Iterable[str]) -> None:
        """Write lines; unprintable characters, such as terminal codes of a robot, are replaced."""
        start = "\r\x1b[K" if sys.stderr.isatty() else ""
        plain = ("".join(c if c.isprintable() else "?" for c in line) for line in lines)
        sys.stderr.write(start + "".join(f"{line}\n" for line in plain))
        sys.stderr.flush()

    @staticmethod
    def _in_foreground() -> bool:
        try:
            return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
        except OSError:  # not the terminal that controls this process: it cannot suspend it
            return True
