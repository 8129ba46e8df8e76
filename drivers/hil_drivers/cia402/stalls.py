"""Whether SYNCs go out in time: drives that miss one extrapolate, or stand still."""

from __future__ import annotations

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
        """What the last gap was, in words."""
        return (
            f"our computer was held up: there was no SYNC for {1e3 * self._gap_s:.3g} ms, "
            f"{self._gap_s / self._period_s:.0f} periods (busy machine, no real-time priority?)"
        )
