"""What a station file may say about an arm on CiA 402 drives, beside its name and model.

`options_of` turns the station's mapping into `Options`; the error for an option that cannot be says
what would be right. It also refuses what does not go together: a mapping without what a mode needs,
a rate for which the bus has no room. The option `bus` is described in `can_channel`, the keys of
`axes` become fields of `profile.AxisProfile` (angles here in degrees).
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
"""Default of `late_cycles`: drives on a wire fault soon after a few missing
set-points; drives on a busy computer are not dead when they have not answered for 0.2 s."""


@dataclass(frozen=True, slots=True)
class Options:
    """The options of one arm.

    Attributes:
        bus: Where the drives are.
        nodes: Their CANopen ids, in the order of the joints.
        rate_hz: SYNC, set-points and samples per second of device time.
        mapping: A key of `hil_drivers.cia402.mapping.MAPPINGS`.
        master_id: Node id of our own heartbeat and marker.
        trajectory_mode: Mode in which prepared motions are played.
        feed_forward: Send the torque model's torque as 60B2h in CSP.
        effort: What the base record's `effort` is: torque [N·m] or motor current [A].
        pace: Cycles per period of wall time: 1 is real time, 0 as fast as the drives answer.
        stop_rad_s2: Deceleration of `stop`, by the fastest joint [rad/s²].
        profile: A key of `hil_drivers.cia402.profile.PROFILES`.
        axes: Per axis, what the station says of the fields of `AxisProfile`.
        eds: Per axis, path of the drive's EDS file; empty without.
        urdf: Path of the torque model; the arm's own when empty.
        following_error_deg: 6065h: how far a joint may lag before its drive faults [deg].
        tracking_deg: How far a joint that we lead ourselves (csv, cst) may be from its set-point
            before all axes are stopped [deg]; in csp it is twice `following_error_deg`.
        torque_limit_percent: 6072h: of the rated torque; the drive's own when None.
        payload_object: Vendor object of node 1 where a payload is declared; none when 0.
        temperature_object: Vendor object of every node: its motor's temperature, INTEGER16 in
            0.1 °C; none when 0.
        candump: File to which all frames are logged, with a number where there is one; none when
            empty.
        late_cycles: Cycles that an axis may miss, or we may be late, before all axes stop.
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
        """Whether the next cycle begins as soon as all drives have answered."""
        return self.pace == 0.0

    @property
    def period_s(self) -> float:
        """Device time of one cycle [s]."""
        return 1.0 / self.rate_hz

    @property
    def period_us(self) -> int:
        """Device time of one cycle [µs], as 1006h has it."""
        return round(1e6 / self.rate_hz)

    @property
    def wall_period_s(self) -> float:
        """Wall time from SYNC to SYNC [s]; 0 when free."""
        return 0.0 if self.free else self.period_s / self.pace

    @property
    def resource(self) -> str:
        """Which bus this is: it has room for one master, whatever nodes it drives."""
        return f"can://{self.bus.interface}/{self.bus.channel}"

    @property
    def address(self) -> Address:
        """See `hil.robot.HasAddress`."""
        nodes = ", ".join(map(str, self.nodes))
        return Address(f"{self.bus} (nodes {nodes})", real=self.bus.real)


_MUST = OptionChecks("cia402")

RANGES: dict[str, Range] = {
    "stop_rad_s2": (0.5, 100.0),
    "following_error_deg": (0.05, 30.0),
    "tracking_deg": (0.1, 60.0),
    "torque_limit_percent": (1.0, 1000.0),
}
"""Least and most of the options that are numbers."""

WHOLE: dict[str, Range] = {
    "master_id": (1, 127),
    "payload_object": (0x2000, 0x5FFF),
    "temperature_object": (0x2000, 0x5FFF),
    "late_cycles": (1, 100),
}
"""The same of those that are whole numbers; 2000h to 5FFFh are the vendors' own objects."""

CHOICES = {
    "mapping": tuple(MAPPINGS),
    "trajectory_mode": ("csp", "csv", "cst"),
    "effort": ("torque", "current"),
    "profile": tuple(PROFILES),
}


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """Return the options of a station's mapping for a built-in arm; None counts as absent.

    Raises:
        SpecError: One is missing, unknown, or cannot be; or the bus has no room for it.
    """
    _MUST.require_known(given, [each.name for each in fields(Options)])
    arm = load_arm(model)
    n = arm.n_joints
    present = {name: value for name, value in given.items() if value is not None}
    taken = _one_by_one(present)
    bus = bus_of(present.get("bus"))
    options = Options(
        **{
            **taken,
            "bus": bus,
            "nodes": _nodes(
                present.get("nodes", list(range(1, n + 1))), n, taken.get("master_id", MASTER_ID)
            ),
            "rate_hz": 1000.0 / _period_ms(present.get("rate_hz", arm.rate_hz)),
            "pace": _pace(present.get("pace", 1), bus),
            "late_cycles": taken.get(
                "late_cycles", LATE_CYCLES_SIMULATED if bus.interface in SIMULATED else LATE_CYCLES
            ),
            "mapping": taken.get("mapping") or _allowed(taken)[0],
            "axes": axes_of(present.get("axes", {}), arm),
            "eds": tuple(_MUST.file("eds", each) for each in _listed("eds", present, n)),
        }
    )
    _require_mapping(options, taken)
    _require_stop(options.stop_rad_s2, float(arm.qdd_max.min()))
    require_room(options.mapping, n, options.rate_hz, bus.bitrate, _allowed(taken))
    return options


def _one_by_one(told: Mapping[str, Any]) -> dict[str, Any]:
    """Options that stand for themselves."""
    taken: dict[str, Any] = {}
    for name, value in told.items():
        if name in RANGES:
            taken[name] = _MUST.number(name, value, RANGES[name])
        elif name in WHOLE:
            taken[name] = _MUST.number(name, value, WHOLE[name], whole=True)
        elif name in CHOICES:
            taken[name] = _MUST.choice(name, value, CHOICES[name])
        elif take := _TAKEN.get(name):
            taken[name] = take(name, value)
    return taken


def _log_file(name: str, value: Any) -> str:
    """The whole path of a file that can be made."""
    path = Path(_MUST.text(name, value)).expanduser().absolute()
    if not path.parent.is_dir():
        raise _MUST.wrong_option(name, value, f"there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise _MUST.wrong_option(name, value, "this is a folder; give a file in it")
    return str(path)


_TAKEN: dict[str, Callable[[str, Any], Any]] = {
    "feed_forward": _MUST.truth,
    "urdf": _MUST.file,
    "candump": _log_file,
}


def _nodes(value: Any, n: int, master_id: int) -> tuple[int, ...]:
    """The drives' node ids in the order of the joints."""
    if not isinstance(value, list | tuple) or len(value) != n:
        raise _MUST.wrong_option(
            "nodes", value, f"list the node ids of the {n} joints, as in {list(range(1, n + 1))}"
        )
    ids = tuple(int(_MUST.number("nodes", each, (1, 126), whole=True)) for each in value)
    if len(set(ids)) < n:
        raise _MUST.wrong_option("nodes", list(ids), "every drive has a node id of its own")
    if master_id in ids:
        raise _MUST.wrong_option(
            "nodes", list(ids), f"{master_id} is master_id, whose heartbeat the drives watch"
        )
    return ids


def _period_ms(value: Any) -> int:
    """Return whole milliseconds from SYNC to SYNC: every drive's 60C2h has those."""
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
    """0 when free."""
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
            f"the drives on {bus.interface} live in real time; only on "
            f"{' and '.join(SIMULATED)} there may be others",
        )
    return pace


def _allowed(taken: Mapping[str, Any]) -> list[str]:
    """Return the mappings that have the needed objects, best first."""
    if taken.get("feed_forward") or taken.get("trajectory_mode", "csp") != "csp":
        return ["all-modes"]
    return ["position", "minimal", "all-modes"]


def _require_mapping(options: Options, taken: Mapping[str, Any]) -> None:
    if options.feed_forward and options.trajectory_mode != "csp":
        raise _MUST.wrong_option(
            "feed_forward", True, f"60B2h adds to csp; {options.trajectory_mode} needs none of it"
        )
    allowed = _allowed(taken)
    if options.mapping not in allowed:
        need = (
            "feed_forward" if options.feed_forward else f"trajectory_mode {options.trajectory_mode}"
        )
        raise _MUST.wrong_option("mapping", options.mapping, f"{need} needs {', '.join(allowed)}")


def _require_stop(stop_rad_s2: float, most: float) -> None:
    """Any joint may be the fastest one, which brakes at that rate."""
    if stop_rad_s2 > most:
        raise _MUST.wrong_option(
            "stop_rad_s2", stop_rad_s2, f"the arm's joints may brake at {most:.4g} rad/s² at most"
        )


def _listed(name: str, told: Mapping[str, Any], n: int) -> Sequence[Any]:
    return _MUST.per_axis(name, told[name], n) if told.get(name) else ()


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
    """Return the station's values of each axis, by the names of `AxisProfile`.

    Args:
        value: The option `axes`: per key one value for all axes, or one for each.
        arm: Says where the middle of each joint's range is.

    Raises:
        SpecError: A key is unknown, or a value cannot be.
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
