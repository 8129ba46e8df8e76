"""What a station file may say about an arm on CiA 402 drives, beside its name and model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from hil.arms import load_arm
from hil.robot import Address
from hil_drivers.cia402 import option_checks as must
from hil_drivers.cia402.axis_options import axes_of
from hil_drivers.cia402.bus_load import require_room
from hil_drivers.cia402.bus_options import SIMULATED, Bus, bus_of
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.option_checks import wrong_option
from hil_drivers.cia402.profile import PROFILES

MASTER_ID = 127

LATE_CYCLES, LATE_CYCLES_SIMULATED = 3, 50
"""What `late_cycles` is where nobody says: drives on a wire fault soon after a few missing
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

    bus: Bus
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


RANGES: dict[str, must.Range] = {
    "stop_rad_s2": (0.5, 100.0),
    "following_error_deg": (0.05, 30.0),
    "tracking_deg": (0.1, 60.0),
    "torque_limit_percent": (1.0, 1000.0),
}
"""Least and most of the options that are numbers."""

WHOLE: dict[str, must.Range] = {
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
    """The options of a station's mapping, for a built-in arm; what is None is not given.

    Raises:
        SpecError: One is missing, unknown, or cannot be; or the bus has no room for it.
    """
    must.require_known(given, [each.name for each in fields(Options)])
    arm = load_arm(model)
    n = arm.n_joints
    told = {name: value for name, value in given.items() if value is not None}
    taken = _one_by_one(told)
    bus = bus_of(told.get("bus"))
    nodes = told.get("nodes", list(range(1, n + 1)))
    options = Options(
        **{
            **taken,
            "bus": bus,
            "nodes": must.nodes(nodes, n, taken.get("master_id", MASTER_ID)),
            "rate_hz": 1000.0 / must.period_ms(told.get("rate_hz", arm.rate_hz)),
            "pace": _pace(told.get("pace", 1), bus),
            "late_cycles": taken.get("late_cycles", _late_cycles(bus)),
            "mapping": taken.get("mapping") or _allowed(taken)[0],
            "axes": axes_of(told.get("axes", {}), arm),
            "eds": tuple(must.file("eds", each) for each in _listed("eds", told, n)),
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
            taken[name] = must.number(name, value, RANGES[name])
        elif name in WHOLE:
            taken[name] = must.number(name, value, WHOLE[name], whole=True)
        elif name in CHOICES:
            taken[name] = must.choice(name, value, CHOICES[name])
        elif take := _TAKEN.get(name):
            taken[name] = take(name, value)
    return taken


_TAKEN: dict[str, Callable[[str, Any], Any]] = {
    "feed_forward": must.truth,
    "urdf": must.file,
    "candump": must.log_file,
}


def _pace(value: Any, bus: Bus) -> float:
    """0 when free."""
    if value == "free":
        pace = 0.0
    elif isinstance(value, str):
        raise wrong_option("pace", value, "use 1, a factor, or free")
    else:
        pace = must.number("pace", value, (0.1, 1000.0))
    if pace != 1.0 and bus.interface not in SIMULATED:
        raise wrong_option(
            "pace",
            value,
            f"the drives on {bus.interface} live in real time; only on "
            f"{' and '.join(SIMULATED)} there may be others",
        )
    return pace


def _late_cycles(bus: Bus) -> int:
    return LATE_CYCLES_SIMULATED if bus.interface in SIMULATED else LATE_CYCLES


def _allowed(taken: Mapping[str, Any]) -> list[str]:
    """Mappings that carry what is asked for, best first."""
    if taken.get("feed_forward") or taken.get("trajectory_mode", "csp") != "csp":
        return ["all-modes"]
    return ["position", "minimal", "all-modes"]


def _require_mapping(options: Options, taken: Mapping[str, Any]) -> None:
    if options.feed_forward and options.trajectory_mode != "csp":
        raise wrong_option(
            "feed_forward", True, f"60B2h adds to csp; {options.trajectory_mode} needs none of it"
        )
    allowed = _allowed(taken)
    if options.mapping not in allowed:
        need = (
            "feed_forward" if options.feed_forward else f"trajectory_mode {options.trajectory_mode}"
        )
        raise wrong_option("mapping", options.mapping, f"{need} needs {', '.join(allowed)}")


def _require_stop(stop_rad_s2: float, most: float) -> None:
    """Any joint may be the fastest one, which brakes at that rate."""
    if stop_rad_s2 > most:
        raise wrong_option(
            "stop_rad_s2", stop_rad_s2, f"the arm's joints may brake at {most:.4g} rad/s² at most"
        )


def _listed(name: str, told: Mapping[str, Any], n: int) -> Sequence[Any]:
    return must.per_axis(name, told[name], n) if told.get(name) else ()
