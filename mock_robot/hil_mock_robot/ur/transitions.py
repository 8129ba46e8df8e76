"""What leads from one power or safety mode to another: the whole state machine, in one table."""

from __future__ import annotations

from dataclasses import dataclass

from hil_mock_robot.ur.mode_codes import SAFE, RobotMode, SafetyMode

EMERGENCY = (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP)
STOPPED = (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP, SafetyMode.RECOVERY)
BROKEN = (SafetyMode.VIOLATION, SafetyMode.FAULT)
ANY = tuple(RobotMode)

BOOTING_S, POWERING_S, RELEASING_S = 0.6, 0.4, 0.5
UNLOCK_AFTER_S = 5.0
POWER_CUT_S = 0.5
"""A category 1 stop: the servo brakes along the path, then the power is gone."""

RESTARTING_S = 2.0

Stay = None
Path = tuple[tuple[RobotMode | None, float], ...]
"""Robot modes one after the other, and the seconds in each; the last one stays."""

_UP: Path = ((RobotMode.BOOTING, BOOTING_S), (RobotMode.POWER_ON, POWERING_S))
_IDLE: Path = ((RobotMode.IDLE, 0.0),)
_RELEASE: Path = ((RobotMode.IDLE, RELEASING_S), (RobotMode.RUNNING, 0.0))
_OFF: Path = ((RobotMode.POWER_OFF, 0.0),)
_CUT: Path = ((Stay, POWER_CUT_S), *_OFF)


@dataclass(frozen=True, slots=True)
class Transition:
    """What one cause does.

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
