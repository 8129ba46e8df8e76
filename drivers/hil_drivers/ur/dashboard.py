"""The dashboard server of a UR controller: one line asked, one line answered (port 29999)."""

from __future__ import annotations

import socket
import time
from types import TracebackType

from hil.core import RobotConnectionError

PORT = 29999
ANSWER_S = 2.0
LONGEST_LINE = 4096
NOT_UNDERSTOOD = "could not understand"


class Dashboard:
    """One conversation, while it is entered.

    Args:
        address: Of the controller.
        within_s: How long connecting, and every answer, may take [s].

    Raises:
        RobotConnectionError: Nobody answers.
    """

    def __init__(self, address: str, within_s: float = ANSWER_S) -> None:
        self._peer, self._within_s = f"{address}:{PORT}", within_s
        self._waiting = b""
        try:
            self._line = socket.create_connection((address, PORT), within_s)
        except OSError as error:
            raise self._problem(f"cannot be reached: {error}") from error
        try:
            self._receive()  # the greeting
        except BaseException:
            self._line.close()
            raise

    def ask(self, command: str) -> str:
        """What it answers, without the line's end; empty when it does not know the command.

        Raises:
            RobotConnectionError: It has hung up, or has not answered in time.
        """
        try:
            self._line.sendall(f"{command}\n".encode())
        except OSError as error:
            raise self._problem(f"has hung up: {error}") from error
        answer = self._receive()
        return "" if answer.lower().startswith(NOT_UNDERSTOOD) else answer

    def __enter__(self) -> Dashboard:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._line.close()

    def _receive(self) -> str:
        until = time.monotonic() + self._within_s
        while b"\n" not in self._waiting:
            try:
                self._line.settimeout(max(1e-3, until - time.monotonic()))
                more = self._line.recv(4096)
            except OSError as error:
                raise self._problem(f"does not answer: {error}") from error
            if not more or len(self._waiting) > LONGEST_LINE:
                raise self._problem("has hung up" if not more else "does not end its line")
            self._waiting += more
        line, _, self._waiting = self._waiting.partition(b"\n")
        return line.decode("utf-8", "replace").strip()

    def _problem(self, what: str) -> RobotConnectionError:
        return RobotConnectionError(
            f"the dashboard server at {self._peer} {what}",
            hint="is the controller on, the address right, and the dashboard server not disabled "
            "in its security settings?",
        )
