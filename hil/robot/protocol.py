"""Robot interface of `hil`: ten members, blocks of samples, independent of the engine.

Every driver implements the protocol `Robot`. The protocols named `Has…`, `Listens`, `ReadsLogs` and
`TorqueControlled` are optional; a driver implements an optional protocol by having the members of
the protocol. Decision record 0001 checks the robot interface on paper for UR moveJ and servoJ, CiA
402 CSP, upload-and-play over ADS, a virtual clock, and drivers in a child process.
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
    """Identity of a robot; stored in `start.json` and compared when a run is resumed."""

    model: str
    serial: str
    firmware: str
    driver: str
    details: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Capabilities of a robot, known without moving the robot.

    Attributes:
        joint_names: Names of the n joints, in the order of the elements of every array.
        rate_hz: Rate of state samples and of commanded trajectories [Hz].
        effort_kind: Physical quantity of `effort`: motor current [A] or torque [N·m].
        drive_gains: Drive gains, torque per current [N·m/A] per joint; empty if unknown.
        drive_gains_source: Source of the values of the drive gains.
        clock: Kind of the device clock. A robot with a `virtual` clock advances only when it is
            read, and time-outs then refer to device time.
    """

    joint_names: tuple[str, ...]
    rate_hz: float
    effort_kind: EffortKind
    drive_gains: tuple[float, ...] = ()
    drive_gains_source: str = ""
    clock: ClockKind = "wall"


@dataclass(frozen=True, slots=True)
class Limits:
    """Joint limits that the controller enforces; the limits of a plan must not be wider."""

    q_min: FloatArray
    q_max: FloatArray
    qd_max: FloatArray
    qdd_max: FloatArray
    effort_max: FloatArray
    """Torque limits of the joints [N·m]; infinite or NaN for an unknown limit, which is not
    monitored."""
    payload_max_kg: float


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """Segment of a motion that is ready to execute: set-points sampled at the rate of the robot.

    The robot holds the last set-point of a segment until the next segment starts. A driver with its
    own motion planning (moveJ) can use `q[-1]`, `speed` and `acceleration` instead of the sampled
    set-points.

    Attributes:
        index: Index of the plan step, copied to the field `segment` of every state row.
        kind: Kind of motion: `move` (from rest to rest), `trajectory` (follow the set-points
            exactly) or `hold`.
        q, qd, qdd: Set-points, each (N, n); N ≥ 1, and N = 1 for `hold`.
        speed: Maximum joint speed of the segment [rad/s].
        acceleration: Maximum joint acceleration of the segment [rad/s²].
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
    """Interface with ten members that every driver implements.

    Contract of every driver: `connect`, `stop` and `close` are idempotent. The method `stop`
    returns within 100 ms of wall time with the arm decelerating or static, works in every state and
    never raises an error because the robot has already stopped. A fault that occurs between two
    calls is raised by the next call of `read`.
    """

    @property
    def identity(self) -> Identity:
        """Identity of the connected robot.

        Raises `RobotConnectionError` if the robot has not been connected yet.
        """

    @property
    def capabilities(self) -> Capabilities:
        """Rates, joint names and units of the robot; available before `connect`."""

    @property
    def limits(self) -> Limits:
        """Joint limits from the manufacturer; after `connect` from the controller."""

    def connect(self) -> None:
        """Open the connection to the robot and start receiving its state.

        Raises `RobotConnectionError`.
        """

    def set_payload(self, payload: Payload) -> Payload:
        """Declare the payload to the controller and return the values that it reads back."""

    def prepare(self, segment: Segment) -> None:
        """Transfer the next segment to the controller, which uploads and validates it.

        Raises `CommandRefused`.
        """

    def start(self) -> None:
        """Start the prepared segment, which must begin where the previous segment ends."""

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Return all state rows since the last call in order, at least one row.

        The dtype of the rows is `state_dtype(n)`.

        Raises:
            RobotTimeout: No sample arrived within `timeout_s` (device time for robots with a
                virtual clock).
            RobotFault: The controller reports a fault.
            RobotConnectionError: The connection to the robot is lost.
        """

    def stop(self) -> None:
        """Stop the arm immediately, on a controlled ramp."""

    def close(self) -> None:
        """Stop the arm if necessary and release the robot."""


@runtime_checkable
class HasTopics(Protocol):
    """Optional interface of a robot that records further topics (raw drive integers, …).

    A robot implements this interface by having the members `topics` and `drain`; the engine calls
    `drain` after every `read`.
    """

    @property
    def topics(self) -> Sequence[Topic]:
        """Topics recorded in addition to the base record, known before `connect`."""

    def drain(self) -> Mapping[str, StructArray]:
        """Return the rows of each topic since the last call, in order, by topic name.

        Topics that have no new rows are omitted.
        """


@runtime_checkable
class HasResource(Protocol):
    """Optional interface of a robot that is identified by its address and not by its name.

    Two processes must not command the same resource at the same time (`hil.robot.lease`).
    """

    @property
    def resource(self) -> str:
        """Address such as `ur://192.168.0.5`, available before `connect`.

        The robot address does not depend on the station file.
        """


@runtime_checkable
class HasSpeedScaling(Protocol):
    """Optional interface of a robot whose controller can execute motions slower than commanded.

    An example of such a speed reduction is the speed slider of a teach pendant. The interlock
    `speed_scaling` monitors the ratio of executed to commanded speed.
    """

    @property
    def speed_scaling(self) -> float:
        """Lowest ratio of executed to commanded speed since the call of `read` before the last.

        The ratio is 1 for motions as commanded, and NaN if it is unknown. Reading this property
        never raises an error.
        """


@runtime_checkable
class Listens(Protocol):
    """Optional interface of a robot that can be recorded while a different program drives it.

    `hil record` calls `listen`, then `read` and `drain` (if the robot has topics) until the end of
    the recording, then `close`. A listening driver sends no command, uploads or ends no program,
    and uses no connection that a different client possibly needs. While listening, `read` returns
    rows with the `FAULT` bit instead of raising `RobotFault`, because the program that moves the
    robot handles faults.
    """

    def listen(self) -> None:
        """Connect to the robot for listening only, instead of calling `connect`.

        Idempotent.

        Raises:
            RobotConnectionError: The connection to the robot cannot be opened.
        """

    @property
    def program_running(self) -> bool:
        """Whether a robot program was running or paused at the newest row that `read` returned."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check that the robot performs itself.

    Attributes:
        name: Short lower-case name, such as `joint-limits`, which preflight displays as
            `robot-joint-limits`.
        passed: Whether the robot is allowed to move according to the check.
        message: One sentence with the measured and allowed values.
        measured, limit: Value measured by the check, and allowed value, both in SI units.
        hint: Action that removes the cause of the failure.
    """

    name: str
    passed: bool
    message: str
    measured: float | str | None = None
    limit: float | str | None = None
    hint: str = ""


@runtime_checkable
class HasChecks(Protocol):
    """Optional interface of a robot whose controller can report whether motion is allowed.

    Preflight calls the robot checks after `connect` and after the declaration of the first load. A
    failed robot check prevents motion and cannot be waived.
    """

    def checks(self) -> Sequence[Finding]:
        """Run the robot checks without moving the arm.

        Raises `RobotError` if the controller does not respond.
        """


@runtime_checkable
class HasReach(Protocol):
    """Optional interface of a robot whose reachability over the network can be tested.

    `hil doctor --station` calls the reachability tests without `connect` and without the lease of
    the robot. The reachability tests use no connection that a different client possibly needs,
    cause no motion, and each have a time limit of a few seconds.
    """

    def reach(self) -> Sequence[Finding]:
        """Run the reachability tests; a robot that does not answer raises no exception."""


UNKNOWN = "unknown"
"""Address text that is displayed for a real robot whose driver reports no address."""


@dataclass(frozen=True, slots=True)
class Address:
    """Destination of the commands that a driver sends.

    Attributes:
        text: Address as readable text, such as `192.168.0.5` or `socketcan can0`.
        real: Whether a device outside this computer can receive the commands; such a device moves
            only after a confirmation by the operator. The value of `real` is False for mock robots,
            loopback addresses and virtual buses.
    """

    text: str
    real: bool = True


@runtime_checkable
class HasAddress(Protocol):
    """Optional interface of a robot that knows the destination of its commands before `connect`.

    A robot with a wall clock and without this interface counts as real.
    """

    @property
    def address(self) -> Address:
        """Address of the robot, derived from the driver options without a connection.

        No name is resolved.
        """


def address_of(robot: Robot) -> Address:
    """Return the destination of the commands of a robot, which need not be connected."""
    if isinstance(robot, HasAddress):
        return robot.address
    if robot.capabilities.clock == "virtual":
        return Address("this process", real=False)
    return Address(robot.resource if isinstance(robot, HasResource) else UNKNOWN)


def is_loopback(host: str) -> bool:
    """Return whether the text of a host denotes this computer: 127.0.0.0/8, ::1, localhost.

    Host names other than the known loopback names can refer to this computer as well, but their
    resolution can change, so that they do not count as loopback.
    """
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


class RecordedLog(Protocol):
    """Open log file of a bus."""

    @property
    def topics(self) -> Sequence[Topic]:
        """Topics in addition to the base record for which the blocks can contain rows."""

    def blocks(self) -> Iterator[tuple[StructArray, Mapping[str, StructArray]]]:
        """Yield state rows and rows of further topics in the order in which the driver delivers.

        Raises:
            DataError: The log is damaged, or the log was not recorded on the bus of this robot.
        """


@runtime_checkable
class ReadsLogs(Protocol):
    """Optional interface of a driver class that can read robot states from a log of its bus."""

    @classmethod
    def read_log(
        cls, log: Path, model: str, options: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> RecordedLog:
        """Open a log file of a bus without connecting to a robot.

        Args:
            log: Path of the log file.
            model: Arm model named in the station.
            options: Driver options in the station.
            robot: Entry `robot` in `start.json` of the logged run: identity of the robot and
                properties reported by the drives.

        Raises:
            DataError: The log cannot be read, or the logged run contains too little information
                about the robot.
        """


@runtime_checkable
class TorqueControlled(Protocol):
    """Optional interface of a simulated robot with torque-driven joints and external torques.

    This interface is only for simulated arms: `hil` never commands torque to a real robot, even if
    the robot supports torque commands. `hil simulate` calls `command_torque`, `push` and `read`
    sample by sample.

    Attributes:
        simulated: Constant True, set on the class itself, and only if no real arm can move. The
            method names alone do not identify a simulated arm, because drivers of real arms
            possibly have methods with these names.
    """

    simulated: ClassVar[bool]

    def command_torque(self, torque: FloatArray | None) -> None:
        """Apply the drive torque (n,) [N·m] to the joints until the next command.

        If `torque` is None, the brakes are applied and hold the arm.
        """

    def push(self, torque: FloatArray) -> None:
        """Apply an external joint torque (n,) [N·m] from now on; zeros end the external torque."""


def is_simulated(driver: object) -> bool:
    """Return whether a robot or its driver class declares that no real arm moves."""
    return getattr(driver, "simulated", None) is True and all(
        hasattr(driver, member) for member in ("command_torque", "push")
    )
