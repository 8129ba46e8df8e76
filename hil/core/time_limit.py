"""Calls that may take only so long: no driver that hangs may keep a run from its end."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from hil.core.errors import RobotTimeout

_T = TypeVar("_T")

LOOK_EVERY_S = 0.05
ENDS_WITHIN_S = 1.0


class _Call(threading.Thread, Generic[_T]):
    """One call on a thread of its own, which is left behind if it never returns."""

    def __init__(self, call: Callable[[], _T], what: str) -> None:
        super().__init__(name=f"hil-{what}", daemon=True)
        self._call = call
        self.outcome: list[_T] = []
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.outcome.append(self._call())
        except BaseException as error:  # handed on to whoever waits
            self.error = error


def supervised(
    call: Callable[[], _T],
    abandon: threading.Event,
    what: str,
    interrupted: Callable[[], object],
) -> _T:
    """What `call` returns, or raises, unless somebody gives it up meanwhile.

    Args:
        call: Made on a thread of its own.
        abandon: Set when nobody believes in its coming back any more.
        what: For messages.
        interrupted: Called at a `KeyboardInterrupt`, which then goes on its way: makes `call` end.

    Raises:
        RobotTimeout: It was given up; the thread may still be there.
    """
    thread = _Call(call, what)
    thread.start()
    try:
        while thread.is_alive() and not abandon.is_set():
            thread.join(LOOK_EVERY_S)  # in pieces, so that signals are heard in between
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
    """What `call` returns, or raises, unless it takes longer than that.

    Args:
        call: May hang; it is then left behind on its thread.
        seconds: Wall time allowed.
        what: For messages, e.g. `stopping the robot`.

    Raises:
        RobotTimeout: It has not come back.
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
