"""Function calls with a time limit, so that a hanging driver cannot prevent the end of a run."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from hil.core.errors import RobotTimeout

_T = TypeVar("_T")

LOOK_EVERY_S = 0.05
ENDS_WITHIN_S = 1.0
"""Maximum time that an interrupted call may take to end [s]."""


class _Call(threading.Thread, Generic[_T]):
    """Function call on a separate thread, which continues in the background if the call hangs."""

    def __init__(self, call: Callable[[], _T], what: str) -> None:
        super().__init__(name=f"hil-{what}", daemon=True)
        self._call = call
        self.outcome: list[_T] = []
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.outcome.append(self._call())
        except BaseException as error:  # raised again in the waiting caller
            self.error = error


def supervised(
    call: Callable[[], _T],
    abandon: threading.Event,
    what: str,
    interrupted: Callable[[], object],
) -> _T:
    """Return the result of the function `call`, unless the caller abandons it.

    Args:
        call: Function that a separate thread calls.
        abandon: Event that a different thread sets in order to end the waiting.
        what: Description of the call, for messages.
        interrupted: Function that is called at a `KeyboardInterrupt` and that makes `call` end; the
            interrupt is then raised again.

    Raises:
        RobotTimeout: The call was abandoned; its thread is possibly still running.
        BaseException: The function `call` raised this error.
    """
    thread = _Call(call, what)
    thread.start()
    try:
        while thread.is_alive() and not abandon.is_set():
            thread.join(LOOK_EVERY_S)  # short waits, so that signals are handled in between
    except KeyboardInterrupt:
        interrupted()
        thread.join(ENDS_WITHIN_S)
        raise
    if thread.is_alive():
        raise RobotTimeout(
            f"{what} hangs: the driver did not return from a call for seconds",
            hint="check the robot; a driver in a separate process (own_process: true in the "
            "station) cannot block the run",
        )
    if thread.error is not None:
        raise thread.error
    return thread.outcome[0]


def bounded(call: Callable[[], _T], seconds: float, what: str) -> _T:
    """Return the result of the function `call`, unless it exceeds its time limit.

    Args:
        call: Function that possibly hangs; its thread then continues in the background.
        seconds: Maximum wall time of the call [s].
        what: Name of the call for messages, for example `stopping the robot`.

    Raises:
        RobotTimeout: The function did not return within the time limit.
        BaseException: The function `call` raised this error.
    """
    thread = _Call(call, what)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        raise RobotTimeout(
            f"{what} has not returned within {seconds:g} s",
            hint="the driver hangs: check the robot, and use its emergency stop if necessary",
        )
    if thread.error is not None:
        raise thread.error
    return thread.outcome[0]
