"""Stopping an arm without the library that moves it: a program that stops replaces the other."""

from __future__ import annotations

import contextlib
import socket
import time

from hil.core import RobotFault
from hil_drivers.ur.dashboard import Dashboard

SCRIPT_PORT, DASHBOARD_PORT = 30003, 29999
WITHIN_S = 0.05
"""For both ports together; a host that does not answer is not waited for any longer [s]."""

ANSWER_S = 1.0
"""How long the dashboard may take for an answer, where one is waited for [s]."""

READ_S = 0.01
"""How long the controller is given to take a program before the line is closed [s]."""


def stop_directly(address: str, deceleration: float, within_s: float = WITHIN_S) -> bool:
    """Tell the controller to come to rest; from any thread, without a lock.

    Args:
        address: Of the controller.
        deceleration: Of the leading joint [rad/s²].
        within_s: Wall time this may take.

    Returns:
        Whether at least one of the two ways could be told.
    """
    until = time.monotonic() + within_s
    program = f"def hil_stop():\n  stopj({deceleration:.3f})\nend\n".encode()
    told = _tell(address, SCRIPT_PORT, program, until)
    # What the dashboard does would cut the ramp short that was just asked for: only where it could
    # not be asked for. In local control both take connections and ignore what they are told; an
    # arm that does not come to rest tells, and whoever watches it then calls `stop_program`.
    return told or stop_program(address, until)


def stop_program(address: str, until: float | None = None) -> bool:
    """Tell the dashboard to stop whatever program there is; the controller brakes the arm."""
    until = time.monotonic() + WITHIN_S if until is None else until
    return _tell(address, DASHBOARD_PORT, b"stop\n", until)


def end_program(address: str) -> None:
    """End whatever program there is, also a paused one, and hear that it has ended.

    Raises:
        RobotFault: The controller does not do that.
        RobotConnectionError: It does not answer.
    """
    with Dashboard(address, ANSWER_S) as dashboard:
        answer = dashboard.ask("stop")
        if answer.lower().startswith("stopped"):
            return
        state = dashboard.ask("programState")
    if not state.upper().startswith("STOPPED"):
        raise RobotFault(
            f"{address}: the robot program cannot be ended, it is {state}: {answer}",
            hint="stop it at the teach pendant before a stop is unlocked: it would go on",
        )


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
    """Closing with unread bytes resets a line, which may overtake what was just sent on it."""
    until = min(until, time.monotonic() + READ_S)
    with contextlib.suppress(OSError):
        while (left := until - time.monotonic()) > 0:
            line.settimeout(left)
            if not line.recv(4096):
                return
