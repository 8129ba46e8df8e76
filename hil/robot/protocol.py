"""What a robot is to `hil`: ten members, blocks of samples, no knowledge of the engine.

`Robot` is what every driver implements. The protocols named `Has…`, `Listens`, `ReadsLogs` and
`TorqueControlled` are opted into by having their members. Decision record 0001 checks the protocol
on paper against UR moveJ and servoJ, CiA 402 CSP, upload-and-play over ADS, a virtual clock, and
drivers that live in a child process.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

from hil.arms import Payload
from hil.core import FloatArray, StructArray
from hil.robot.state import Topic

EffortKind = Literal["current", "torque"]
ClockKind = Literal["wall", "virtual"]


@dataclass(frozen=True, slots=True)
class Identity:
    """Which robot this is; stored in `start.json` and compared on resume."""

    model: str
    serial: str
    firmware: str
    driver: str
    details: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What the robot offers, known without moving it.

    Attributes:
        joint_names: Names in the order of every array, length n.
        rate_hz: Rate of state samples and of commanded trajectories [Hz].
        effort_kind: Whether `effort` is a motor current [A] or a torque [N·m].
        drive_gains: Torque per current [N·m/A] per joint, empty when unknown.
        drive_gains_source: Where the gains come from.
        clock: `virtual` robots advance only when read; time-outs then count device time.
    """

    joint_names: tuple[str, ...]
    rate_hz: float
    effort_kind: EffortKind
    drive_gains: tuple[float, ...] = ()
    drive_gains_source: str = ""
    clock: ClockKind = "wall"


@dataclass(frozen=True, slots=True)
class Limits:
    """Joint limits the controller enforces; a plan may be stricter, never wider."""

    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    qdd_max: FloatArray
    effort_max: FloatArray
    """Torque limits [N·m]; infinite or NaN where unknown, which is then not watched."""
    payload_max_kg: float


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """One piece of motion, ready to execute: sampled set-points at the robot's own rate.

    The last set-point is held until the next segment starts. A driver that plans on its own
    (moveJ) may use `q[-1]`, `speed` and `acceleration` instead of the samples.

    Attributes:
        index: Plan step index, echoed in the `segment` field of every state row.
        kind: `move` (rest to rest), `trajectory` (follow exactly) or `hold`.
        q, qd, qdd: Set-points, each (N, n); N ≥ 1, and N = 1 for `hold`.
        speed: Largest joint speed on the way [rad/s].
        acceleration: Largest joint acceleration on the way [rad/s²].
    """

    index: int
    kind: Literal["move", "trajectory", "hold"]
    q: FloatArray
    qd: FloatArray
    qdd: FloatArray
    speed: float
    acceleration: float


@runtime_checkable
class Robot(Protocol):
    """The ten members every driver implements.

    Contract: `connect`, `stop` and `close` are idempotent; `stop` returns within 100 ms of wall
    time with the arm decelerating or at rest, works from every state and never raises because the
    robot is already stopped; a fault in the background surfaces in the next `read`.
    """

    @property
    def identity(self) -> Identity:
        """Who this is; raises `RobotConnectionError` before `connect`."""

    @property
    def capabilities(self) -> Capabilities:
        """Rates, names and units; available before `connect`."""

    @property
    def limits(self) -> Limits:
        """Joint limits: the maker's before `connect`, the controller's own after it."""

    def connect(self) -> None:
        """Open the connection and start receiving state. Raises `RobotConnectionError`."""

    def set_payload(self, payload: Payload) -> Payload:
        """Tell the controller about the load and return what it reads back."""

    def prepare(self, segment: Segment) -> None:
        """Hand over the next segment (upload, validate). Raises `CommandRefused`."""

    def start(self) -> None:
        """Begin the prepared segment; it must start where the last one ended."""

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All state rows since the last call, at least one, in order, of `state_dtype(n)`.

        Raises:
            RobotTimeout: No sample arrived within `timeout_s` (device time on virtual clocks).
            RobotFault: The controller reports a fault.
            RobotConnectionError: The connection is gone.
        """

    def stop(self) -> None:
        """Bring the arm to rest now, on a controlled ramp."""

    def close(self) -> None:
        """Stop if need be and release the robot."""


@runtime_checkable
class HasTopics(Protocol):
    """What a robot also offers when it records more than the base record (raw drive integers, …).

    A robot opts in by having these two members; the engine drains them after every `read`.
    """

    @property
    def topics(self) -> Sequence[Topic]:
        """The further topics, known before `connect`."""

    def drain(self) -> Mapping[str, StructArray]:
        """Rows per topic name since the last call, in order; topics without news are left out."""


@runtime_checkable
class HasResource(Protocol):
    """What a robot also offers when its address says which robot it is, whatever it is called.

    Two processes may not drive one resource at once (`hil.robot.lease`).
    """

    @property
    def resource(self) -> str:
        """Such as `ur://192.168.0.5`; known before `connect`, the same from every station file."""


@runtime_checkable
class HasSpeedScaling(Protocol):
    """What a robot also offers when its controller can execute motions slower than commanded.

    Such as by the speed slider of a teach pendant. The interlock `speed_scaling` watches it.
    """

    @property
    def speed_scaling(self) -> float:
        """Executed over commanded speed, the lowest since the `read` before the last one.

        1 is as commanded, NaN is not known; never raises.
        """


@runtime_checkable
class Listens(Protocol):
    """What a robot also offers when it can be recorded while somebody else drives it.

    `hil record` uses it: `listen`, then `read` and `drain` (if it has topics) until the end, then
    `close`. Nothing is commanded, no program is uploaded or ended, and nothing is taken that
    another client may need. While listening, `read` gives rows with the `FAULT` bit instead of
    raising `RobotFault`: whoever drives the robot deals with that.
    """

    def listen(self) -> None:
        """Connect to be told, in place of `connect`; idempotent. Raises `RobotConnectionError`."""

    @property
    def program_running(self) -> bool:
        """Whether a program was running (or paused) in the newest row that `read` has given."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        name: Short and lower-case, such as `joint-limits`; a preflight calls it `robot-…`.
        passed: False when the robot should not move.
        message: One sentence with the figures in it.
        measured, limit: What was found and what would have been fine, in SI units.
        hint: What to do about a failure.
    """

    name: str
    passed: bool
    message: str
    measured: float | str | None = None
    limit: float | str | None = None
    hint: str = ""


@runtime_checkable
class HasChecks(Protocol):
    """What a robot also offers when its controller can be asked whether it may be moved.

    A preflight asks after `connect` and after the first load was declared; what did not pass keeps
    the robot from moving and cannot be waived.
    """

    def checks(self) -> Sequence[Finding]:
        """Look, now; moves nothing. Raises `RobotError` when the controller cannot be asked."""


@runtime_checkable
class HasReach(Protocol):
    """What a robot also offers when it can be asked from afar whether it is there.

    `hil doctor --station` asks without `connect` and without the lease: nothing is taken that
    another client may need, nothing moves, and every question has a limit of some seconds.
    """

    def reach(self) -> Sequence[Finding]:
        """Ask, now; never raises because nobody answers."""


UNKNOWN = "unknown"
"""Text of the address of a real robot whose driver states none."""


@dataclass(frozen=True, slots=True)
class Address:
    """Where the commands of a robot go.

    Attributes:
        text: For people, such as `192.168.0.5` or `socketcan can0`.
        real: Whether something outside this computer may hear them: such a robot moves only after
            a confirmation. False for mocks, loopback addresses and virtual buses.
    """

    text: str
    real: bool = True


@runtime_checkable
class HasAddress(Protocol):
    """What a robot also offers when it knows, before `connect`, where its commands go.

    A robot in wall time without it counts as real.
    """

    @property
    def address(self) -> Address:
        """From the options alone: no name is resolved and nothing is connected."""


def address_of(robot: Robot) -> Address:
    """Return where the commands of a robot go; it need not be connected."""
    if isinstance(robot, HasAddress):
        return robot.address
    if robot.capabilities.clock == "virtual":
        return Address("this process", real=False)
    return Address(robot.resource if isinstance(robot, HasResource) else UNKNOWN)


def is_loopback(host: str) -> bool:
    """Return whether a host is this computer by its very text: 127.0.0.0/8, ::1, localhost.

    Other names may lead here, too, but who resolves them may change; they count as elsewhere.
    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class RecordedLog(Protocol):
    """A log, opened."""

    @property
    def topics(self) -> Sequence[Topic]:
        """The further topics that its blocks may hold rows of."""

    def blocks(self) -> Iterator[tuple[StructArray, Mapping[str, StructArray]]]:
        """State rows and rows of further topics, in order, as the driver gave them when it ran.

        Raises:
            DataError: The log is damaged, or was not written on this robot's bus.
        """


@runtime_checkable
class ReadsLogs(Protocol):
    """What a driver's class also offers when a log of its bus holds all that a recording holds."""

    @classmethod
    def read_log(
        cls, log: Path, model: str, options: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> RecordedLog:
        """Open a log; nothing is connected to.

        Args:
            log: The file.
            model: The station's.
            options: The station's, as for the driver itself.
            robot: `start.json: robot` of the run that the log is of: who answered, and what the
                drives had told about themselves.

        Raises:
            DataError: It cannot be read, or the run says too little about the robot.
        """


@runtime_checkable
class TorqueControlled(Protocol):
    """What a simulated robot also offers when its joints can be driven by torque and pushed.

    For simulated arms alone: `hil` commands torque to no real robot, whatever that could do.
    `hil try-out` uses it: `command_torque`, `push`, `read`, one sample after the other.

    Attributes:
        simulated: True on the class itself, and only where no arm can move. Methods of these
            names are not enough: drivers of real arms may have them for reasons of their own.
    """

    simulated: ClassVar[bool]

    def command_torque(self, torque: FloatArray | None) -> None:
        """Drive the joints by torque (n,) [N·m] until told otherwise; None brakes and holds."""

    def push(self, torque: FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""


def is_simulated(driver: object) -> bool:
    """Whether a robot, or its driver before it is opened, says that torque moves no real arm."""
    return getattr(driver, "simulated", None) is True and all(
        hasattr(driver, member) for member in ("command_torque", "push")
    )
