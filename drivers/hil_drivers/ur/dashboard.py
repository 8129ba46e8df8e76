"""The text interfaces of a UR controller: its dashboard server, and the port that takes programs.

A dashboard line asked is a line answered (port 29999). `stop_directly` stops an arm without the
library that moves it: a program that stops, sent to port 30003, replaces whatever program runs.
It works from any thread and takes no lock.
"""

from __future__ import annotations

import contextlib
import socket
import time
from types import TracebackType

from hil.core import RobotConnectionError, RobotFault
from hil_drivers.network import mock_first

DASHBOARD_PORT = 29999
ANSWER_S = 2.0
LONGEST_LINE = 4096
NOT_UNDERSTOOD = "could not understand"


class Dashboard:
    """One conversation, while it is entered.

    Args:
        address: Of the controller.
        within_s: How long connecting, and every answer, may take [s].

    Raises:
        RobotConnectionError: No dashboard answers.
    """

    def __init__(self, address: str, within_s: float = ANSWER_S) -> None:
        self._address, self._peer = address, f"{address}:{DASHBOARD_PORT}"
        self._within_s, self._waiting = within_s, b""
        try:
            self._line = socket.create_connection((address, DASHBOARD_PORT), within_s)
        except OSError as error:
            raise self._problem(f"cannot be reached: {error}") from error
        try:
            self._receive()  # the greeting
        except BaseException:
            self._line.close()
            raise

    def ask(self, command: str) -> str:
        """Return the answer without the line's end; empty if the command is unknown.

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
            hint=mock_first(self._address, "ur")
            + "is the controller on, the address right, and the dashboard server not disabled "
            "in its security settings?",
        )


SCRIPT_PORT = 30003

STOP_S = 0.05
"""For both ports together; a host that does not answer is not waited for any longer [s]."""

END_S = 1.0
"""How long the dashboard may take for an answer, where one is waited for [s]."""

FLUSH_S = 0.01
"""How long the controller is given to take a program before the line is closed [s]."""


def stop_directly(address: str, deceleration: float) -> bool:
    """Stop the arm by a script of its own; for any thread, without a lock.

    Args:
        address: Of the controller.
        deceleration: Of the leading joint [rad/s²].

    Returns:
        Whether at least one of the two ways could be sent.
    """
    until = time.monotonic() + STOP_S
    program = f"def hil_stop():\n  stopj({deceleration:.3f})\nend\n".encode()
    sent = _tell(address, SCRIPT_PORT, program, until)
    # What the dashboard does would cut the ramp short that was just asked for: only where it could
    # not be asked for. In local control both take connections and ignore what they are sent; an
    # arm that does not come to rest tells, and whoever watches it then calls `stop_program`.
    return sent or stop_program(address, until)


def _tell(address: str, port: int, text: bytes, until: float) -> bool:
    left = until - time.monotonic()
    with (
        contextlib.suppress(OSError),
        socket.create_connection((address, port), max(left, 0.005)) as line,
    ):
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        line.sendall(text)
        _listen_briefly(line, until)
        return True
    return False


def _listen_briefly(line: socket.socket, until: float) -> None:
    """Read for a moment: closing with unread bytes resets a line, and may discard sent data."""
    until = min(until, time.monotonic() + FLUSH_S)
    with contextlib.suppress(OSError):
        while (left := until - time.monotonic()) > 0:
            line.settimeout(left)
            if not line.recv(4096):
                return


def stop_program(address: str, until: float | None = None) -> bool:
    """Stop any program by the dashboard; the controller brakes the arm."""
    until = time.monotonic() + STOP_S if until is None else until
    return _tell(address, DASHBOARD_PORT, b"stop\n", until)


def end_program(address: str) -> None:
    """End any program, also a paused one, and wait for the confirmation.

    Raises:
        RobotFault: The controller does not do that.
        RobotConnectionError: It does not answer.
    """
    with Dashboard(address, END_S) as dashboard:
        answer = dashboard.ask("stop")
        if answer.lower().startswith("stopped"):
            return
        state = dashboard.ask("programState")
    if not state.upper().startswith("STOPPED"):
        raise RobotFault(
            f"{address}: the robot program cannot be ended, it is {state}: {answer}",
            hint="stop it at the teach pendant before a stop is unlocked: it would go on",
        )
