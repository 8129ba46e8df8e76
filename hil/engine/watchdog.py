"""Notices that the control thread does not come round any more, or that the process did not run."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType

HUNG_AFTER_S = 3.0
"""Longest time between two blocks on a robot that lives in wall time [s]."""

TICK_S = 0.1
"""Interval between watchdog checks [s]."""

GAP_S = 0.5
"""Longest interval between two checks of a process that runs; a longer one is a gap [s]."""

RECENT_S = 1.0
"""A silence of the robot is attributed to a gap in this process's execution if that gap ended at
most this long before the last block, or after it [s]. After an earlier gap the robot has sent data
again."""

_GAPS_KEPT = 100


def now_s() -> float:
    """Return a clock that also goes on while the computer sleeps [s]."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.monotonic()


class Presence:
    """Knows when this process did not run: suspended, or its computer asleep or overloaded.

    Some thread has to call `look` about every `TICK_S`. The first call after a gap records it, so
    the answer does not depend on which thread gets the processor first.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last, self._looks = now_s(), False
        self._gaps: deque[tuple[float, float]] = deque(maxlen=_GAPS_KEPT)

    def begin(self) -> None:
        """Record gaps from now on."""
        with self._lock:
            self._last, self._looks = now_s(), True

    def end(self) -> None:
        """Record a final gap and stop recording."""
        self.look()
        self._looks = False

    def look(self) -> float:
        """Note that the process runs now; returns the time [s]."""
        with self._lock:
            now = now_s()
            if self._looks and now - self._last > GAP_S:
                self._gaps.append((self._last, now))
            self._last = now
        return now

    def absent_s(self, since: float) -> float:
        """Return the total time for which the process did not run since a moment [s]."""
        return sum(max(0.0, end - max(begin, since)) for begin, end in list(self._gaps))

    def longest_s(self, since: float) -> float:
        """Return the longest of the gaps that ended after a moment [s]; 0 without any."""
        return max((end - begin for begin, end in list(self._gaps) if end > since), default=0.0)


class Watchdog:
    """Watches one loop while it is open.

    A driver whose call never returns takes the control thread with it; the stop then has to come
    from elsewhere, and the engine ends the run without that thread. A process that did not run is
    another matter: all of its threads stood still, and no driver is to blame.

    Args:
        hung: Called once, on the watchdog's thread, when the loop has not come round in time.
        suspended: Called once, on the watchdog's thread, with the time for which the process did
            not run [s], if that was longer than `HUNG_AFTER_S`.
        on: False to watch nothing: on a virtual clock nothing moves while nobody reads.
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
        """Note that the loop has come round.

        Returns:
            For how long the process did not run since the last time, if that was longer than
            `HUNG_AFTER_S` [s], else 0. A call that was allowed to take long is not counted: the
            arm stood still, and some libraries keep the interpreter to themselves.
        """
        now = self._presence.look()
        gap = 0.0 if self._patient or not self._on else self._presence.longest_s(self._last)
        self._last, self._fed, self._patient = now, now, False
        return gap if gap > HUNG_AFTER_S else 0.0

    def be_patient(self, seconds: float) -> None:
        """Allow the next call so long, until the loop comes round; 0 when it is over before."""
        self._last = self._presence.look() + max(0.0, seconds - HUNG_AFTER_S)
        self._patient = seconds > 0.0

    @property
    def patient(self) -> bool:
        """Whether a call was on its way that may take long."""
        return self._patient

    def absent_s(self) -> float:
        """Return the longest gap since about the last block, without the process running [s]."""
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
                with contextlib.suppress(Exception):  # nobody is there to hear of it
                    self._hung()
                return
            if gap > HUNG_AFTER_S and not noted:
                noted = True
                with contextlib.suppress(Exception):
                    self._suspended(gap)
