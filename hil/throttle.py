"""What happens thousands of times is told now and then."""

from __future__ import annotations

import time


class Throttle:
    """Says whether it is time to tell again.

    Args:
        every_s: No more often than this [s].
        at_once: Whether the first time is now, or one such time from now.
    """

    def __init__(self, every_s: float, *, at_once: bool = True) -> None:
        self._every_s = every_s
        self._next = time.monotonic() + (0.0 if at_once else every_s)

    def due(self, *, anyway: bool = False) -> bool:
        """Whether to tell now, and if so, count from now; `anyway` whatever the time."""
        now = time.monotonic()
        if not anyway and now < self._next:
            return False
        self._next = now + self._every_s
        return True
