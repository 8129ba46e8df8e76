"""The interlock on controllers that execute motions slower than planned."""

from __future__ import annotations

from collections.abc import Callable

from hil.core import StructArray
from hil.engine.interlock_protocol import Action, Trip

LEAST_SHARE = 0.99
"""Of the planned speed; a controller that reports less executes other motions than planned."""


def is_slowed(share: float) -> bool:
    """Return whether motions are slower than planned; what is not known (NaN) is not."""
    return share < LEAST_SHARE


class SpeedScaling:
    """Trips when the robot's controller scales the speed of motions down.

    Args:
        share: Executed over planned speed, the lowest of the newest block; NaN when not known.
        action: What a trip does.
    """

    name = "speed_scaling"
    watches = f"at least {LEAST_SHARE:.0%}"

    def __init__(self, share: Callable[[], float], *, action: Action = "pause") -> None:
        self.action = action
        self._share = share

    def check(self, block: StructArray) -> Trip | None:
        """See `Interlock.check`."""
        share = self._share()
        if not is_slowed(share):
            return None
        return Trip(
            self.name,
            -1,
            100.0 * share,
            100.0 * LEAST_SHARE,
            "%",
            float(block["device_time"][-1]),
            "the robot's speed scaling (speed slider)",
            least=True,
        )

    def clear(self, block: StructArray) -> bool:
        """See `Interlock.clear`."""
        return not is_slowed(self._share())
