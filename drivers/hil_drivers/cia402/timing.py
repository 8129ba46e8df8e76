"""When cycles begin and how punctual they are.

`Schedule` begins cycles at absolute times, never in bursts, and counts those that came late in a
`Histogram`. `Stalls` finds gaps between SYNCs, however they came about: drives that miss one
extrapolate or stand still. `realtime` asks the kernel and the interpreter for what a punctual
thread needs, and says what was not permitted.
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
"""Share of a period by which a cycle may begin late; beyond it, it counts, and times shift."""

GIVE_UP_SHARE = 0.9
"""Share of a period after which answers are not waited for any longer."""

FREE_PATIENCE_S = 0.25
"""How long answers are waited for without deadlines [s]."""

FREE_MISSES, FREE_IMPATIENCE_S = 2, 0.01
"""After so many incomplete cycles in a row answers are waited for only so long [s]: who does not
answer must not turn seconds of device time into minutes."""


class Schedule:
    """Wall times of cycles.

    Args:
        wall_period_s: From SYNC to SYNC [s]; 0 to begin as soon as the last one is over.
        clock: Of the wall, `time.monotonic`.

    Attributes:
        deadline: When the present cycle was to begin [s, clock].
        give_up: When its answers are not waited for any longer [s, clock].
        cycles: Begun since `restart`.
        late: That began late by more than `LATE_SHARE`.
        overrun: That were not over when the next one was to begin, or began late.
        lateness: How late cycles began.
        lasting: How long their exchanges took.
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
        """Forget earlier cycles; the next one begins at once."""
        self.cycles = self.late = self.overrun = 0
        self.lateness, self.lasting = Histogram(), Histogram()
        self.deadline = self._clock() - self._period

    def wait(self, idle: Callable[[float], None]) -> bool:
        """Wait until the next cycle is to begin; return whether it begins late.

        After a late one the times shift: two cycles are never closer than the period less
        `LATE_SHARE` of it, whatever was lost.

        Args:
            idle: Returns at a time of the clock; called even when it is over.
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
        """The present cycle has all answers, or not; counts without deadlines only."""
        self._incomplete = 0 if all_came else self._incomplete + 1
        if not self._period:
            patient = self._incomplete < FREE_MISSES
            self._patience = FREE_PATIENCE_S if patient else FREE_IMPATIENCE_S

    def done(self) -> None:
        """The exchange of the present cycle is over, and all that follows from it."""
        now = self._clock()
        self.lasting.add(now - self._begun)
        if self._late or (self._period and now > self.deadline + self._period):
            self.overrun += 1


class Histogram:
    """Times from 0 on, to the microsecond.

    Args:
        most_s: Longer ones count as so long; `longest_s` has them [s].

    Attributes:
        longest_s: The longest one [s].
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
        """So many percent of the times are no longer [s]; 0 when there are none."""
        left = max(len(self) * percent / 100.0, 1e-9)
        for at, count in enumerate(self._bins):
            left -= count
            if left <= 0:
                return at * 1e-6
        return 0.0


LATE_PERIODS = 1.5
"""Periods from SYNC to SYNC from which on what is measured around it is not to be used: the arm was
not where the set-points that the record pairs with it say."""

TOLD_AFTER_S = 0.06
"""How long a stall waits to be told [s]: what the drives say of it comes with it."""


class Stalls:
    """Gaps between SYNCs, where the pace is the wall's; without deadlines nothing is late.

    Args:
        period_s: From SYNC to SYNC [s].
        late_cycles: Periods of a gap after which a motion is not gone on with.
        real: The pace is the wall's.
    """

    def __init__(self, period_s: float, late_cycles: int, *, real: bool) -> None:
        self._period_s, self._real = period_s, real
        self._late_s, self._long_s = LATE_PERIODS * period_s, late_cycles * period_s
        self._last_s: float | None = None
        self._gap_s = 0.0

    def restart(self) -> None:
        """The next SYNC is the first."""
        self._last_s = None

    def synced(self, now_s: float) -> bool:
        """A SYNC went out; whether much later than it was to.

        Args:
            now_s: When, of any clock that does not jump.
        """
        last_s, self._last_s = self._last_s, now_s
        self._gap_s = now_s - last_s if self._real and last_s is not None else 0.0
        return self._gap_s > self._late_s

    @property
    def too_long(self) -> bool:
        """Whether the motion must not go on after the last gap as if nothing had been."""
        return self._gap_s > self._late_s and self._gap_s >= self._long_s

    @property
    def text(self) -> str:
        """The last gap in words."""
        return (
            f"our computer was held up: there was no SYNC for {1e3 * self._gap_s:.3g} ms, "
            f"{self._gap_s / self._period_s:.0f} periods (busy machine, no real-time priority?)"
        )


PRIORITY = 50
"""Of SCHED_FIFO: above ordinary work, below the kernel's own threads."""

SWITCH_S = 2e-4
"""How long another Python thread may keep the interpreter from ours; 5 ms unless told [s]."""

SOON_NICE = -10

SLACK_NS = 1_000
"""By how much the kernel may wake us late to save wake-ups; 50 µs unless told."""


@contextlib.contextmanager
def realtime() -> Iterator[list[str]]:
    """Make the calling thread punctual while the block runs, as far as permitted.

    Garbage is not collected at times of its own choosing: the thread calls `gc.collect` itself.

    Yields:
        What was not permitted, in words; empty when all was.
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
    """Let the other threads of this process run soon; return their earlier niceness.

    One that has the interpreter and not the processor keeps ours waiting, whatever its priority.
    """
    before: dict[int, int] = {}
    for name in os.listdir("/proc/self/task") if os.path.isdir("/proc/self/task") else ():
        with contextlib.suppress(OSError):
            before[int(name)] = os.getpriority(os.PRIO_PROCESS, int(name))
    _set_nice(dict.fromkeys(before, SOON_NICE))
    return before


def _set_nice(values: dict[int, int]) -> None:
    for thread, value in values.items():
        with contextlib.suppress(OSError):  # it has ended, or it is not permitted
            os.setpriority(os.PRIO_PROCESS, thread, value)
