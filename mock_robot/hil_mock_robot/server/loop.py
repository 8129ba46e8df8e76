"""Mistakes of the mock itself: they end one client or one program, not the whole mock.

In tests nothing is contained: there a mistake has to be seen.
"""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections import Counter
from collections.abc import Callable

MOST_TOLD = 20
"""Of what comes again and again; the rest is only counted."""

LONGEST = 200


class Mishaps:
    """What becomes of an exception that nobody foresaw.

    Attributes:
        contained: Whether the mock goes on.
        listeners: Told where it happened, and what.
        counts: Where and what → how often.
    """

    def __init__(self) -> None:
        self.contained = False
        self.listeners: list[Callable[[str, str], None]] = []
        self.counts: Counter[tuple[str, str]] = Counter()

    def met(self, error: Exception, where: str) -> str:
        """Tell of it; returns it in plain letters, which nothing that tells it can stumble over.

        Args:
            error: The exception.
            where: What it ended, such as a program or a client.

        Raises:
            Exception: The error itself, unless mishaps are contained.
        """
        if not self.contained:
            raise error
        what = ascii(error)[:LONGEST]
        self.counts[where, what] += 1
        if self.counts[where, what] == 1 and len(self.counts) <= MOST_TOLD:
            self._tell(error, where, what)
        return what

    def _tell(self, error: Exception, where: str, what: str) -> None:
        lines = "".join(traceback.format_exception(error))
        told = lines.encode("ascii", "backslashreplace").decode()
        with contextlib.suppress(OSError, ValueError):
            print(f"mistake of the mock in {where}:\n{told}", file=sys.stderr, flush=True)  # noqa: T201
        for listener in self.listeners:
            listener(where, what)
