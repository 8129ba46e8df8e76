"""Watchdog that detects a hanging control thread and periods in which the process was suspended."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

HUNG_AFTER_S = 3.0
"""Maximum time between two blocks of a robot with a wall clock [s]; a longer time counts as a
hang."""

TICK_S = 0.1
"""Time between two watchdog checks [s]."""

GAP_S = 0.5
"""Maximum time between two watchdog checks of a running process; a longer time counts as a gap
in the execution [s]."""

RECENT_S = 1.0
"""Maximum time between the end of an execution gap and the last block for attributing a robot
time-out to the gap [s].

An execution gap that ended earlier is not the cause of the time-out, because the robot has sent
data after the gap. An execution gap after the last block always counts as the cause.
"""

_GAPS_KEPT = 100


def now_s() -> float:
    """Return the time of a clock that also advances while the computer sleeps [s]."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


class Presence:
    """Record of the execution gaps, in which this process did not run.

    A gap occurs if the process is suspended, or if the computer sleeps or is overloaded. A thread
    must call `look` about every `TICK_S` seconds. The first call of `look` after a gap records the
    gap, so that the recorded gaps do not depend on the order in which the threads continue.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last, self._looks = now_s(), False
        self._gaps: deque[tuple[float, float]] = deque(maxlen=_GAPS_KEPT)

    def begin(self) -> None:
        """Start recording gaps."""
        with self._lock:
            self._last, self._looks = now_s(), True

    def end(self) -> None:
        """Record a gap that lasts until now, if any, and stop recording gaps."""
        self.look()
        self._looks = False

    def look(self) -> float:
        """Record that the process is running now; return the present time [s]."""
        with self._lock:
            now = now_s()
            if self._looks and now - self._last > GAP_S:
                self._gaps.append((self._last, now))
            self._last = now
        return now

    def absent_s(self, since: float) -> float:
        """Return the total duration of gaps since the time `since` [s]."""
        return sum(max(0.0, end - max(begin, since)) for begin, end in list(self._gaps))

    def longest_s(self, since: float) -> float:
        """Return the longest gap that ended after the time `since` [s]; 0 if there is none."""
        return max((end - begin for begin, end in list(self._gaps) if end > since), default=0.0)


class Watchdog:
    """Watchdog for one control loop, active while its context is open.

    A driver call that never returns blocks the control thread. While a driver call blocks the
    control thread, the stop must come from a different thread, and the engine ends the run without
    the control thread. A gap in the execution of the process is handled separately from a hang: all
    threads were suspended, and no driver is the cause.

    Args:
        hung: Callback that is called a single time, on the watchdog thread, if the loop has not
            reported in time.
        suspended: Callback for a gap in the execution of the process longer than `HUNG_AFTER_S`;
            called a single time, on the watchdog thread, with the duration of the gap [s].
        on: Whether the watchdog monitors the loop. The value of `on` is False for a virtual clock,
            because the robot then moves only while its state is read.
    """

    def __init__(
        self,
        hung: Callable[[], object],
        suspended: Callable[[float], object] = lambda seconds: None,
        *,
        on: bool = True,
    ) -> None:
        self._hung = hung
        self._suspended = suspended
        self._presence = Presence()
        self._last = self._fed = self._presence.look()
        self._patient = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hil-watchdog", daemon=True)
        self._on = on

    def feed(self) -> float:
        """Record that the control loop is running.

        Returns:
            The longest gap in the execution of the process since the last call [s], if longer than
            `HUNG_AFTER_S`, else 0. Gaps during a call that `be_patient` allowed are ignored: the
            arm was static, and some libraries block the Python interpreter.
        """
        now = self._presence.look()
        gap = 0.0 if self._patient or not self._on else self._presence.longest_s(self._last)
        self._last, self._fed, self._patient = now, now, False
        return gap if gap > HUNG_AFTER_S else 0.0

    def be_patient(self, seconds: float) -> None:
        """Allow the next driver call to take `seconds`; 0 cancels the allowance.

        The allowance ends with the next `feed`.
        """
        self._last = self._presence.look() + max(0.0, seconds - HUNG_AFTER_S)
        self._patient = seconds > 0.0

    @property
    def patient(self) -> bool:
        """Whether a driver call that is allowed to take long is in progress."""
        return self._patient

    def absent_s(self) -> float:
        """Return the longest execution gap of the process since about the last block [s]."""
        self._presence.look()
        return self._presence.longest_s(self._fed - RECENT_S) if self._on else 0.0

    def __enter__(self) -> Watchdog:
        self._presence.begin()
        self.feed()
        if self._on:
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._presence.end()

    def _run(self) -> None:
        noted = False
        while not self._over.wait(TICK_S):
            late = self._presence.look() - self._last
            if late <= HUNG_AFTER_S:
                continue
            gap = self._presence.longest_s(self._last)
            if late - self._presence.absent_s(self._last) > HUNG_AFTER_S:
                self._presence.end()
                with contextlib.suppress(Exception):  # no caller can handle an exception here
                    self._hung()
                return
            if gap > HUNG_AFTER_S and not noted:
                noted = True
                with contextlib.suppress(Exception):
                    self._suspended(gap)
