"""Power and safety modes of the controller, and the table of what leads from one to another.

| robot mode | event                                   | next robot modes                   |
|------------|-----------------------------------------|------------------------------------|
| POWER_OFF  | power on *                              | BOOTING, POWER_ON, IDLE            |
| POWER_OFF  | release brakes *                        | BOOTING, POWER_ON, IDLE, RUNNING   |
| IDLE       | release brakes *                        | IDLE, RUNNING                      |
| any        | power off, release emergency stop       | POWER_OFF                          |
| any        | emergency stop (both), violation, fault | the same for 0.5 s, then POWER_OFF |
| any        | restart safety                          | BOOTING for 2 s, then POWER_OFF    |

* In safety mode NORMAL or REDUCED only. Events that also change the safety mode happen only in the
safety modes below; 1 to 5 are NORMAL, REDUCED, PROTECTIVE_STOP, RECOVERY and SAFEGUARD_STOP.

| safety mode                     | event                  | next safety mode      |
|---------------------------------|------------------------|-----------------------|
| NORMAL                          | reduce                 | REDUCED               |
| REDUCED                         | end reduction          | NORMAL                |
| NORMAL, REDUCED                 | safeguard stop         | SAFEGUARD_STOP        |
| SAFEGUARD_STOP                  | end safeguard stop     | NORMAL                |
| NORMAL, REDUCED, SAFEGUARD_STOP | protective stop        | PROTECTIVE_STOP       |
| PROTECTIVE_STOP for 5 s         | unlock                 | NORMAL                |
| 1 to 5                          | emergency stop         | ROBOT_EMERGENCY_STOP  |
| 1 to 5                          | system emergency stop  | SYSTEM_EMERGENCY_STOP |
| 1 to 5                          | violation              | VIOLATION             |
| any                             | fault                  | FAULT                 |
| ROBOT_, SYSTEM_EMERGENCY_STOP   | release emergency stop | NORMAL                |
| any but these two               | restart safety         | NORMAL                |
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class RobotMode(IntEnum):
    """Values of RTDE's `robot_mode`."""

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


Path = tuple[tuple[RobotMode | None, float], ...]
"""Robot modes one after the other, and the seconds in each; the last one stays."""


class SafetyMode(IntEnum):
    """Values of RTDE's `safety_mode`."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


SAFE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
"""Modes in which the arm may move."""


@dataclass(frozen=True, slots=True)
class Transition:
    """The effect of one cause.

    Attributes:
        cause: What happens, or what is asked for.
        robot, safety: Modes in which this row applies.
        path: Robot modes that follow; empty when the robot mode does not change.
        becomes: Safety mode afterwards, None for the same.
        after_s: So long the safety mode must have lasted.
    """

    cause: str
    robot: tuple[RobotMode, ...]
    safety: tuple[SafetyMode, ...]
    path: Path = ()
    becomes: SafetyMode | None = None
    after_s: float = 0.0


BOOTING_S, POWERING_S, RELEASING_S = 0.6, 0.4, 0.5
_UP: Path = ((RobotMode.BOOTING, BOOTING_S), (RobotMode.POWER_ON, POWERING_S))
_IDLE: Path = ((RobotMode.IDLE, 0.0),)
_RELEASE: Path = ((RobotMode.IDLE, RELEASING_S), (RobotMode.RUNNING, 0.0))
ANY = tuple(RobotMode)
_OFF: Path = ((RobotMode.POWER_OFF, 0.0),)
UNLOCK_AFTER_S = 5.0
STOPPED = (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP, SafetyMode.RECOVERY)
Stay = None

POWER_CUT_S = 0.5
"""A category 1 stop: the servo brakes along the path, then the power is gone."""

_CUT: Path = ((Stay, POWER_CUT_S), *_OFF)
EMERGENCY = (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP)
BROKEN = (SafetyMode.VIOLATION, SafetyMode.FAULT)
RESTARTING_S = 2.0

TRANSITIONS = (
    Transition("power on", (RobotMode.POWER_OFF,), SAFE, (*_UP, *_IDLE)),
    Transition("release brakes", (RobotMode.IDLE,), SAFE, _RELEASE),
    Transition("release brakes", (RobotMode.POWER_OFF,), SAFE, (*_UP, *_RELEASE)),
    Transition("power off", ANY, tuple(SafetyMode), _OFF),
    Transition("reduce", ANY, (SafetyMode.NORMAL,), (), SafetyMode.REDUCED),
    Transition("end reduction", ANY, (SafetyMode.REDUCED,), (), SafetyMode.NORMAL),
    Transition(
        "protective stop",
        ANY,
        (*SAFE, SafetyMode.SAFEGUARD_STOP),
        (),
        SafetyMode.PROTECTIVE_STOP,
    ),
    Transition("unlock", ANY, (SafetyMode.PROTECTIVE_STOP,), (), SafetyMode.NORMAL, UNLOCK_AFTER_S),
    Transition("safeguard stop", ANY, SAFE, (), SafetyMode.SAFEGUARD_STOP),
    Transition("end safeguard stop", ANY, (SafetyMode.SAFEGUARD_STOP,), (), SafetyMode.NORMAL),
    Transition("emergency stop", ANY, (*SAFE, *STOPPED), _CUT, SafetyMode.ROBOT_EMERGENCY_STOP),
    Transition(
        "system emergency stop", ANY, (*SAFE, *STOPPED), _CUT, SafetyMode.SYSTEM_EMERGENCY_STOP
    ),
    Transition("release emergency stop", ANY, EMERGENCY, _OFF, SafetyMode.NORMAL),
    Transition("violation", ANY, (*SAFE, *STOPPED), _CUT, SafetyMode.VIOLATION),
    Transition("fault", ANY, (*SAFE, *STOPPED, *EMERGENCY, *BROKEN), _CUT, SafetyMode.FAULT),
    Transition(
        "restart safety",
        ANY,
        (*SAFE, *STOPPED, *BROKEN),
        ((RobotMode.BOOTING, RESTARTING_S), *_OFF),
        SafetyMode.NORMAL,
    ),
)
"""Everything that leads from one mode to another; whatever has no row here is refused.

Brakes that are released while the arm is off switch it on first (ROS driver, `brake_release`).
Durations are this project's: real arms take several seconds.
"""


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
        """Let a cause take effect; return False if it has none in the present modes.

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
        """Let the servo hold the arm, switched on first if need be; return False if not allowed."""
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


class RuntimeState(IntEnum):
    """Values of RTDE's `runtime_state`."""

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
