"""Who advances the simulation: the reader on a virtual clock, a thread of its own in wall time."""

from __future__ import annotations

import math
import threading
from typing import Protocol

from hil.core import RobotTimeout, StructArray
from hil_mock_robot.controller import Controller


class Clock(Protocol):
    """How time passes for one robot; `catch_up`, `contact` and `forget` need the lock."""

    def begin(self) -> None:
        """The robot was connected."""

    def end(self) -> None:
        """The robot is closed; returns when its arm rests, as far as time passes for it."""

    def catch_up(self) -> None:
        """Let everything happen that was due before now."""

    def contact(self) -> None:
        """The host has shown itself."""

    def read(self, timeout_s: float) -> StructArray:
        """See `hil.robot.Robot.read`."""

    def forget(self) -> None:
        """Drop rows nobody has read."""


class VirtualClock:
    """Advances only when it is read.

    Args:
        controller: What it advances.
        changed: Its lock; notified when the robot is closed.
        block: Samples at once.
    """

    def __init__(self, controller: Controller, changed: threading.Condition, block: int) -> None:
        self._controller, self._changed, self._block = controller, changed, block

    def begin(self) -> None:
        """See `Clock.begin`."""

    def end(self) -> None:
        """See `Clock.end`: here time stands still."""

    def catch_up(self) -> None:
        """See `Clock.catch_up`: here nothing is ever due."""

    def contact(self) -> None:
        """See `Clock.contact`."""

    def forget(self) -> None:
        """See `Clock.forget`: here nothing waits."""

    def read(self, timeout_s: float) -> StructArray:
        """One block, or as many as it takes until a row gets through."""
        end = math.inf
        while True:
            # Taken anew for every block: stop() must not wait for a row that may never come.
            with self._changed:
                controller = self._controller
                self._require_row_ahead(controller)
                if end == math.inf:
                    end = controller.arm.device_time + timeout_s
                rows = controller.produce(self._block)
                if len(rows):
                    return controller.hand_over(rows)
                if controller.arm.dead:
                    raise controller.fault_error()
                if controller.arm.device_time >= end and not controller.line.hanging:
                    raise timed_out(controller.name, timeout_s)

    def _require_row_ahead(self, controller: Controller) -> None:
        controller.require_connection()
        while controller.line.hanging:
            self._changed.wait()
            controller.require_connection()
        if controller.fault_told or controller.arm.dead:
            controller.come_to_rest()
            raise controller.fault_error()


def timed_out(name: str, timeout_s: float) -> RobotTimeout:
    """The error of a read in vain."""
    return RobotTimeout(
        f"mock robot {name}: no state row within {timeout_s:g} s",
        hint="check the connection and whether the controller is still switched on",
    )
