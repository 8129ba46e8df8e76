"""Power and safety of the controller, as RTDE numbers them."""

from __future__ import annotations

from enum import IntEnum


class RobotMode(IntEnum):
    """RTDE `robot_mode`."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(IntEnum):
    """RTDE `safety_mode`."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


class RuntimeState(IntEnum):
    """RTDE `runtime_state`."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


JOINT_RUNNING, JOINT_IDLE, JOINT_POWER_OFF, JOINT_BOOTING, JOINT_FAULT = 253, 255, 239, 247, 252
"""RTDE `joint_mode`."""

SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.REDUCED: 1 << 1,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.RECOVERY: 1 << 3,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    SafetyMode.SYSTEM_EMERGENCY_STOP: 1 << 5 | 1 << 7 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
    SafetyMode.VIOLATION: 1 << 8 | 1 << 10,
    SafetyMode.FAULT: 1 << 9 | 1 << 10,
}
"""RTDE `safety_status_bits`."""

SAFE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
POWERING_S, RELEASING_S, UNLOCK_AFTER_S = 1.0, 0.5, 5.0


class Modes:
    """Which mode the controller is in, and what leads from one to the next.

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
        self._next: RobotMode | None = None
        self._stopped_s = 0.0

    @property
    def running(self) -> bool:
        """Whether the servo holds the arm and may move it."""
        return self.robot is RobotMode.RUNNING and self.safety in SAFE

    def tick(self) -> None:
        """Let a tick of device time pass."""
        if self.safety not in SAFE:
            self._stopped_s += self._tick_s
        if self._next is None:
            return
        self._left_s -= self._tick_s
        if self._left_s <= 0:
            self.robot, self._next = self._next, None

    def power_on(self) -> bool:
        """Switch the arm on; its brakes stay engaged. False when that is not possible now."""
        if self.robot is not RobotMode.POWER_OFF or self.safety not in SAFE:
            return False
        self._become(RobotMode.BOOTING, RobotMode.IDLE, POWERING_S)
        return True

    def release_brakes(self) -> bool:
        """Let the servo hold the arm. False when that is not possible now."""
        if self.robot is not RobotMode.IDLE or self.safety not in SAFE:
            return False
        self._become(RobotMode.IDLE, RobotMode.RUNNING, RELEASING_S)
        return True

    def power_off(self) -> None:
        """Switch the arm off."""
        self._become(RobotMode.POWER_OFF, None, 0.0)

    def protective_stop(self, code: int = 0) -> None:
        """Stop because something is wrong; `unlock` ends it."""
        if self.safety in SAFE:
            self._stop(SafetyMode.PROTECTIVE_STOP, code)

    def emergency_stop(self) -> None:
        """The red button."""
        if self.safety is not SafetyMode.ROBOT_EMERGENCY_STOP:
            self._stop(SafetyMode.ROBOT_EMERGENCY_STOP, 0)

    def release_emergency_stop(self) -> None:
        """The red button is turned out again; the arm is off then."""
        if self.safety is SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety = SafetyMode.NORMAL
            self.power_off()

    def unlock(self) -> bool:
        """End a protective stop. False before its cause was looked at for 5 s, as the real one."""
        if self.safety is not SafetyMode.PROTECTIVE_STOP or self._stopped_s < UNLOCK_AFTER_S:
            return False
        self.safety, self.stop_code = SafetyMode.NORMAL, 0
        return True

    def _stop(self, safety: SafetyMode, code: int) -> None:
        self.safety, self.stop_code, self._stopped_s = safety, code, 0.0

    def _become(self, now: RobotMode, then: RobotMode | None, after_s: float) -> None:
        self.robot, self._next, self._left_s = now, then, after_s
