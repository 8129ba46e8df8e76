"""Notices when state stops arriving or repeats itself: time-outs that trust no single clock."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from hil.core import InterlockTripped, StaleState, StructArray
from hil.engine.interlocks import STALE_AFTER_S

STALE_AFTER_BLOCKS = 50
"""Blocks in a row without a newer sample; a virtual clock has no other measure."""


class Freshness:
    """Follows the device clock and trips when it brings nothing newer: the interlock `stale`.

    Args:
        after_s: Wall time without a newer sample that counts as stale [s]; None for the default.
        wall: Whether the robot lives in wall time; on a virtual clock blocks are counted.
        now: Monotonic clock [s].
    """

    def __init__(
        self,
        after_s: float | None = None,
        *,
        wall: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._after_s = STALE_AFTER_S if after_s is None else after_s
        self._wall = wall
        self._now = now
        self._newest = -np.inf
        self._since = now()
        self._blocks = 0

    def check(self, block: StructArray) -> None:
        """Judge one block.

        Raises:
            StaleState: Its time is not a number.
            InterlockTripped: Its time has not advanced for too long.
        """
        times = block["device_time"]
        if not np.isfinite(times).all():
            raise StaleState(
                "the robot's clock is not a number",
                hint="check the driver: every row needs a finite device_time",
            )
        if times[-1] > self._newest:
            self._newest, self._since, self._blocks = float(times[-1]), self._now(), 0
            return
        self._blocks += 1
        if silence := self._too_long():
            raise InterlockTripped(
                f"interlock stale: the robot's clock {self._how(float(times[-1]))}: {silence}",
                hint="check the connection and the controller; the data so far is kept",
            )

    def _too_long(self) -> str:
        """How long nothing new came, in words; nothing while that is within bounds."""
        if not self._wall:
            blocks = f"{self._blocks} blocks in a row brought nothing new"
            return blocks if self._blocks > STALE_AFTER_BLOCKS else ""
        quiet = self._now() - self._since
        limit = f"limit {self._after_s:g} s"
        return f"nothing new for {quiet:.3g} s, {limit}" if quiet > self._after_s else ""

    def _how(self, time_s: float) -> str:
        if time_s < self._newest:
            return f"went backwards, from {self._newest:.3f} s to {time_s:.3f} s"
        return f"stands still at {self._newest:.3f} s"


STANDS_STILL_S = 0.5
"""Wall time after which a device clock that has not gone on is taken to stand still [s]."""

LEAST_WALL_S = 1.0
"""A computer is allowed this much even where a simulated second lasts a tenth of one [s]."""


class Deadline:
    """A time-out by the device clock, or by the wall clock where the device clock stands still.

    In wall time the device clock alone is not enough before `LEAST_WALL_S`: a mock in a hurry must
    not make a time-out of every moment in which this process does not get the processor. The wall
    clock alone is not enough while device time goes on: simulated drives on a busy computer are
    slower than they are planned to be, and nothing is wrong with them.

    Args:
        seconds: Time allowed.
        begin: Device time now [s].
        wall: Whether the robot lives in wall time; on a virtual clock only device time counts.
        now: Monotonic clock [s].
    """

    def __init__(
        self,
        seconds: float,
        begin: float,
        *,
        wall: bool,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.seconds = seconds
        self._device_end = begin + seconds
        self._now = now
        began = now() if wall else -np.inf
        self._wall_end = began + seconds if wall else np.inf
        self._not_before = began + min(seconds, LEAST_WALL_S)
        self._newest, self._advanced = begin, began

    def extend(self, seconds: float) -> None:
        """Allow more time [s]."""
        self.seconds += seconds
        self._device_end += seconds
        self._wall_end += seconds

    def over(self, device_time: float) -> bool:
        """Whether the time is up; a device time that is no number counts as up."""
        now = self._now()
        if device_time > self._newest:
            self._newest, self._advanced = device_time, now
        if not device_time <= self._device_end:
            return now >= self._not_before
        return now > self._wall_end and now - self._advanced > STANDS_STILL_S
