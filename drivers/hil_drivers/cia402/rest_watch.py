"""Whether axes that were told to quick-stop do come to rest, and are switched off."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from hil_drivers.cia402.contracts import Inputs
from hil_drivers.cia402.track import wrapped

LONGEST_RAMP_S = 0.5
"""How long a quick stop may take from the highest speed of a joint; more is refused."""

MOVES_AFTER_S = 0.2
"""An axis that still moves so long after its ramp does not brake [s]."""

OFF_AFTER_S = 1.0
"""An axis that is still on so long after its ramp does not switch itself off; brakes take their
time to close [s]."""

MOVING_RAD_S = 0.05
MEASURED_OVER_S = 0.05


class BrakeWatch:
    """Finds axes that have to be taken the voltage from.

    Args:
        period_s: Device time of a cycle [s].
        rad_per_increment: Per axis; its sign does not matter.
        ramp_s: Per axis, how long its quick stop takes from the highest speed [s].
    """

    def __init__(
        self, period_s: float, rad_per_increment: Sequence[float], ramp_s: Sequence[float]
    ) -> None:
        self._scale, self._ramp_s = [abs(each) for each in rad_per_increment], ramp_s
        cycles = max(1, round(MEASURED_OVER_S / period_s))
        self._over_s = cycles * period_s
        self._seen: deque[list[int]] = deque(maxlen=cycles + 1)

    def begin(self) -> None:
        """A quick stop begins."""
        self._seen.clear()

    def complaint(self, axis: int, for_s: float) -> str:
        """Why an axis that still carries current is to be let go; empty when it is not.

        Args:
            axis: From 0.
            for_s: Time since the quick stop was told [s].
        """
        after_s, ramp_s = for_s - self._ramp_s[axis], self._ramp_s[axis]
        speed = self._speed(axis)
        if after_s > MOVES_AFTER_S and speed > MOVING_RAD_S:
            return (
                f"still moves at {speed:.2f} rad/s {for_s:.1f} s after a quick stop that takes "
                f"{ramp_s:.2g} s: it was taken the voltage from (controlword 00h)"
            )
        if after_s > OFF_AFTER_S:
            return (
                f"is still on {for_s:.1f} s after a quick stop: it was taken the voltage from "
                "(controlword 00h)"
            )
        return ""

    def look(self, inputs: Inputs) -> None:
        """Take the positions of this cycle."""
        self._seen.append(inputs.position.copy())

    def _speed(self, axis: int) -> float:
        """Over the last cycles [rad/s]; 0 until there were enough."""
        if len(self._seen) < (self._seen.maxlen or 0):
            return 0.0
        way = abs(wrapped(self._seen[-1][axis] - self._seen[0][axis]))
        return way * self._scale[axis] / self._over_s
