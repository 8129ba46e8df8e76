"""Ctrl-C, SIGTERM and a lost terminal become stop requests, not exceptions in a command.

While nothing moves (planning, fitting) a signal raises `StopSignal`. While a run is guarded, from
the making of its directory to its stop document, signals interrupt nothing. The first Ctrl-C asks
the engine to pause at the next checkpoint, the second for a controlled stop now, which is also what
SIGTERM and a lost terminal mean, Ctrl-C while the run is paused, and the first Ctrl-C of a run that
nobody attends: nobody could let it go on. The third of any stops the robot directly and ends the
process. A signal that was ignored when the program started (`nohup`)
stays ignored.
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
    """A watched signal came while nothing moved.

    No `Exception`, so that no library between here and there takes it for an error of its own.
    """


class SignalWatch:
    """Handles the watched signals while it is open; does nothing outside the main thread.

    Args:
        attended: Whether somebody can let a paused run go on; if not, the first Ctrl-C stops it.
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
        """Return the stop that the signals asked for, as an error of the tree."""
        return Stopped(self.reason, by_signal=True)

    @contextlib.contextmanager
    def guard(self) -> Iterator[None]:
        """Note signals while inside and pass them on to a bound engine; they raise nothing."""
        self._guarding = True
        try:
            yield
        finally:
            self._guarding, self._bound = False, None

    def bind(self, engine: Engine, robot: Robot) -> None:
        """Pass signals on to this engine; one that has come already, too."""
        self._bound = (engine, robot)
        if self.seen:
            engine.request_stop(self.reason, by_signal=True)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        name = signal.Signals(number).name
        if self._bound is not None and self._pauses(number):
            self._pressed = True
            self._bound[0].request_pause(f"{name}: Enter goes on, Ctrl-C again stops")
            return
        self.seen += 1
        self.reason = f"stopped by {name}"
        if not self._guarding:
            raise StopSignal(self.reason)
        if self._bound is None:
            return
        engine, robot = self._bound
        if engine.state is RunState.DONE:
            return  # nothing moves, and the end is being written down
        engine.request_stop(self.reason, by_signal=True)
        if self.seen + (self._pressed and engine.pause_pending) >= LAST_RESORT_AT:
            _last_resort(robot)

    def _pauses(self, number: int) -> bool:
        """Return whether a signal is the first Ctrl-C of a run that can still pause."""
        assert self._bound is not None
        engine = self._bound[0]
        can = engine.state in (RunState.PREFLIGHT, RunState.ARMED, RunState.RUNNING)
        again = self.seen or (self._pressed and engine.pause_pending)
        return self._attended and number == signal.SIGINT and can and not again


_leaving = threading.Event()


def _last_resort(robot: Robot) -> None:
    """Stop the robot directly and end the process: the engine may be stuck in a driver.

    So may `stop` itself: it gets a moment, and none at all when another signal comes meanwhile.
    """
    try:
        if not _leaving.is_set():
            _leaving.set()
            stop_robot(robot)
    finally:
        os._exit(EXIT_CODE)
