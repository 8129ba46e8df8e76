"""Robot modes and safety modes of the controller, and the table of their transitions.

| robot mode | event                                   | next robot modes                   |
|------------|-----------------------------------------|------------------------------------|
| POWER_OFF  | power on *                              | BOOTING, POWER_ON, IDLE            |
| POWER_OFF  | release brakes *                        | BOOTING, POWER_ON, IDLE, RUNNING   |
| IDLE       | release brakes *                        | IDLE, RUNNING                      |
| any        | power off, release emergency stop       | POWER_OFF                          |
| any        | emergency stop (both), violation, fault | the same for 0.5 s, then POWER_OFF |
| any        | restart safety                          | BOOTING for 2 s, then POWER_OFF    |

Events marked with * in the table of robot modes have an effect only in safety mode NORMAL or
REDUCED. Events that also change the safety mode have an effect only in the safety modes for which
the table of safety modes contains the event. The safety modes 1 to 5
are NORMAL, REDUCED, PROTECTIVE_STOP, RECOVERY and SAFEGUARD_STOP.

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
    """Values of `robot_mode` in RTDE."""

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
"""Sequence of robot modes with the duration of each [s]; the last mode remains."""


class SafetyMode(IntEnum):
    """Values of `safety_mode` in RTDE."""

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
"""Safety modes in which the arm may move."""


@dataclass(frozen=True, slots=True)
class Transition:
    """Effect of one cause on the modes.

    Attributes:
        cause: Event or request.
        robot, safety: Robot modes and safety modes in which this transition applies.
        path: Sequence of robot modes after the event; empty if the robot mode does not change.
        becomes: Safety mode after the transition; None if the safety mode does not change.
        after_s: Minimum duration of the present safety mode [s].
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
"""Time until the power is switched off in a category 1 stop [s]; the servo brakes along the
path until then.
"""

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
"""All transitions between modes; a cause without a matching entry is refused.

If the brakes are released while the arm is off, the arm is switched on first (ROS driver,
`brake_release`). The durations were chosen for this project: real arms take several seconds.
"""


class Modes:
    """Present modes of the controller.

    Args:
        tick_s: Device time of a tick [s].
        powered: Whether the arm starts switched on and with released brakes.

    Attributes:
        robot, safety: Present robot mode and safety mode.
        remote: Whether the controller is in remote control.
        stop_code: Code of the fault that stopped the arm; 0 for none.
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
        """Whether the servo controls the arm and is allowed to move it."""
        return self.robot is RobotMode.RUNNING and self.safety in SAFE

    def tick(self) -> None:
        """Advance the modes by one tick of device time."""
        self._lasted_s += self._tick_s
        if self._ahead:
            self._left_s -= self._tick_s
            if self._left_s <= 0:
                self._walk(self._ahead)

    def cause(self, what: str) -> bool:
        """Apply a cause; return False if it has no effect in the present modes.

        Args:
            what: Cause in `TRANSITIONS`.
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
        """Switch the arm on with closed brakes; return False if this is refused."""
        return self.cause("power on")

    def release_brakes(self) -> bool:
        """Release the brakes, after switching the arm on if necessary; return False if refused."""
        return self.cause("release brakes")

    def power_off(self) -> None:
        """Switch the arm off."""
        self.cause("power off")

    def protective_stop(self, code: int = 0) -> None:
        """Trigger a protective stop; `unlock` ends it."""
        if self.cause("protective stop"):
            self.stop_code = code

    def emergency_stop(self) -> None:
        """Trigger an emergency stop: the arm brakes, then its power is switched off."""
        self.cause("emergency stop")

    def release_emergency_stop(self) -> None:
        """Release the emergency stop; the arm is then off."""
        self.cause("release emergency stop")

    def unlock(self) -> bool:
        """End a protective stop; return False within 5 s of its start, like a real controller."""
        return self.cause("unlock")

    def fault(self, code: int = 0) -> None:
        """Trigger a fault of the safety system; only `restart_safety` ends it."""
        if self.cause("fault"):
            self.stop_code = code

    def restart_safety(self) -> bool:
        """Restart the safety system, with the arm off; return False during an emergency stop."""
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
    """Values of `runtime_state` in RTDE."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


JOINT_RUNNING, JOINT_IDLE, JOINT_POWER_OFF, JOINT_BOOTING, JOINT_FAULT = 253, 255, 239, 247, 252
"""Values of `joint_mode` in RTDE that the mock sends."""

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
"""Map from safety mode to `safety_status_bits` in RTDE."""
