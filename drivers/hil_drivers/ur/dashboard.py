"""Text interfaces of a UR controller: the dashboard server and the port that accepts programs.

The dashboard server (port 29999) answers every request line with one line. `stop_directly` stops an
arm without the library that moves it: it sends a stop program to port 30003, which replaces the
running program. `stop_directly` can be called from any thread and uses no lock.
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
    """Connection to the dashboard server, used as a context manager.

    Args:
        address: Address of the controller.
        within_s: Timeout for the connection and for every answer [s].

    Raises:
        RobotConnectionError: No dashboard server answers.
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
        """Send a command; return the answer without the line end, empty for an unknown command.

        Raises:
            RobotConnectionError: The server closed the connection, or did not answer in time.
        """
        try:
            self._line.sendall(f"{command}\n".encode())
        except OSError as error:
            raise self._problem(f"closed the connection: {error}") from error
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
                raise self._problem(
                    "closed the connection" if not more else "sent a line without an end"
                )
            self._waiting += more
        line, _, self._waiting = self._waiting.partition(b"\n")
        return line.decode("utf-8", "replace").strip()

    def _problem(self, what: str) -> RobotConnectionError:
        return RobotConnectionError(
            f"the dashboard server at {self._peer} {what}",
            hint=mock_first(self._address, "ur")
            + "check that the controller is on, its address right and the dashboard server enabled "
            "in the security settings",
        )


SCRIPT_PORT = 30003

STOP_S = 0.05
"""Time limit [s] of a direct stop, for the script port and the dashboard port together."""

END_S = 1.0
"""Timeout [s] of each answer of the dashboard server while a program is ended."""

FLUSH_S = 0.01
"""Time [s] for the controller to read a program before the driver closes the connection."""


def stop_directly(address: str, deceleration: float) -> bool:
    """Stop the arm by a separate script, from any thread and without a lock.

    Args:
        address: Address of the controller.
        deceleration: Deceleration of the leading joint [rad/s²].

    Returns:
        Whether the stop script or the dashboard command could be sent.
    """
    until = time.monotonic() + STOP_S
    program = f"def hil_stop():\n  stopj({deceleration:.3f})\nend\n".encode()
    sent = _send(address, SCRIPT_PORT, program, until)
    # A dashboard stop would interrupt the ramp of the script, so it is sent only if the script
    # could not be sent. In local control both ports accept connections and ignore the data; the
    # supervision then detects that the arm does not come to rest and calls `stop_program`.
    return sent or stop_program(address, until)


def _send(address: str, port: int, text: bytes, until: float) -> bool:
    left = until - time.monotonic()
    with (
        contextlib.suppress(OSError),
        socket.create_connection((address, port), max(left, 0.005)) as line,
    ):
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        line.sendall(text)
        _read_briefly(line, until)
        return True
    return False


def _read_briefly(line: socket.socket, until: float) -> None:
    """Read and discard received bytes until the time `until`, for at most `FLUSH_S`.

    Closing a connection with unread bytes resets the connection, and the reset can discard data
    that were already sent.
    """
    until = min(until, time.monotonic() + FLUSH_S)
    with contextlib.suppress(OSError):
        while (left := until - time.monotonic()) > 0:
            line.settimeout(left)
            if not line.recv(4096):
                return


def stop_program(address: str, until: float | None = None) -> bool:
    """Stop a program by a dashboard command; the controller then brakes the arm."""
    until = time.monotonic() + STOP_S if until is None else until
    return _send(address, DASHBOARD_PORT, b"stop\n", until)


def end_program(address: str) -> None:
    """End a playing or paused program, and wait until the dashboard server confirms the end.

    Raises:
        RobotFault: The controller does not end the program.
        RobotConnectionError: The dashboard server does not answer.
    """
    with Dashboard(address, END_S) as dashboard:
        answer = dashboard.ask("stop")
        if answer.lower().startswith("stopped"):
            return
        state = dashboard.ask("programState")
    if not state.upper().startswith("STOPPED"):
        raise RobotFault(
            f"{address}: the robot program cannot be ended, it is {state}: {answer}",
            hint="stop the program at the teach pendant before unlocking a stop: it would resume",
        )
