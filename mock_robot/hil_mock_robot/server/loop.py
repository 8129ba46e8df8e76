"""The loop of a mock server, and mistakes of the mock itself.

One thread does everything, so that nothing needs a lock: a `Loop` makes one turn after the other
until a signal handler or another thread ends it. A mistake of the mock ends one client or one
program, not the whole mock (`Mishaps`); in tests nothing is contained: there it has to be seen.
"""

from __future__ import annotations

import contextlib
import socket
import sys
import traceback
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable


class Loop(ABC):
    """One thread for everything.

    Attributes:
        woken: A socket that is readable once the loop is to turn at once.
    """

    def __init__(self) -> None:
        self._ending = False
        self.woken, self._waker = socket.socketpair()
        for each in (self.woken, self._waker):
            each.setblocking(False)

    @abstractmethod
    def turn(self) -> None:
        """Serve clients, and let due time pass."""

    @abstractmethod
    def leave(self) -> None:
        """Close all connections, and write the last line of the journal."""

    def run(self) -> None:
        """Serve until `end`."""
        try:
            while not self._ending:
                self.turn()
        finally:
            self.close()

    def end(self) -> None:
        """Let `run` return; may be called by a signal handler or another thread."""
        self._ending = True
        self.wake()

    def close(self) -> None:
        """Leave, without having run or after it."""
        self.leave()
        for each in (self.woken, self._waker):
            each.close()

    def wake(self) -> None:
        """Wake the loop from waiting."""
        with contextlib.suppress(OSError):
            self._waker.send(b"x")

    def woke(self) -> None:
        """Note that it has turned."""
        with contextlib.suppress(BlockingIOError):
            self.woken.recv(64)


MOST_TOLD = 20
"""Of what comes again and again; the rest is only counted."""

LONGEST = 200


class Mishaps:
    """Handles unexpected exceptions in the mock.

    Attributes:
        contained: Whether the mock goes on.
        listeners: Called with the place and the text.
        counts: Where and what → how often.
    """

    def __init__(self) -> None:
        self.contained = False
        self.listeners: list[Callable[[str, str], None]] = []
        self.counts: Counter[tuple[str, str]] = Counter()

    def met(self, error: Exception, where: str) -> str:
        """Report an exception; return its text in ASCII, which any protocol can carry.

        Args:
            error: The exception.
            where: The program or client that the mistake ended.

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
        text = lines.encode("ascii", "backslashreplace").decode()
        with contextlib.suppress(OSError, ValueError):
            print(f"mistake of the mock in {where}:\n{text}", file=sys.stderr, flush=True)  # noqa: T201
        for listener in self.listeners:
            listener(where, what)
