"""Pacers, which decide when the next tick of the mock controller is due.

`RealTime` follows the wall clock, `FreeRun` runs as fast as possible, and `LockStep` waits until a
client permits a tick. If the computer is too slow for real time, the delay is not caught up but
reported as a `Slip`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


class Pacer(Protocol):
    """Scheduler of the ticks of a mock controller."""

    @property
    def patient(self) -> bool:
        """Whether device time waits for clients that must not lose data; false in real time."""

    def wait_s(self) -> float | None:
        """Return the wall time until the next tick [s]: 0 if due, None without a permitted tick."""

    def ticked(self) -> None:
        """Update the schedule after a tick."""


OVER_S = 10.0
"""Duration of wall time over which the pace is averaged [s]."""

CLOSEST = 0.5
"""Minimum time between two ticks, as a share of the regular time between ticks.

Late ticks are caught up at twice the regular pace instead of all at once. Some clients, such
as UR's own client without `--buffered`, would otherwise drop all but the newest waiting
package.
"""

SLIP_S = 0.05
"""Delay in wall time after which the schedule is reset; the missed time is not caught up [s].

Catching up would make device time jump. A delay of 0.5 s at ten times real time would be 5 s
of device time at once, in which no client can reset a watchdog or lead an arm.
"""


class RealTime:
    """Pacer with an absolute schedule, so that delays do not accumulate.

    Args:
        tick_s: Device time of a tick [s].
        factor: Device seconds per second of wall time.

    Attributes:
        patient: Whether time waits for clients: true for accelerated time, false for real time.
        behind_s: Wall time lost since the start [s].
        listeners: Functions called at each slip.
    """

    def __init__(self, tick_s: float, factor: float = 1.0) -> None:
        self._tick_s = tick_s
        self._due = self._not_before = time.monotonic()
        self._slips: deque[tuple[float, float]] = deque()
        self.behind_s = 0.0
        self.listeners: list[Callable[[Slip], object]] = []
        self.change(factor)

    @property
    def pace(self) -> float:
        """Ratio of elapsed to requested device time over the last `OVER_S`; 1 means no delay."""
        now = time.monotonic()
        while self._slips and self._slips[0][0] < now - OVER_S:
            self._slips.popleft()
        lost_s = sum(behind for _, behind in self._slips)
        return max(0.0, 1.0 - lost_s / OVER_S)

    def change(self, factor: float) -> None:
        """Change the speed to `factor` device seconds per second of wall time."""
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
            self._slip(now)

    def _slip(self, now: float) -> None:
        behind, self._due = now - self._due, now
        self.behind_s += behind
        self._slips.append((now, behind))
        slip = Slip(behind, self.behind_s, self.pace)
        for listener in self.listeners:
            listener(slip)


class FreeRun:
    """Pacer that runs as fast as possible, delayed only by clients that must not lose data."""

    patient = True

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return 0.0

    def ticked(self) -> None:
        """See `Pacer`."""


class LockStep:
    """Pacer that needs a permit for every tick, so that results do not depend on the computer load.

    Attributes:
        permitted: Number of ticks that are still permitted.
    """

    patient = True

    def __init__(self) -> None:
        self.permitted = 0

    def allow(self, ticks: int) -> None:
        """Permit a number of further ticks."""
        self.permitted += ticks

    def wait_s(self) -> float | None:
        """See `Pacer`."""
        return 0.0 if self.permitted > 0 else None

    def ticked(self) -> None:
        """See `Pacer`."""
        self.permitted -= 1


@dataclass(frozen=True, slots=True)
class Slip:
    """Wall time by which the schedule has just been delayed because the computer was too slow.

    Attributes:
        behind_s: Wall time lost in this slip [s].
        total_s: Wall time lost since the start [s].
        pace: Ratio of elapsed to requested device time over the last `OVER_S`.
    """

    behind_s: float
    total_s: float
    pace: float


ALARMING = 0.95
"""Share of the requested pace below which the operator is warned, because clients may time out."""

WARN_EVERY_S = 60.0
"""Minimum wall time between two warnings [s]."""


class SlipWarning:
    """Warning to the operator that the computer is too slow, printed at most once a minute.

    Args:
        say: Function that prints one line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._next = time.monotonic()

    def slipped(self, slip: Slip) -> None:
        """Print a warning if the pace is below `ALARMING` and the last warning is old enough."""
        now = time.monotonic()
        if slip.pace >= ALARMING or now < self._next:
            return
        self._next = now + WARN_EVERY_S
        self._say(
            f"behind the wall clock: device time passes at {slip.pace:.0%} of its pace, "
            f"{slip.total_s:.1f} s were dropped since the start. This computer is too busy: "
            "time-outs of clients are then not protocol errors; close other programs, or use "
            "--speed 0.5"
        )
