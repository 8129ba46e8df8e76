"""When a motion begins and ends, seen from the drives."""

from __future__ import annotations

from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.contracts import STEP_S
from hil_mock_robot.cia402.states import State
from hil_mock_robot.cia402.station import Station

STANDSTILL_S = 0.1
"""Device time without a new set-point after which the next one begins a motion."""

SETPOINTS = (keys.TARGET_POSITION, keys.TARGET_VELOCITY, keys.TARGET_TORQUE)


class MotionWatch:
    """Says when a motion begins and ends.

    A master that announces what it does is believed; else set-points that change are a motion.

    Args:
        station: What it looks at; call `passed` after every block of steps.

    Attributes:
        moving: Whether one is under way.
        listeners: Told whether it begins or ends.
    """

    def __init__(self, station: Station) -> None:
        self._station = station
        self._setpoints: list[int] = []
        self._still_steps = 0
        self.moving = False
        self.listeners: list[Callable[[bool], None]] = []

    def passed(self, steps: int) -> None:
        """Steps have passed."""
        marker = self._station.marker
        moving = marker.moving if marker.known else self._changing(steps)
        if moving is not self.moving:
            self.moving = moving
            for listener in self.listeners:
                listener(moving)

    def _changing(self, steps: int) -> bool:
        now = [
            axis.registers[key]
            for axis in self._station.axes
            if axis.drive.state is State.OPERATION_ENABLED
            for key in SETPOINTS
        ]
        changed = len(now) == len(self._setpoints) and now != self._setpoints
        self._setpoints = now
        self._still_steps = 0 if changed else self._still_steps + steps
        if not now:
            return False
        return changed or (self.moving and self._still_steps * STEP_S < STANDSTILL_S)
