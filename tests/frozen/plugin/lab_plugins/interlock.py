"""The interlock of docs/how-to/add-an-interlock.md."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil.engine import Trip


class Power:
    """Trips when a joint takes up or gives back more mechanical power than `limit_w`."""

    name = "lab-power"

    def __init__(self, context: Any, *, action: str, limit_w: float) -> None:
        self.action = action
        self.watches = f"{limit_w:g} W"  # for `hil plan`
        self._limit = limit_w
        self._gains = np.array(context.drive_gains)  # N·m/A: for arms that measure currents

    def check(self, block: Any) -> Trip | None:
        power = self._power(block)
        if (power <= self._limit).all():
            return None
        row, joint = np.argwhere(~(power <= self._limit))[0]
        time = float(block["device_time"][row])
        return Trip(self.name, int(joint), float(power[row, joint]), self._limit, "W", time)

    def clear(self, block: Any) -> bool:
        return bool((self._power(block) <= 0.9 * self._limit).all())

    def _power(self, block: Any) -> Any:
        torque = block["effort"] * self._gains if len(self._gains) else block["effort"]
        return np.abs(torque * block["qd"])
