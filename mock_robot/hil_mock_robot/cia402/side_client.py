"""One client of the side channel: what it asks, what it has not read yet."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

LONGEST_LINE = 100_000
ANSWER_S = 1.0
"""Wall time a client may leave an answer unread; it is hung up on then."""


class SideClient:
    """Somebody at the other end of a connection; it is never waited for.

    Args:
        line: The connection.
    """

    def __init__(self, line: socket.socket) -> None:
        line.setblocking(False)
        self.line, self._asked, self._answers = line, b"", b""
        self._unread_s = time.monotonic()

    def ask(self, answer: Callable[[bytes], bytes]) -> None:
        """Take what has come, and note the answers.

        Args:
            answer: To one line.

        Raises:
            OSError: It has gone, or asks for too much.
        """
        data = self.line.recv(65_536)
        *lines, self._asked = (self._asked + data).split(b"\n")
        for line in lines:
            if line.strip():
                self._answers += answer(line)
        if not data or len(self._asked) > LONGEST_LINE:
            raise ConnectionError

    def hear(self, now_s: float) -> None:
        """Send what it takes at once.

        Args:
            now_s: Wall time, monotonic.

        Raises:
            OSError: It has gone, or does not read.
        """
        while self._answers:
            try:
                sent = self.line.send(self._answers)
            except BlockingIOError:
                if now_s - self._unread_s > ANSWER_S:
                    raise
                return
            self._answers = self._answers[sent:]
            self._unread_s = now_s
        self._unread_s = now_s
