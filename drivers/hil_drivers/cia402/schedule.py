"""When cycles begin: at absolute times, never in bursts, and what became of that."""

from __future__ import annotations

import time
from collections.abc import Callable

from hil_drivers.cia402.histogram import Histogram

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
        """Forget what was; the next cycle begins at once."""
        self.cycles = self.late = self.overrun = 0
        self.lateness, self.lasting = Histogram(), Histogram()
        self.deadline = self._clock() - self._period

    def wait(self, idle: Callable[[float], None]) -> bool:
        """Let the time pass until the next cycle is to begin; whether it begins late.

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
