"""What a station file may say about a UR arm, beside its name and model."""

from __future__ import annotations

import ipaddress
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

from hil.arms import load_arm
from hil.core import SpecError, closest

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

_HOST = re.compile(r"[a-z0-9]([a-z0-9-]*[a-z0-9])?(\.[a-z0-9]([a-z0-9-]*[a-z0-9])?)*")


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


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """The options of a station's mapping, for a built-in arm.

    Raises:
        SpecError: One is missing, unknown, or cannot be.
    """
    if model not in SERIES_HZ:
        raise SpecError(f"the driver ur moves no {model}", hint=f"it moves {', '.join(SERIES_HZ)}")
    known = [field.name for field in fields(Options)]
    if unknown := sorted(set(given) - set(known)):
        raise SpecError(
            f"the driver ur has no option {', '.join(unknown)}",
            hint=f"{_meant(unknown, known)}its options are {', '.join(known)}",
        )
    address = _address(given.get("address"))
    for name, (least, most) in RANGES.items():
        if name in given and not _within(given[name], least, most):
            raise wrong_option(name, given[name], f"use a number from {least:g} to {most:g}")
    for name, choices in CHOICES.items():
        if name in given and given[name] not in choices:
            raise wrong_option(name, given[name], f"use {', '.join(choices)}")
    if given.get("torque_source") == "current-as-torque" and SERIES_HZ[model] == 125:
        raise wrong_option("torque_source", "current-as-torque", "a CB3 controller tells `current`")
    _require_frequency(given.get("frequency_hz"), model)
    options = Options(**{**given, "address": address})
    _require_ramp(options, model)
    return options


def wrong_option(name: str, value: object, hint: str) -> SpecError:
    """The error that says what one option was and what would be right."""
    return SpecError(f"ur option {name} is {value!r}", hint=hint)


def _meant(unknown: list[str], known: list[str]) -> str:
    """What somebody may have wanted to type; empty when nobody can say."""
    meant = [repr(like) for name in unknown if (like := closest(name, known))]
    return f"did you mean {', '.join(meant)}? " if meant else ""


def _address(value: Any) -> str:
    """One way of writing it: two stations that mean one arm must say the same."""
    text = value.strip().lower() if isinstance(value, str) else ""
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        if _HOST.fullmatch(text) and not re.fullmatch(r"[0-9.]+", text):
            return text
    hint = "give the IP address of the controller, as its network settings show it"
    if value is None:
        raise SpecError("the driver ur lacks its option address", hint=hint)
    raise wrong_option("address", value, hint)


def _require_frequency(value: Any, model: str) -> None:
    """An integer number of the controller's ticks has to lie between two samples."""
    base = SERIES_HZ[model]
    fits = _within(value, 10.0, base) and math.isclose(base / value, round(base / value))
    if value is not None and not fits:
        rates = ", ".join(f"{base / k:g}" for k in (1, 2, 4, 5) if base % k == 0)
        raise wrong_option("frequency_hz", value, f"use a whole part of {base} Hz: {rates}")


def _require_ramp(options: Options, model: str) -> None:
    """A stop at full speed has to be over before the watchdog takes it for our end."""
    fastest = min(max(load_arm(model).qd_max) * options.speed_share, MOST_SPEED)
    left_s = 1.0 / options.watchdog_hz - RAMP_SLACK_S
    if left_s <= 0.0 or fastest / options.stop_rad_s2 > left_s:
        ramp_s = fastest / options.stop_rad_s2 + RAMP_SLACK_S
        raise wrong_option(
            "watchdog_hz",
            options.watchdog_hz,
            f"a stop out of {fastest:.2f} rad/s with {options.stop_rad_s2:g} rad/s² takes "
            f"{ramp_s:.2f} s, in which nobody can feed the watchdog: at most {1 / ramp_s:.2f} Hz, "
            "or a larger stop_rad_s2, or a smaller speed_share",
        )


def _within(value: Any, least: float, most: float) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and least <= value <= most
