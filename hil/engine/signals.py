"""Ctrl-C, SIGTERM and a lost terminal become stop requests, not exceptions in a command.

While nothing moves (planning, fitting, reporting) a signal raises `StopSignal`. While an
engine is guarded, the first and second signal ask it for a controlled stop, which nothing can
interrupt any more; the third tells the robot to stop directly and ends the process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from types import FrameType, TracebackType
from typing import Any

from hil.engine.engine import Engine
from hil.errors import Stopped
from hil.robot import Robot

WATCHED = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
LAST_RESORT_AT = 3
EXIT_CODE = 130


class StopSignal(KeyboardInterrupt):
    """A watched signal came while nothing moved.

    No `Exception`, so that no library between here and there takes it for an error of its own.
    """

    def stopped(self) -> Stopped:
        """The same as an error of the tree."""
        return Stopped(str(self), by_signal=True)


class SignalWatch:
    """Handles the watched signals while it is open; does nothing outside the main thread."""

    def __init__(self) -> None:
        self.seen = 0
        self._guarded: tuple[Engine, Robot] | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> SignalWatch:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in WATCHED}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @contextlib.contextmanager
    def guard(self, engine: Engine, robot: Robot) -> Iterator[None]:
        """While inside, signals go to the engine, and raise nothing anywhere."""
        self._guarded = (engine, robot)
        try:
            yield
        finally:
            self._guarded = None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.seen += 1
        reason = f"stopped by {signal.Signals(number).name}"
        if self._guarded is None:
            raise StopSignal(reason)
        engine, robot = self._guarded
        engine.request_stop(reason, by_signal=True)
        if self.seen >= LAST_RESORT_AT:
            _last_resort(robot)


def _last_resort(robot: Robot) -> None:
    """Three signals: whoever presses means it, and the engine may be stuck in a driver."""
    try:
        robot.stop()
    finally:
        os._exit(EXIT_CODE)
