"""Device time: carried by SYNC, and by the drives' own timer when SYNC stays away.

Nothing in here looks at a clock: the caller says what time it is.
"""

from __future__ import annotations

from hil_mock_robot.cia402.contracts import STEP_S

PATIENCE_S = 0.2
"""Wall time without SYNC before the drives go by their own timer. Until then their time stands
still: a master that a busy computer held up goes on as if nothing had been."""

IDLE_PATIENCE_S = 0.02
"""The same while no drive is operational: nothing is interrupted then."""

PERIODS_MISSED = 2.0
CARRIED = 1e-9
"""What sums of periods may lack of a whole step by rounding, in steps."""

LONGEST_STALL_S = 0.1
"""What the drives' own timer catches up at once; a computer that slept longer lost that time."""


class DeviceClock:
    """Counts the steps of `STEP_S` that have passed for the drives.

    While there is SYNC, every one of them is a period, however long it took on the wall: a master
    may go faster or slower than real time. Without, time goes on as on the wall.

    Args:
        now_s: Wall time, monotonic.
        patience_s: Wall time without SYNC after which the drives' own timer takes over; never
            less than two periods.

    Attributes:
        steps: Passed since the start.
        synced: Whether SYNC carries the time.
        syncs: How many there were.
    """

    def __init__(self, now_s: float, patience_s: float = PATIENCE_S) -> None:
        self._patience_s = patience_s
        self.steps = self.syncs = 0
        self.synced = False
        self._rest = 0.0
        self._gives_up_s = self._synced_s = now_s
        self._own_s = now_s

    @property
    def device_s(self) -> float:
        """Device time [s]."""
        return self.steps * STEP_S

    def sync(self, now_s: float, period_s: float) -> int:
        """A SYNC has come; how many steps pass with it.

        Args:
            now_s: Wall time.
            period_s: What the drives take for the time between two SYNCs.
        """
        self.synced = True
        self.syncs += 1
        self._synced_s = now_s
        self._gives_up_s = now_s + max(PERIODS_MISSED * period_s, self._patience_s)
        return self._pass(period_s)

    def own(self, now_s: float) -> int:
        """Wall time has passed without SYNC; how many steps pass with it."""
        if self.synced:
            if now_s < self._gives_up_s:
                return 0
            # The silence was waited out, it is not made up for: a SYNC may have been meant late.
            self.synced, self._own_s = False, self._gives_up_s
        self._own_s = max(self._own_s, now_s - LONGEST_STALL_S)
        steps = int((now_s - self._own_s) / STEP_S + CARRIED)
        self._own_s += steps * STEP_S
        self.steps += steps
        return steps

    def idle(self) -> None:
        """No drive is operational any more: the own timer takes over soon."""
        self._gives_up_s = min(self._gives_up_s, self._synced_s + IDLE_PATIENCE_S)

    def slept(self, lasted_s: float) -> None:
        """For so long nobody looked whether there is SYNC: that time does not count."""
        self._gives_up_s += lasted_s

    def wait_s(self, now_s: float, steps: int) -> float:
        """Wall time until the own timer has so many steps to make; 0 when it is due."""
        due = self._gives_up_s if self.synced else self._own_s
        return max(0.0, due + steps * STEP_S - now_s)

    def _pass(self, period_s: float) -> int:
        self._rest += period_s / STEP_S
        steps = int(self._rest + CARRIED)
        self._rest -= steps
        self.steps += steps
        return steps
