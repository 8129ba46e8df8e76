"""What the controller does about hot joints.

Limits and codes: Universal Robots, error codes C62A1 (joint temperature high) and C62A11 (joint
temperature, shut down). The real arm switches the joint off then; here that is a protective stop.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

HIGH_C, SHUT_DOWN_C = 80.0, 85.0
COOLED_K = 2.0
"""So far below a limit it may be exceeded, and told, once more."""

CODE = 62


class HeatGuard:
    """Looks at the measured temperatures once a tick."""

    def __init__(self) -> None:
        self._high = False

    def look(self, machine: Machine) -> None:
        """Warn once, and stop as long as a joint is too hot."""
        celsius = machine.reading.temperature
        hottest = float(celsius.max())
        if hottest < HIGH_C - COOLED_K:
            self._high = False
        elif hottest >= HIGH_C and not self._high:
            self._high = True
            joint = int(celsius.argmax()) + 1
            machine.tell("text", "C62A1", f"joint {joint}: temperature high, {hottest:.0f} °C")
        if hottest >= SHUT_DOWN_C and machine.modes.running:
            joint = int(celsius.argmax()) + 1
            machine.protective_stop(CODE)
            machine.tell("text", "C62A11", f"joint {joint}: too hot, {hottest:.0f} °C")
