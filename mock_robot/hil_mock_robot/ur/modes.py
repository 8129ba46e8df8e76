"""Power and safety of the controller: which mode it is in."""

from __future__ import annotations

from hil_mock_robot.ur.mode_codes import (
    JOINT_BOOTING,
    JOINT_FAULT,
    JOINT_IDLE,
    JOINT_POWER_OFF,
    JOINT_RUNNING,
    SAFE,
    SAFETY_BITS,
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from hil_mock_robot.ur.transitions import TRANSITIONS, UNLOCK_AFTER_S, Path, Transition

__all__ = [
    "JOINT_BOOTING",
    "JOINT_FAULT",
    "JOINT_IDLE",
    "JOINT_POWER_OFF",
    "JOINT_RUNNING",
    "SAFE",
    "SAFETY_BITS",
    "UNLOCK_AFTER_S",
    "Modes",
    "RobotMode",
    "RuntimeState",
    "SafetyMode",
]


class Modes:
    """Which mode the controller is in.

    Args:
        tick_s: Device time of a tick.
        powered: Whether the arm is switched on and its brakes released at the start.

    Attributes:
        robot, safety: The present modes.
        remote: Whether commands from outside are obeyed.
        stop_code: Number of the fault that stopped the arm, 0 for none.
    """

    def __init__(self, tick_s: float, *, powered: bool = True) -> None:
        self._tick_s = tick_s
        self.robot = RobotMode.RUNNING if powered else RobotMode.POWER_OFF
        self.safety = SafetyMode.NORMAL
        self.remote = True
        self.stop_code = 0
        self._left_s = 0.0
        self._ahead: Path = ()
        self._lasted_s = 0.0

    @property
    def running(self) -> bool:
        """Whether the servo holds the arm and may move it."""
        return self.robot is RobotMode.RUNNING and self.safety in SAFE

    def tick(self) -> None:
        """Let a tick of device time pass."""
        self._lasted_s += self._tick_s
        if self._ahead:
            self._left_s -= self._tick_s
            if self._left_s <= 0:
                self._walk(self._ahead)

    def cause(self, what: str) -> bool:
        """Let something happen; False when it leads nowhere from here.

        Args:
            what: A cause of `TRANSITIONS`.
        """
        row = self._row(what)
        if row is None:
            return False
        if row.becomes is not None and row.becomes is not self.safety:
            self.safety, self._lasted_s = row.becomes, 0.0
            if row.becomes in SAFE:
                self.stop_code = 0
        if row.path:
            self._walk(row.path)
        return True

    def power_on(self) -> bool:
        """Switch the arm on; its brakes stay engaged. False when that is not possible now."""
        return self.cause("power on")

    def release_brakes(self) -> bool:
        """Let the servo hold the arm, switched on first if need be. False when not now."""
        return self.cause("release brakes")

    def power_off(self) -> None:
        """Switch the arm off."""
        self.cause("power off")

    def protective_stop(self, code: int = 0) -> None:
        """Stop because something is wrong; `unlock` ends it."""
        if self.cause("protective stop"):
            self.stop_code = code

    def emergency_stop(self) -> None:
        """The red button: the arm brakes, then its power is cut."""
        self.cause("emergency stop")

    def release_emergency_stop(self) -> None:
        """The red button is turned out again; the arm is off then."""
        self.cause("release emergency stop")

    def unlock(self) -> bool:
        """End a protective stop. False before its cause was looked at for 5 s, as the real one."""
        return self.cause("unlock")

    def fault(self, code: int = 0) -> None:
        """The safety system itself fails; `restart_safety` is the only way out."""
        if self.cause("fault"):
            self.stop_code = code

    def restart_safety(self) -> bool:
        """Boot the safety system again; the arm is off then. False under an emergency stop."""
        return self.cause("restart safety")

    def _row(self, what: str) -> Transition | None:
        for row in TRANSITIONS:
            applies = self.robot in row.robot and self.safety in row.safety
            if row.cause == what and applies and self._lasted_s >= row.after_s:
                return row
        return None

    def _walk(self, path: Path) -> None:
        (mode, self._left_s), *ahead = path
        if mode is not None:
            self.robot = mode
        self._ahead = tuple(ahead)
