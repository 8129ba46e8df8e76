"""When the next tick of the mock controller is due.

`RealTime` follows the wall clock, `FreeRun` goes as fast as it can, `LockStep` waits until a client
permits a tick. Real time that the computer is too slow for is given up, and told as a `Slip`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


class Pacer(Protocol):
    """Decides when the next tick is due."""

    @property
    def patient(self) -> bool:
        """Whether time waits for clients that must not lose anything; the wall clock does not."""

    def wait_s(self) -> float | None:
        """Wall time until the next tick: 0 when it is due, None as long as nothing permits it."""

    def ticked(self) -> None:
        """A tick was made."""


OVER_S = 10.0
"""Wall time over which the pace is averaged [s]."""

CLOSEST = 0.5
"""Share of the time between ticks that passes at least after each. A tick that is late is caught up
at twice the pace, not at once: some clients, such as UR's own without `--buffered`, drop all but
the newest of the packages that they find waiting."""

SLIP_S = 0.05
"""Wall time the schedule may be late before it is given up; what was missed is not caught up.

Catching up lets device time race: half a second late at ten times the speed were five seconds that
pass at once, in which no client can kick a watchdog or lead an arm.
"""


class RealTime:
    """Ticks on an absolute schedule, so that lateness does not add up.

    Args:
        tick_s: Device time of a tick.
        factor: Device seconds per second of wall time.

    Attributes:
        patient: Accelerated time waits for clients; real time does not.
        behind_s: Wall time given up since the start [s].
        listeners: Called at each slip.
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
        """Device time passed over device time requested, over the last `OVER_S`; 1 keeps up."""
        now = time.monotonic()
        while self._slips and self._slips[0][0] < now - OVER_S:
            self._slips.popleft()
        lost_s = sum(behind for _, behind in self._slips)
        return max(0.0, 1.0 - lost_s / OVER_S)

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
            self._slip(now)

    def _slip(self, now: float) -> None:
        behind, self._due = now - self._due, now
        self.behind_s += behind
        self._slips.append((now, behind))
        slip = Slip(behind, self.behind_s, self.pace)
        for listener in self.listeners:
            listener(slip)


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


@dataclass(frozen=True, slots=True)
class Slip:
    """Wall time that the schedule has just given up, because the computer was too slow for it.

    Attributes:
        behind_s: How much, this time [s].
        total_s: How much since the start [s].
        pace: Device time passed over device time requested, over the last `OVER_S`.
    """

    behind_s: float
    total_s: float
    pace: float


ALARMING = 0.95
"""Below this share of the requested pace clients may run into time-outs: the operator is warned."""

WARN_EVERY_S = 60.0
"""Wall time between two such warnings [s]."""


class SlipWarning:
    """Warns the operator of a computer that is too slow, at most once a minute.

    Args:
        say: Prints one line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._next = time.monotonic()

    def slipped(self, slip: Slip) -> None:
        """Print a line if the pace is alarming and the last line is long enough ago."""
        now = time.monotonic()
        if slip.pace >= ALARMING or now < self._next:
            return
        self._next = now + WARN_EVERY_S
        self._say(
            f"behind the wall clock: device time passes at {slip.pace:.0%} of its pace, "
            f"{slip.total_s:.1f} s were given up since the start. This computer is too busy: "
            "time-outs of clients are then not protocol errors; close other programs, or use "
            "--speed 0.5"
        )
