"""Calls with a time limit, so that a driver that hangs cannot keep a run from its end."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from hil.core.errors import RobotTimeout

_T = TypeVar("_T")

LOOK_EVERY_S = 0.05
ENDS_WITHIN_S = 1.0
"""Time that an interrupted call has to end [s]."""


class _Call(threading.Thread, Generic[_T]):
    """One call on a thread of its own, which stays behind if the call never returns."""

    def __init__(self, call: Callable[[], _T], what: str) -> None:
        super().__init__(name=f"hil-{what}", daemon=True)
        self._call = call
        self.outcome: list[_T] = []
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.outcome.append(self._call())
        except BaseException as error:  # for the caller, who waits
            self.error = error


def supervised(
    call: Callable[[], _T],
    abandon: threading.Event,
    what: str,
    interrupted: Callable[[], object],
) -> _T:
    """Return what `call` returns, unless it is abandoned meanwhile.

    Args:
        call: Runs on a thread of its own.
        abandon: Set by another thread to stop waiting.
        what: Name of the call for messages.
        interrupted: Called at a `KeyboardInterrupt`, to make `call` end; the interrupt is then
            raised again.

    Raises:
        RobotTimeout: It was abandoned; its thread may still run.
        BaseException: What `call` raises.
    """
    thread = _Call(call, what)
    thread.start()
    try:
        while thread.is_alive() and not abandon.is_set():
            thread.join(LOOK_EVERY_S)  # in pieces: signals arrive in between
    except KeyboardInterrupt:
        interrupted()
        thread.join(ENDS_WITHIN_S)
        raise
    if thread.is_alive():
        raise RobotTimeout(
            f"{what} hangs: the driver did not return from a call for seconds",
            hint="see to the robot itself; a driver in a process of its own (own_process: true in "
            "the station) cannot take the run with it",
        )
    if thread.error is not None:
        raise thread.error
    return thread.outcome[0]


def bounded(call: Callable[[], _T], seconds: float, what: str) -> _T:
    """Return what `call` returns, unless it takes too long.

    Args:
        call: May hang; it then stays behind on its thread.
        seconds: Wall time allowed [s].
        what: Name of the call for messages, e.g. `stopping the robot`.

    Raises:
        RobotTimeout: It has not returned in time.
        BaseException: What `call` raises.
    """
    thread = _Call(call, what)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        raise RobotTimeout(
            f"{what} has not come back within {seconds:g} s",
            hint="the driver hangs: see to the robot itself, by its emergency stop if need be",
        )
    if thread.error is not None:
        raise thread.error
    return thread.outcome[0]
