"""Options of a UR arm in a station file, and the capabilities and limits that follow from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from hil.arms import load_arm
from hil.core import FloatArray, SpecError
from hil.robot import Capabilities, EffortKind, Limits, Segment
from hil_drivers import arm
from hil_drivers.network import host_of
from hil_drivers.option_checks import OptionChecks

SERIES_HZ = {"ur3": 125, "ur5": 125, "ur10": 125, "ur3e": 500, "ur5e": 500, "ur10e": 500}
"""Tick rate of the controller of each arm [Hz]: 125 for CB3, 500 for e-Series."""

RANGES = {
    "lookahead_s": (0.03, 0.2),
    "gain": (100.0, 2000.0),
    "watchdog_hz": (0.1, 50.0),
    "stop_rad_s2": (0.5, 40.0),
    "stop_m_s2": (0.1, 150.0),
    "lag_s": (0.05, 2.0),
    "lag_rad": (0.005, 1.0),
    "late_s": (0.02, 5.0),
    "speed_share": (0.01, 1.0),
}
"""Minimum and maximum of each numeric option; for options of the controller, the range that UR
specifies."""

RAMP_SLACK_S = 0.1
"""Maximum device time [s], in addition to the duration of the ramp, for commanding a stop and
detecting its end."""

CHOICES = {
    "moves": ("movej", "servoj"),
    "torque_source": ("current", "current-as-torque", "target-moment"),
}

MOST_SPEED, MOST_ACCELERATION = 3.14, 40.0
"""Maximum joint speed and acceleration that `ur-rtde` accepts [rad/s, rad/s²]."""


@dataclass(frozen=True, slots=True)
class Options:
    """Options of one UR arm.

    Attributes:
        address: IP address or host name of the controller; the port numbers are fixed.
        frequency_hz: Number of samples and set-points per second; None for the controller's tick
            rate.
        moves: Execution of moves from rest to rest: planned by the controller (`movej`), or by
            set-points of the driver (`servoj`).
        lookahead_s, gain: `servoj` parameters: smoothing time [s] and position gain.
        watchdog_hz: Command rate below which the controller stops its program [Hz].
        stop_rad_s2: Deceleration of `stop` during a controller-planned move, for the fastest joint
            [rad/s²].
        stop_m_s2: Deceleration of `stop` during a `servoj` motion, for the tool [m/s²]; increased
            if the stop would exceed the watchdog period.
        lag_s, lag_rad: Maximum delay [s] and deviation [rad] of the arm from the commanded path.
        late_s: Duration of silence of the controller, or delay of the driver's set-points, above
            which a motion is ended [s].
        torque_source: Quantity recorded in the field `effort`: motor current [A] (`current`),
            current converted to torque [N·m] (`current-as-torque`), or the torque of the
            controller's model [N·m] (`target-moment`), which is not a measurement.
        speed_share: Share of the arm's joint speed limits that a plan may use.
    """

    address: str
    frequency_hz: float | None = None
    moves: Literal["movej", "servoj"] = "movej"
    lookahead_s: float = 0.1
    gain: float = 300.0
    watchdog_hz: float = 2.0
    stop_rad_s2: float = 8.0
    stop_m_s2: float = 10.0
    lag_s: float = 0.4
    lag_rad: float = 0.05
    late_s: float = 0.1
    torque_source: Literal["current", "current-as-torque", "target-moment"] = "current"
    speed_share: float = 1.0

    @property
    def resource(self) -> str:
        """Resource name of the arm, which is independent of the name of the robot in a station."""
        return f"ur://{self.address}"


_CHECKS = OptionChecks("ur")


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """Return the options of a built-in arm from the mapping of a station file.

    Raises:
        SpecError: The model is not a UR arm, or an option is missing, unknown or invalid.
    """
    if model not in SERIES_HZ:
        raise SpecError(
            f"the driver ur cannot move a {model}", hint=f"use one of {', '.join(SERIES_HZ)}"
        )
    _CHECKS.require_known(given, [field.name for field in fields(Options)])
    address = _address(given.get("address"))
    for name, between in RANGES.items():
        if name in given:
            _CHECKS.number(name, given[name], between)
    for name, choices in CHOICES.items():
        if name in given:
            _CHECKS.choice(name, given[name], choices)
    if given.get("torque_source") == "current-as-torque" and SERIES_HZ[model] == 125:
        raise _CHECKS.wrong_option(
            "torque_source", "current-as-torque", "use current: a CB3 controller reports no torque"
        )
    _require_frequency(given.get("frequency_hz"), model)
    options = Options(**{**given, "address": address})
    _require_ramp(options, model)
    return options


def _address(value: Any) -> str:
    hint = "give the IP address of the controller, as its network settings show it"
    if value is None:
        raise _CHECKS.lacking("address", hint)
    host = host_of(value) if isinstance(value, str) else None
    if host is None:
        raise _CHECKS.wrong_option("address", value, hint)
    return host


def _require_frequency(value: Any, model: str) -> None:
    """Raise unless the time between two samples is a whole number of controller ticks."""
    if value is None:
        return
    base = SERIES_HZ[model]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    fits = number and 10.0 <= value <= base and math.isclose(base / value, round(base / value))
    if not fits:
        rates = ", ".join(f"{base / k:g}" for k in (1, 2, 4, 5) if base % k == 0)
        raise _CHECKS.wrong_option(
            "frequency_hz", value, f"use {base} Hz divided by a whole number: {rates}"
        )


def _require_ramp(options: Options, model: str) -> None:
    """Raise if a stop from full speed takes longer than the watchdog period."""
    fastest = min(max(load_arm(model).qd_max) * options.speed_share, MOST_SPEED)
    left_s = 1.0 / options.watchdog_hz - RAMP_SLACK_S
    if left_s <= 0.0 or fastest / options.stop_rad_s2 > left_s:
        ramp_s = fastest / options.stop_rad_s2 + RAMP_SLACK_S
        raise _CHECKS.wrong_option(
            "watchdog_hz",
            options.watchdog_hz,
            f"a stop from {fastest:.2f} rad/s with {options.stop_rad_s2:g} rad/s² takes "
            f"{ramp_s:.2f} s, in which the watchdog is not fed: use at most {1 / ramp_s:.2f} Hz, "
            "a larger stop_rad_s2 or a smaller speed_share",
        )


def capabilities_of(model: str, options: Options) -> Capabilities:
    """Return names, rate and effort kind of an arm."""
    effort: EffortKind = "current" if options.torque_source == "current" else "torque"
    return arm.capabilities_of(model, options.frequency_hz, effort)


def limits_of(model: str, options: Options, reported: arm.ReportedLimits | None = None) -> Limits:
    """Return the manufacturer's joint limits, narrowed by the controller's limits if known."""
    return arm.limits_of(model, reported, options.speed_share)


def require_playable(segment: Segment, limits: Limits, standing: FloatArray) -> None:
    """Raise if the arm cannot execute a segment, or if `ur-rtde` would refuse the segment.

    Args:
        segment: Next segment.
        limits: Joint limits of the arm.
        standing: Present set-point of the arm, (6,) [rad].

    Raises:
        CommandRefused: The segment is not executable (`hil_drivers.arm.require_executable`), or its
            speed or acceleration exceeds the limits of `ur-rtde`.
    """
    arm.require_executable(segment, limits, standing)
    where = f"segment {segment.index} ({segment.kind})"
    if not 0 <= segment.speed <= MOST_SPEED * arm.SPEED_SLACK:
        raise arm.refused(
            f"{where} needs {segment.speed:.3f} rad/s, at most {MOST_SPEED} are possible"
        )
    if not 0 <= segment.acceleration <= MOST_ACCELERATION:
        raise arm.refused(
            f"{where} needs {segment.acceleration:.1f} rad/s², "
            f"at most {MOST_ACCELERATION} are possible"
        )
