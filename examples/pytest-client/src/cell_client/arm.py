"""Moves a UR by `ur-rtde`, and gets it going again after a protective stop."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from types import TracebackType

import dashboard_client
import rtde_control
import rtde_receive

UNLOCK_WITHIN_S = 30.0


class ProtectiveStop(Exception):
    """The arm has stopped on the way; `recover` once the cause is gone."""


class Arm:
    """A UR arm that is switched on.

    Args:
        host: Address of its controller.
    """

    def __init__(self, host: str) -> None:
        self._dashboard = dashboard_client.DashboardClient(host)
        self._dashboard.connect()
        self._receive = rtde_receive.RTDEReceiveInterface(host)
        self._control = rtde_control.RTDEControlInterface(host)

    def __enter__(self) -> Arm:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        self._control.disconnect()
        self._receive.disconnect()
        self._dashboard.disconnect()

    def joints(self) -> list[float]:
        """Where the arm is [rad]."""
        return list(self._receive.getActualQ())

    def move(self, joints: Sequence[float], speed: float = 1.0, acceleration: float = 2.0) -> None:
        """Go there, joint by joint, and wait until the arm has got there.

        Args:
            joints: Six angles [rad].
            speed: Of the leading joint [rad/s].
            acceleration: The same [rad/s²].

        Raises:
            ProtectiveStop: It stopped on the way.
        """
        done = self._control.moveJ(list(joints), speed, acceleration)
        if self._receive.isProtectiveStopped():
            raise ProtectiveStop(f"stopped at {self.joints()}")
        if not done:
            raise RuntimeError("the controller has not made the move")

    def recover(self) -> None:
        """Unlock the arm, which takes five seconds after a stop, and get ready for moves."""
        until = time.monotonic() + UNLOCK_WITHIN_S
        while self._receive.isProtectiveStopped():
            if time.monotonic() > until:
                raise ProtectiveStop("it cannot be unlocked")
            self._dashboard.closeSafetyPopup()
            with contextlib.suppress(RuntimeError):  # not before five seconds are over
                self._dashboard.unlockProtectiveStop()
            time.sleep(0.1)
        self._control.reuploadScript()
        while not self._control.isProgramRunning():  # it returns a moment too early
            if time.monotonic() > until:
                raise ProtectiveStop("the control program does not start again")
            time.sleep(0.01)
