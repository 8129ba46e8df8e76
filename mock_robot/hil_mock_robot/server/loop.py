"""Main loop of a mock server, and handling of internal errors of the mock.

A single thread does all work, so no lock is needed: `Loop` makes one turn after the other until a
signal handler or another thread ends the loop. An internal error of the mock ends one client or one
program, not the whole mock (`Mishaps`). In tests, internal errors are not contained, so that they
become visible.
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
    """Main loop of a mock server, which runs in a single thread.

    Attributes:
        woken: Socket that becomes readable when the loop must make its next turn at once.
    """

    def __init__(self) -> None:
        self._ending = False
        self.woken, self._waker = socket.socketpair()
        for each in (self.woken, self._waker):
            each.setblocking(False)

    @abstractmethod
    def turn(self) -> None:
        """Serve clients, and advance device time if a tick is due."""

    @abstractmethod
    def leave(self) -> None:
        """Close all connections, and write the last line of the journal."""

    def run(self) -> None:
        """Make turns until `end` is called."""
        try:
            while not self._ending:
                self.turn()
        finally:
            self.close()

    def end(self) -> None:
        """Let `run` return; a signal handler or another thread can call it."""
        self._ending = True
        self.wake()

    def close(self) -> None:
        """Close connections and sockets; `run` need not have been called before."""
        self.leave()
        for each in (self.woken, self._waker):
            each.close()

    def wake(self) -> None:
        """Wake the loop from its wait for clients or ticks."""
        with contextlib.suppress(OSError):
            self._waker.send(b"x")

    def woke(self) -> None:
        """Clear the wake-up after a turn."""
        with contextlib.suppress(BlockingIOError):
            self.woken.recv(64)


MOST_TOLD = 20
"""Maximum number of different errors that are printed; further errors are only counted."""

LONGEST = 200


class Mishaps:
    """Handler of unexpected exceptions in the mock.

    Attributes:
        contained: Whether the mock continues after an exception.
        listeners: Functions called with the place and the text of an error.
        counts: Map from place and text of an error to the number of its occurrences.
    """

    def __init__(self) -> None:
        self.contained = False
        self.listeners: list[Callable[[str, str], None]] = []
        self.counts: Counter[tuple[str, str]] = Counter()

    def met(self, error: Exception, where: str) -> str:
        """Report an exception; return its text in ASCII, which any protocol can transmit.

        Args:
            error: Exception.
            where: Program or client that is ended by the error.

        Raises:
            Exception: The error itself is raised again, unless errors are contained.
        """
        if not self.contained:
            raise error
        what = ascii(error)[:LONGEST]
        self.counts[where, what] += 1
        if self.counts[where, what] == 1 and len(self.counts) <= MOST_TOLD:
            self._report(error, where, what)
        return what

    def _report(self, error: Exception, where: str, what: str) -> None:
        lines = "".join(traceback.format_exception(error))
        text = lines.encode("ascii", "backslashreplace").decode()
        with contextlib.suppress(OSError, ValueError):
            print(f"internal error of the mock in {where}:\n{text}", file=sys.stderr, flush=True)  # noqa: T201
        for listener in self.listeners:
            listener(where, what)
