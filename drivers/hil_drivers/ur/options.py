"""What a station file may say about a UR arm, and the facts and limits that follow from it."""

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
"""Ticks per second of the controller that moves an arm: CB3 125, e-Series 500 [Hz]."""

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
"""Least and most of the options that are numbers; UR's own where the controller has them."""

RAMP_SLACK_S = 0.1
"""Device time that commanding a stop and hearing of its end takes beside the ramp, at most [s]."""

CHOICES = {
    "moves": ("movej", "servoj"),
    "torque_source": ("current", "current-as-torque", "target-moment"),
}

MOST_SPEED, MOST_ACCELERATION = 3.14, 40.0
"""What `ur-rtde` lets through to the controller [rad/s, rad/s²]."""


@dataclass(frozen=True, slots=True)
class Options:
    """The options of one arm.

    Attributes:
        address: IP address or host name of the controller; its ports cannot be chosen.
        frequency_hz: Samples and set-points per second; the controller's own when None.
        moves: `movej`: the controller plans moves from rest to rest; `servoj`: it is led along.
        lookahead_s, gain: Of `servoj`: how it smooths [s], and how hard it follows.
        watchdog_hz: The controller stops its program when it is commanded less often than this.
        stop_rad_s2: Deceleration of `stop` out of a move, by the fastest joint.
        stop_m_s2: Deceleration of `stop` while the arm is led along, by the tool; harder where
            the watchdog's period would not do.
        lag_s, lag_rad: How late, and how far beside the commanded path, the arm may follow.
        late_s: Silence of the controller, or lateness of our set-points, that ends a motion.
        torque_source: What `effort` is: motor current [A], the current as torque [N·m], or the
            torque of the controller's own model [N·m], which is no measurement.
        speed_share: Share of the arm's joint speeds that may be used.
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
        """Which arm this is, whatever a station calls it."""
        return f"ur://{self.address}"


_CHECKS = OptionChecks("ur")


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """The options of a station's mapping, for a built-in arm.

    Raises:
        SpecError: One is missing, unknown, or cannot be.
    """
    if model not in SERIES_HZ:
        raise SpecError(f"the driver ur moves no {model}", hint=f"it moves {', '.join(SERIES_HZ)}")
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
            "torque_source", "current-as-torque", "a CB3 controller tells `current`"
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
    """An integer number of the controller's ticks has to lie between two samples."""
    if value is None:
        return
    base = SERIES_HZ[model]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    fits = number and 10.0 <= value <= base and math.isclose(base / value, round(base / value))
    if not fits:
        rates = ", ".join(f"{base / k:g}" for k in (1, 2, 4, 5) if base % k == 0)
        raise _CHECKS.wrong_option("frequency_hz", value, f"use a whole part of {base} Hz: {rates}")


def _require_ramp(options: Options, model: str) -> None:
    """A stop at full speed has to be over before the watchdog takes it for our end."""
    fastest = min(max(load_arm(model).qd_max) * options.speed_share, MOST_SPEED)
    left_s = 1.0 / options.watchdog_hz - RAMP_SLACK_S
    if left_s <= 0.0 or fastest / options.stop_rad_s2 > left_s:
        ramp_s = fastest / options.stop_rad_s2 + RAMP_SLACK_S
        raise _CHECKS.wrong_option(
            "watchdog_hz",
            options.watchdog_hz,
            f"a stop out of {fastest:.2f} rad/s with {options.stop_rad_s2:g} rad/s² takes "
            f"{ramp_s:.2f} s, in which nobody can feed the watchdog: at most {1 / ramp_s:.2f} Hz, "
            "or a larger stop_rad_s2, or a smaller speed_share",
        )


def capabilities_of(model: str, options: Options) -> Capabilities:
    """Return names, rate and the meaning of `effort`."""
    effort: EffortKind = "current" if options.torque_source == "current" else "torque"
    return arm.capabilities_of(model, options.frequency_hz, effort)


def limits_of(model: str, options: Options, reported: arm.ReportedLimits | None = None) -> Limits:
    """Return the maker's limits, narrowed by the controller's own once they are known."""
    return arm.limits_of(model, reported, options.speed_share)


def require_playable(segment: Segment, limits: Limits, standing: FloatArray) -> None:
    """Raise if the arm cannot execute a segment, or `ur-rtde` would refuse it.

    Args:
        segment: The next one.
        limits: Of the arm.
        standing: (6,) the set-point it holds [rad].

    Raises:
        CommandRefused: See `hil_drivers.arm.require_executable`.
    """
    arm.require_executable(segment, limits, standing)
    where = f"segment {segment.index} ({segment.kind})"
    if not 0 <= segment.speed <= MOST_SPEED * arm.SPEED_SLACK:
        raise arm.refused(f"{where} asks for {segment.speed:.3f} rad/s, at most {MOST_SPEED} go")
    if not 0 <= segment.acceleration <= MOST_ACCELERATION:
        raise arm.refused(
            f"{where} asks for {segment.acceleration:.1f} rad/s², at most {MOST_ACCELERATION} go"
        )
