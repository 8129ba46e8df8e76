"""Start times of cycles, and statistics of their punctuality.

`Schedule` starts cycles at absolute times, never in bursts, and counts late cycles. A `Histogram`
stores by how much the cycles were late. `Stalls` detects gaps between SYNCs, whatever the cause.
Drives that miss a SYNC extrapolate or stop. `realtime` configures kernel and interpreter for a
punctual thread, and reports settings that were not permitted.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
import time
from array import array
from collections.abc import Callable, Iterator

LATE_SHARE = 0.25
"""Share of a period by which a cycle can begin late without counting as late.

After a cycle that counts as late, all later start times shift.
"""

GIVE_UP_SHARE = 0.9
"""Share of a period after which the wait for the answers of a cycle ends."""

FREE_PATIENCE_S = 0.25
"""Longest wait for answers if cycles have no deadlines [s]."""

FREE_MISSES, FREE_IMPATIENCE_S = 2, 0.01
"""Number of consecutive incomplete cycles after which the wait is shortened; this wait [s].

Because of the shorter wait, a silent drive does not stretch seconds of device time to minutes.
"""


class Schedule:
    """Schedule of the start times of cycles, in wall time.

    Args:
        wall_period_s: Time from SYNC to SYNC [s]; 0 to start each cycle at the end of the cycle
            before.
        clock: Clock of wall time, by default `time.monotonic`.

    Attributes:
        deadline: Scheduled start of the present cycle [s, clock].
        give_up: Time at which the wait for the answers of the present cycle ends [s, clock].
        cycles: Number of cycles begun since `restart`.
        late: Number of cycles that began late by more than `LATE_SHARE` of the period.
        overrun: Number of cycles that began late or did not end before the next scheduled start.
        lateness: Histogram of the delays of cycle starts.
        lasting: Histogram of the durations of the exchanges.
    """

    def __init__(
        self, wall_period_s: float, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._period, self._clock = wall_period_s, clock
        self._most_late = wall_period_s * LATE_SHARE
        self._patience = wall_period_s * GIVE_UP_SHARE or FREE_PATIENCE_S
        self.deadline = self.give_up = self._begun = 0.0
        self._late, self._incomplete = False, 0
        self.restart()

    def restart(self) -> None:
        """Clear the statistics; the next cycle begins immediately."""
        self.cycles = self.late = self.overrun = 0
        self.lateness, self.lasting = Histogram(), Histogram()
        self.deadline = self._clock() - self._period

    def wait(self, idle: Callable[[float], None]) -> bool:
        """Wait until the next cycle is due; return whether it begins late.

        After a late cycle the later start times shift. The time between two cycles is therefore
        never shorter than (1 − `LATE_SHARE`) of the period.

        Args:
            idle: Function that waits until a passed time of the clock; also called with past times.
        """
        deadline = self.deadline + self._period
        idle(deadline)
        now = self._clock()
        lateness = now - deadline
        self._late = self._period > 0 and lateness > self._most_late
        if self._late:
            self.late += 1
        if self._late or not self._period:
            deadline = now
        self.deadline, self._begun, self.give_up = deadline, now, deadline + self._patience
        self.cycles += 1
        self.lateness.add(lateness if self._period else 0.0)
        return self._late

    def answered(self, all_came: bool) -> None:
        """Adapt the wait for answers to incomplete cycles, if cycles have no deadlines.

        Args:
            all_came: Whether all answers of the present cycle were received.
        """
        self._incomplete = 0 if all_came else self._incomplete + 1
        if not self._period:
            patient = self._incomplete < FREE_MISSES
            self._patience = FREE_PATIENCE_S if patient else FREE_IMPATIENCE_S

    def done(self) -> None:
        """Record the duration of the present cycle, after its exchange and all processing."""
        now = self._clock()
        self.lasting.add(now - self._begun)
        if self._late or (self._period and now > self.deadline + self._period):
            self.overrun += 1


class Histogram:
    """Histogram of durations, with a resolution of 1 µs.

    Args:
        most_s: Upper end of the histogram [s]; longer durations count as `most_s`.

    Attributes:
        longest_s: Longest duration so far [s], not limited by `most_s`.
    """

    def __init__(self, most_s: float = 0.05) -> None:
        self._last = int(most_s * 1e6)
        self._bins = array("Q", bytes(8 * (self._last + 1)))
        self.longest_s = 0.0

    def add(self, time_s: float) -> None:
        """Count a time [s]."""
        at = int(time_s * 1e6)
        self._bins[0 if at < 0 else at if at < self._last else self._last] += 1
        if time_s > self.longest_s:
            self.longest_s = time_s

    def __len__(self) -> int:
        return sum(self._bins)

    def percentile(self, percent: float) -> float:
        """Return a percentile of the durations [s]; 0 without durations.

        Args:
            percent: Percentage of the durations that are not longer than the returned value.
        """
        left = max(len(self) * percent / 100.0, 1e-9)
        for at, count in enumerate(self._bins):
            left -= count
            if left <= 0:
                return at * 1e-6
        return 0.0


LATE_PERIODS = 1.5
"""Length of a gap between two SYNCs, in periods, from which nearby measurements are invalid.

During a longer gap the arm was not at the set-points that the record pairs with the measurements.
"""

TOLD_AFTER_S = 0.06
"""Delay of the message about a gap [s], so that the message includes the drives' messages."""


class Stalls:
    """Detector of gaps between SYNCs, for cycles in real time.

    Args:
        period_s: Time from SYNC to SYNC [s].
        late_cycles: Length of a gap, in periods, after which a motion must not continue.
        real: Whether device time equals wall time; if False, no gap is detected.
    """

    def __init__(self, period_s: float, late_cycles: int, *, real: bool) -> None:
        self._period_s, self._real = period_s, real
        self._late_s, self._long_s = LATE_PERIODS * period_s, late_cycles * period_s
        self._last_s: float | None = None
        self._gap_s = 0.0

    def restart(self) -> None:
        """Forget the last SYNC, so that the next SYNC counts as the first."""
        self._last_s = None

    def synced(self, now_s: float) -> bool:
        """Record a SYNC; return whether the gap before it exceeds `LATE_PERIODS` periods.

        Args:
            now_s: Time of the SYNC on a clock that does not jump [s].
        """
        last_s, self._last_s = self._last_s, now_s
        self._gap_s = now_s - last_s if self._real and last_s is not None else 0.0
        return self._gap_s > self._late_s

    @property
    def too_long(self) -> bool:
        """Whether the last gap was so long that a motion must be stopped."""
        return self._gap_s > self._late_s and self._gap_s >= self._long_s

    @property
    def text(self) -> str:
        """Description of the last gap for messages."""
        return (
            f"this computer was delayed: it sent no SYNC for {1e3 * self._gap_s:.3g} ms, "
            f"{self._gap_s / self._period_s:.0f} periods (busy computer, no real-time priority?)"
        )


PRIORITY = 50
"""SCHED_FIFO priority of the cycle thread: above ordinary work, below the kernel's threads."""

SWITCH_S = 2e-4
"""Time after which another Python thread must release the interpreter [s].

Python's default for the switch interval is 5 ms.
"""

SOON_NICE = -10

SLACK_NS = 1_000
"""Timer slack [ns]: delay with which the kernel can wake the thread; the default is 50 µs."""


@contextlib.contextmanager
def realtime() -> Iterator[list[str]]:
    """Make the calling thread punctual while the `with` block runs, as far as permitted.

    Automatic garbage collection is off in the `with` block: the thread calls `gc.collect` itself.

    Yields:
        Text with the settings that were not permitted; empty if all settings were permitted.
    """
    refused = _scheduled_first()
    _exact_timers()
    before = _others_sooner()
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(SWITCH_S)
    gc.freeze()
    gc.disable()
    try:
        yield [refused] if refused else []
    finally:
        sys.setswitchinterval(switch_s)
        gc.unfreeze()
        if collects:
            gc.enable()
        _set_nice(before)


def _scheduled_first() -> str:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        return (
            f"no real-time priority ({getattr(error, 'strerror', error)}): cycles may begin late "
            f"under load; permit it with `ulimit -r {PRIORITY}` (limits.conf: rtprio)"
        )
    return ""


_PR_SET_TIMERSLACK = 29


def _exact_timers() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(SLACK_NS), 0, 0, 0)


def _others_sooner() -> dict[int, int]:
    """Raise the priority of the other threads of this process; return their former niceness.

    A thread that holds the interpreter lock but waits for the processor blocks the cycle thread,
    whatever the priority of the cycle thread.
    """
    before: dict[int, int] = {}
    for name in os.listdir("/proc/self/task") if os.path.isdir("/proc/self/task") else ():
        with contextlib.suppress(OSError):
            before[int(name)] = os.getpriority(os.PRIO_PROCESS, int(name))
    _set_nice(dict.fromkeys(before, SOON_NICE))
    return before


def _set_nice(values: dict[int, int]) -> None:
    for thread, value in values.items():
        with contextlib.suppress(OSError):  # the thread has ended, or the change is not permitted
            os.setpriority(os.PRIO_PROCESS, thread, value)
