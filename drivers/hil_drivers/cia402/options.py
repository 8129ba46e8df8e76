"""What a station file may say about an arm on CiA 402 drives, beside its name and model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

SIMULATED = ("hil_unix", "virtual")
"""Interfaces of python-can on which time may run faster than on the wall."""


@dataclass(frozen=True, slots=True)
class Bus:
    """Which bus.

    Attributes:
        interface: Of python-can.
        channel: Of that interface: `can0`, a path, a number.
        bitrate: Bits per second of classic CAN [bit/s].
    """

    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = 1_000_000


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
        torque_limit_percent: 6072h: of the rated torque; the drive's own when None.
        payload_object: Vendor object of node 1 where a payload is declared; none when 0.
        candump: File to which all frames are logged; none when empty.
        late_cycles: Cycles that an axis may miss, or we may be late, before all axes stop.
    """

    bus: Bus
    nodes: tuple[int, ...]
    rate_hz: float
    mapping: Literal["position", "all-modes", "minimal"]
    master_id: int = 127
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
    torque_limit_percent: float | None = None
    payload_object: int = 0
    candump: str = ""
    late_cycles: int = 3

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


def options_of(given: Mapping[str, Any], model: str) -> Options:
    """The options of a station's mapping, for a built-in arm.

    Raises:
        SpecError: One is missing, unknown, or cannot be.
    """
    raise NotImplementedError
