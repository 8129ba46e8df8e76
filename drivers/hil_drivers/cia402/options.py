"""Options of an arm on CiA 402 drives in a station file, apart from name and model of the arm.

`options_of` converts the station's mapping into `Options`; the error for an invalid option contains
the valid values. `options_of` also rejects invalid combinations, such as a mapping without the
objects that a mode needs, or a rate that exceeds the capacity of the bus. The option `bus` is
described in `can_channel`. The keys of `axes` become fields of `profile.AxisProfile` (angles are in
degrees in the station).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from hil.arms import ArmDescription, load_arm
from hil.robot import Address
from hil_drivers.cia402.can_channel import SIMULATED, CanChannel, bus_of, require_room
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.profile import COUNTS_PER_REV_S, PROFILES
from hil_drivers.option_checks import OptionChecks, Range

MASTER_ID = 127

LATE_CYCLES, LATE_CYCLES_SIMULATED = 3, 50
"""Defaults of `late_cycles` for real and for simulated drives.

Real drives enter fault after a few missing set-points. Simulated drives on a busy computer are
tolerated if they do not answer for 0.2 s.
"""


@dataclass(frozen=True, slots=True)
class Options:
    """Options of one arm.

    Attributes:
        bus: CAN bus of the drives.
        nodes: CANopen ids of the drives, in the order of the joints.
        rate_hz: Rate of the cycles in device time [Hz]: every cycle has a SYNC, a set-point and a
            sample.
        mapping: Name of the PDO mapping, a key of `hil_drivers.cia402.mapping.MAPPINGS`.
        master_id: Node id of the master's heartbeat and marker.
        trajectory_mode: Mode of operation for prepared motions.
        feed_forward: Whether torques of the torque model are sent as 60B2h in CSP.
        effort: Quantity in the field `effort` of the base record: torque [N·m] or motor current
            [A].
        pace: Ratio of device time to wall time; 1 is real time, 0 starts each cycle as soon as all
            drives have answered.
        stop_rad_s2: Deceleration of the fastest joint during a stop by `stop` [rad/s²].
        profile: Name of the device profile, a key of `hil_drivers.cia402.profile.PROFILES`.
        axes: For each axis, the fields of `AxisProfile` that the station sets.
        eds: Paths of the drives' EDS files, one per axis; empty for no EDS files.
        urdf: Path of the URDF from which the torque model is built; empty for the model of the
            built-in arm.
        following_error_deg: Following error at which a drive enters fault (6065h) [deg].
        tracking_deg: Deviation of a joint from its set-point at which all axes are stopped in csv
            and cst, the modes with position control by the master [deg]; in csp the limit is twice
            `following_error_deg`.
        torque_limit_percent: Torque limit (6072h) [% of the rated torque]; None to keep the value
            of the drive.
        payload_object: Index of the manufacturer-specific object for the payload in the drive of
            the first axis; 0 if there is no such object.
        temperature_object: Index of the manufacturer-specific object for the motor temperature in
            every drive, an INTEGER16 in 0.1 °C; 0 if there is no such object.
        candump: Path of the log file of all frames; empty for no log. If the file exists, a number
            is added to its name.
        late_cycles: Number of cycles in which an axis need not answer, or by which the master can
            be late, before all axes stop.
    """

    bus: CanChannel
    nodes: tuple[int, ...]
    rate_hz: float
    mapping: Literal["position", "all-modes", "minimal"]
    master_id: int = MASTER_ID
    trajectory_mode: Literal["csp", "csv", "cst"] = "csp"
    feed_forward: bool = False
    effort: Literal["torque", "current"] = "torque"
    pace: float = 1.0
    stop_rad_s2: float = 8.0
    profile: str = "generic"
    axes: tuple[Mapping[str, Any], ...] = field(default=())
    eds: tuple[str, ...] = ()
    urdf: str = ""
    following_error_deg: float = 2.0
    tracking_deg: float = 10.0
    torque_limit_percent: float | None = None
    payload_object: int = 0
    temperature_object: int = 0
    candump: str = ""
    late_cycles: int = LATE_CYCLES

    @property
    def free(self) -> bool:
        """Whether each cycle begins as soon as all drives have answered in the cycle before."""
        return self.pace == 0.0

    @property
    def period_s(self) -> float:
        """Duration of one cycle in device time [s]."""
        return 1.0 / self.rate_hz

    @property
    def period_us(self) -> int:
        """Duration of one cycle in device time [µs], which is the unit of 1006h."""
        return round(1e6 / self.rate_hz)

    @property
    def wall_period_s(self) -> float:
        """Wall time from SYNC to SYNC [s]; 0 if `free`."""
        return 0.0 if self.free else self.period_s / self.pace

    @property
    def resource(self) -> str:
        """Identifier of the bus, which can have only one master for all nodes."""
        return f"can://{self.bus.interface}/{self.bus.channel}"

    @property
    def address(self) -> Address:
        """Address of the bus; see `hil.robot.HasAddress`."""
        nodes = ", ".join(map(str, self.nodes))
        return Address(f"{self.bus} (nodes {nodes})", real=self.bus.real)


_MUST = OptionChecks("cia402")

RANGES: dict[str, Range] = {
    "stop_rad_s2": (0.5, 100.0),
    "following_error_deg": (0.05, 30.0),
    "tracking_deg": (0.1, 60.0),
    "torque_limit_percent": (1.0, 1000.0),
}
"""Minimum and maximum value of each option that is a number."""

WHOLE: dict[str, Range] = {
    "master_id": (1, 127),
    "payload_object": (0x2000, 0x5FFF),
    "temperature_object": (0x2000, 0x5FFF),
    "late_cycles": (1, 100),
}
"""Minimum and maximum value of each integer option; 2000h to 5FFFh are manufacturer objects."""

CHOICES = {
    "mapping": tuple(MAPPINGS),
    "trajectory_mode": ("csp", "csv", "cst"),
    "effort": ("torque", "current"),
    "profile": tuple(PROFILES),
}


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """Return the options of an arm from the keys in a station file; None counts as absent.

    Raises:
        SpecError: An option is missing, unknown or invalid, or the cycles exceed the capacity of
            the bus.
    """
    _MUST.require_known(given, [each.name for each in fields(Options)])
    arm = load_arm(model)
    n = arm.n_joints
    present = {name: value for name, value in given.items() if value is not None}
    checked = _one_by_one(present)
    bus = bus_of(present.get("bus"))
    options = Options(
        **{
            **checked,
            "bus": bus,
            "nodes": _nodes(
                present.get("nodes", list(range(1, n + 1))), n, checked.get("master_id", MASTER_ID)
            ),
            "rate_hz": 1000.0 / _period_ms(present.get("rate_hz", arm.rate_hz)),
            "pace": _pace(present.get("pace", 1), bus),
            "late_cycles": checked.get(
                "late_cycles", LATE_CYCLES_SIMULATED if bus.interface in SIMULATED else LATE_CYCLES
            ),
            "mapping": checked.get("mapping") or _allowed(checked)[0],
            "axes": axes_of(present.get("axes", {}), arm),
            "eds": tuple(_MUST.file("eds", each) for each in _listed("eds", present, n)),
        }
    )
    _require_mapping(options, checked)
    _require_stop(options.stop_rad_s2, float(arm.qdd_max.min()))
    require_room(options.mapping, n, options.rate_hz, bus.bitrate, _allowed(checked))
    return options


def _one_by_one(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Check and return the options that do not depend on other options."""
    checked: dict[str, Any] = {}
    for name, value in settings.items():
        if name in RANGES:
            checked[name] = _MUST.number(name, value, RANGES[name])
        elif name in WHOLE:
            checked[name] = _MUST.number(name, value, WHOLE[name], whole=True)
        elif name in CHOICES:
            checked[name] = _MUST.choice(name, value, CHOICES[name])
        elif take := _TAKEN.get(name):
            checked[name] = take(name, value)
    return checked


def _log_file(name: str, value: Any) -> str:
    """Return the absolute path of a file, after checking that the file can be created."""
    path = Path(_MUST.text(name, value)).expanduser().absolute()
    if not path.parent.is_dir():
        raise _MUST.wrong_option(name, value, f"create the folder {path.parent} first")
    if path.is_dir():
        raise _MUST.wrong_option(name, value, "this is a folder; use a file in it")
    return str(path)


_TAKEN: dict[str, Callable[[str, Any], Any]] = {
    "feed_forward": _MUST.truth,
    "urdf": _MUST.file,
    "candump": _log_file,
}


def _nodes(value: Any, n: int, master_id: int) -> tuple[int, ...]:
    """Return the node ids of the drives in the order of the joints."""
    if not isinstance(value, list | tuple) or len(value) != n:
        raise _MUST.wrong_option(
            "nodes", value, f"list the node ids of the {n} joints, as in {list(range(1, n + 1))}"
        )
    ids = tuple(int(_MUST.number("nodes", each, (1, 126), whole=True)) for each in value)
    if len(set(ids)) < n:
        raise _MUST.wrong_option("nodes", list(ids), "use a different node id for every drive")
    if master_id in ids:
        raise _MUST.wrong_option(
            "nodes",
            list(ids),
            f"use other node ids: {master_id} is master_id, whose heartbeat the drives monitor",
        )
    return ids


def _period_ms(value: Any) -> int:
    """Return the period from SYNC to SYNC in whole milliseconds, as required by 60C2h."""
    rate = _MUST.number("rate_hz", value, (4.0, 1000.0))
    period = round(1000.0 / rate)
    if not math.isclose(1000.0 / rate, period, rel_tol=1e-3):
        slower, faster = 1000.0 / math.ceil(1000.0 / rate), 1000.0 / math.floor(1000.0 / rate)
        raise _MUST.wrong_option(
            "rate_hz",
            value,
            f"a cycle lasts whole milliseconds (60C2h): use {slower:.6g} or {faster:.6g}",
        )
    return period


def _pace(value: Any, bus: CanChannel) -> float:
    """Return the ratio of device time to wall time as a number, 0 for the option value `free`."""
    if value == "free":
        pace = 0.0
    elif isinstance(value, str):
        raise _MUST.wrong_option("pace", value, "use 1, a factor, or free")
    else:
        pace = _MUST.number("pace", value, (0.1, 1000.0))
    if pace != 1.0 and bus.interface not in SIMULATED:
        raise _MUST.wrong_option(
            "pace",
            value,
            f"use 1: the drives on {bus.interface} run in real time; other values are possible "
            f"on {' and '.join(SIMULATED)} only",
        )
    return pace


def _allowed(checked: Mapping[str, Any]) -> list[str]:
    """Return the names of the mappings with all required objects, the best mapping first."""
    if checked.get("feed_forward") or checked.get("trajectory_mode", "csp") != "csp":
        return ["all-modes"]
    return ["position", "minimal", "all-modes"]


def _require_mapping(options: Options, checked: Mapping[str, Any]) -> None:
    if options.feed_forward and options.trajectory_mode != "csp":
        raise _MUST.wrong_option(
            "feed_forward",
            True,
            f"use false: the torque offset (60B2h) is for csp, not for {options.trajectory_mode}",
        )
    allowed = _allowed(checked)
    if options.mapping not in allowed:
        need = (
            "feed_forward" if options.feed_forward else f"trajectory_mode {options.trajectory_mode}"
        )
        raise _MUST.wrong_option("mapping", options.mapping, f"{need} needs {', '.join(allowed)}")


def _require_stop(stop_rad_s2: float, most: float) -> None:
    """Raise if the stop deceleration exceeds the maximum acceleration of any joint."""
    if stop_rad_s2 > most:
        raise _MUST.wrong_option(
            "stop_rad_s2", stop_rad_s2, f"use at most {most:.4g} rad/s², the limit of the joints"
        )


def _listed(name: str, settings: Mapping[str, Any], n: int) -> Sequence[Any]:
    return _MUST.per_axis(name, settings[name], n) if settings.get(name) else ()


AXIS_RANGES: dict[str, Range] = {
    "gear_ratio": (0.01, 10_000.0),
    "rated_current_a": (1e-3, 10_000.0),
    "rated_torque_nm": (1e-4, 100_000.0),
    "torque_constant_nm_a": (1e-5, 1000.0),
    "offset_deg": (-1e6, 1e6),
    "quick_stop_rad_s2": (0.1, 10_000.0),
    "stiffness_nm_rad": (0.0, 1e6),
    "damping_nms_rad": (0.0, 1e5),
}

AXIS_WHOLE: dict[str, Range] = {
    "encoder_increments": (1, 2**32 - 1),
    "encoder_revolutions": (1, 2**32 - 1),
}

AXIS_CHOICES: dict[str, tuple[Any, ...]] = {
    "polarity": tuple(range(0, 0x100, 0x20)),
    "direction": (1, -1),
    "velocity_unit": ("increments/s", *COUNTS_PER_REV_S),
    "torque_of": ("rated-torque", "rated-current"),
    "rated_current_is": ("rms", "peak"),
}

AXIS_KEYS = (*AXIS_WHOLE, *AXIS_RANGES, *AXIS_CHOICES, "position_unsigned")


def axes_of(value: Any, arm: ArmDescription) -> tuple[Mapping[str, Any], ...]:
    """Return for each axis the values of the station, by the field names of `AxisProfile`.

    Args:
        value: Value of the option `axes`: for each key, one value for all axes or a list with one
            value per axis.
        arm: Description of the arm, from which the middle of each joint's range is computed.

    Raises:
        SpecError: A key is unknown, or a value is invalid.
    """
    given = _MUST.mapping_of("axes", value)
    _MUST.require_known(given, AXIS_KEYS, "axes")
    n = arm.n_joints
    columns = {key: _MUST.per_axis(f"axes.{key}", given[key], n) for key in given}
    centres = 0.5 * (arm.q_min + arm.q_max)
    return tuple(
        {**_axis({key: column[i] for key, column in columns.items()}), "centre_rad": float(centre)}
        for i, centre in enumerate(centres)
    )


def _axis(given: Mapping[str, Any]) -> dict[str, Any]:
    axis = {key: _value(key, value) for key, value in given.items()}
    if "offset_deg" in axis:
        axis["offset_rad"] = math.radians(axis.pop("offset_deg"))
    return axis


def _value(key: str, value: Any) -> Any:
    name = f"axes.{key}"
    if key in AXIS_RANGES:
        return _MUST.number(name, value, AXIS_RANGES[key])
    if key in AXIS_WHOLE:
        return _MUST.number(name, value, AXIS_WHOLE[key], whole=True)
    if key in AXIS_CHOICES:
        return _MUST.choice(name, value, AXIS_CHOICES[key])
    return _MUST.truth(name, value)
