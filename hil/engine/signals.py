"""Handling of Ctrl-C, SIGTERM and a lost terminal as stop requests.

While the robot does not move (planning, fitting), a watched signal raises `StopSignal`. While a run
is guarded, from the creation of its directory to its stop document, watched signals raise no
exception. In a guarded run, the first Ctrl-C requests a pause at the next checkpoint, and the
second Ctrl-C requests an immediate controlled stop. SIGTERM, a lost terminal and a Ctrl-C during a
pause also request a controlled stop. In an unattended run the first Ctrl-C requests a controlled
stop, because no operator could resume the run. The third watched signal of any kind stops the robot
directly and ends the process. A signal that was ignored when the program started (`nohup`) remains
ignored.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType
from typing import Any

from hil.core import Stopped
from hil.engine.engine import Engine, RunState
from hil.engine.reading import stop_robot
from hil.robot import Robot

WATCHED = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
LAST_RESORT_AT = 3
EXIT_CODE = 130


class StopSignal(KeyboardInterrupt):
    """Exception that a watched signal raises while the robot does not move.

    The class is not a subclass of `Exception`, so that no library handles `StopSignal` as an error
    of the library.
    """


class SignalWatch:
    """Handler of the watched signals while its context is open; inactive outside the main thread.

    Args:
        attended: Whether an operator can resume a paused run; otherwise the first Ctrl-C stops it.
    """

    def __init__(self, *, attended: bool = True) -> None:
        self._attended = attended
        self.seen = 0
        self.reason = ""
        self._pressed = False
        self._guarding = False
        self._bound: tuple[Engine, Robot] | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> SignalWatch:
        if threading.current_thread() is threading.main_thread():
            heard = [n for n in WATCHED if signal.getsignal(n) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._handle) for number in heard}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def stopped(self) -> Stopped:
        """Return the stop that the signals requested, as a `Stopped` error."""
        return Stopped(self.reason, by_signal=True)

    @contextlib.contextmanager
    def guard(self) -> Iterator[None]:
        """Collect watched signals without raising and forward them to a bound engine."""
        self._guarding = True
        try:
            yield
        finally:
            self._guarding, self._bound = False, None

    def bind(self, engine: Engine, robot: Robot) -> None:
        """Forward watched signals, including an earlier signal, to this engine."""
        self._bound = (engine, robot)
        if self.seen:
            engine.request_stop(self.reason, by_signal=True)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        name = signal.Signals(number).name
        if self._bound is not None and self._pauses(number):
            self._pressed = True
            self._bound[0].request_pause(f"{name}: press Enter to resume, or Ctrl-C again to stop")
            return
        self.seen += 1
        self.reason = f"stopped by {name}"
        if not self._guarding:
            raise StopSignal(self.reason)
        if self._bound is None:
            return
        engine, robot = self._bound
        if engine.state is RunState.DONE:
            return  # the robot is static, and the stop document is being written
        engine.request_stop(self.reason, by_signal=True)
        if self.seen + (self._pressed and engine.pause_pending) >= LAST_RESORT_AT:
            _last_resort(robot)

    def _pauses(self, number: int) -> bool:
        """Return whether a signal is the first Ctrl-C of a run that can still be paused."""
        assert self._bound is not None
        engine = self._bound[0]
        can = engine.state in (RunState.PREFLIGHT, RunState.ARMED, RunState.RUNNING)
        again = self.seen or (self._pressed and engine.pause_pending)
        return self._attended and number == signal.SIGINT and can and not again


_leaving = threading.Event()


def _last_resort(robot: Robot) -> None:
    """Stop the robot directly and end the process, because the engine possibly hangs in a driver.

    The method `stop` of the robot can hang as well: the call has a time limit, and a further signal
    ends the process immediately.
    """
    try:
        if not _leaving.is_set():
            _leaving.set()
            stop_robot(robot)
    finally:
        os._exit(EXIT_CODE)
