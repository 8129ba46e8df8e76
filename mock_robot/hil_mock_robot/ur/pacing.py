"""How the controller's time passes: with the wall clock, as fast as it goes, or when permitted."""

from __future__ import annotations

import time

SLIP_S = 0.05
"""Wall time the schedule may be late before it is given up; what was missed is not caught up.

Catching up lets device time race: half a second late at ten times the speed were five seconds that
pass at once, in which no client can kick a watchdog or lead an arm.
"""

CLOSEST = 0.5
"""Share of the time between ticks that passes at least after each. A tick that is late is caught up
at twice the pace, not at once: some clients, such as UR's own without `--buffered`, drop all but
the newest of the packages that they find waiting."""


class RealTime:
    """Ticks on an absolute schedule, so that lateness does not add up.

    Args:
        tick_s: Device time of a tick.
        factor: Device seconds per second of wall time.

    Attributes:
        patient: Accelerated time waits for clients; real time does not.
        slips: How often the machine could not keep up.
    """

    def __init__(self, tick_s: float, factor: float = 1.0) -> None:
        self._tick_s = tick_s
        self._due = self._not_before = time.monotonic()
        self.slips = 0
        self.change(factor)

    def change(self, factor: float) -> None:
        """Go on at another speed."""
        self._spacing_s = self._tick_s / factor
        self.patient = factor > 1.0

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return max(0.0, max(self._due, self._not_before) - time.monotonic())

    def ticked(self) -> None:
        """See `Pacer`."""
        self._due += self._spacing_s
        now = time.monotonic()
        self._not_before = now + CLOSEST * self._spacing_s
        if now - self._due > SLIP_S:
            self._due = now
            self.slips += 1


class FreeRun:
    """As fast as it goes; clients that must not lose anything hold it up."""

    patient = True

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return 0.0

    def ticked(self) -> None:
        """See `Pacer`."""


class LockStep:
    """No tick without a permit: results do not depend on how busy the computer is.

    Attributes:
        permitted: Ticks that may still be made.
    """

    patient = True

    def __init__(self) -> None:
        self.permitted = 0

    def allow(self, ticks: int) -> None:
        """Let so many more ticks pass."""
        self.permitted += ticks

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return 0.0 if self.permitted > 0 else None

    def ticked(self) -> None:
        """See `Pacer`."""
        self.permitted -= 1
