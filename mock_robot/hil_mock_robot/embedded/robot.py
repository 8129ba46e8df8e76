"""Embedded mock robot: a whole robot in this process, on a virtual clock or in wall time.

MuJoCo and numba are loaded by `connect`; only names, rates and limits are known before.
"""

from __future__ import annotations

import contextlib
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import FloatArray, HilError, StructArray, plugins
from hil.robot import Address, Capabilities, Identity, Limits, Segment
from hil_mock_robot.embedded.arm import Arm
from hil_mock_robot.embedded.clocks import Clock, VirtualClock, WallClock, pace_of
from hil_mock_robot.embedded.controller import Controller
from hil_mock_robot.embedded.faults import EmbeddedFault
from hil_mock_robot.embedded.options import options_of, require_short_block
from hil_mock_robot.plant.truth import Truth
from hil_mock_robot.server.journal import Journal, Moment

OPTION = "mock option faults"
"""Name of the list of faults in error messages."""


class MockRobot:
    """Simulated robot inside this process; implements `hil.robot.Robot`.

    On its virtual clock, time advances only when the robot is read, so that the same seed, options
    and calls give the same bytes. In wall time, the robot advances automatically. In addition to
    the protocol, a test of hil can apply external torques, wear and torque commands.

    Args:
        name: Name of the robot in the station file.
        model: Name of a built-in arm.
        options: Options, see `hil_mock_robot.embedded.options.Options`.

    Raises:
        PluginError: MuJoCo or numba is not installed.
        SpecError: There is no such arm, or an option is invalid.
    """

    simulated = True
    """Mark of a simulated robot; `hil` does not command torques to robots without this mark."""

    address = Address("this process", real=False)

    def __init__(self, name: str, model: str = "ur5", **options: Any) -> None:
        _require_extra()
        self._name = name
        self._options = options_of(options)
        self._arm = Arm(model, self._options)
        require_short_block(self._options, self._arm.rate_hz)
        self._journal = Journal(self._options.journal, name)
        # stop() may be called from a different thread than read(), or from a signal handler during
        # read(). A block takes well under 10 ms, and a reader waits without the lock.
        self._lock = threading.Condition(threading.RLock())
        self._controller, self._clock = self._build()

    @property
    def truth(self) -> Truth:
        """True parameters of this robot."""
        return self._arm.truth

    @property
    def identity(self) -> Identity:
        """Model of the robot, and a serial number from its name, profile and seed."""
        self._controller.require_connection()
        truth = self._arm.truth
        return Identity(
            model=truth.arm,
            serial=f"{self._name}-{truth.profile}-{truth.seed}",
            firmware=f"mock ranges {truth.ranges}",
            driver="mock",
            details={
                "profile": truth.profile,
                "substep_hz": f"{self._options.substep_hz:g}",
                "gravity_m_s2": " ".join(f"{g:g}" for g in self._arm.gravity),
            },
        )

    @property
    def capabilities(self) -> Capabilities:
        """Nominal drive gains, sampling rate, and clock of the robot."""
        arm = self._arm.description
        return Capabilities(
            joint_names=arm.joint_names,
            rate_hz=self._arm.rate_hz,
            effort_kind="current",
            drive_gains=tuple(arm.drive_gains.tolist()),
            drive_gains_source=arm.sources.get("drive_gains", "nominal"),
            clock=self._options.clock,
        )

    @property
    def limits(self) -> Limits:
        """Published limits of the arm."""
        return self._arm.limits

    def connect(self) -> None:
        """Switch the robot on, clear its fault and restore the line.

        Steps of the connection that are not needed are omitted.

        Raises:
            RobotConnectionError: The journal cannot be written.
        """
        self._journal.open()
        # Without the lock: the first build compiles for seconds, and stop() must not wait.
        built = self._arm.build()
        with self._command("connect"):
            if self._arm.fault:
                self._clock.forget()
            self._arm.switch_on(built)
            self._controller.connect()
        self._clock.begin()

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set the gravity of the station in the base frame.

        Raises:
            SpecError: The option `mount` contradicts the station.
            CommandRefused: The robot is already switched on.
        """
        self._arm.mount(gravity_m_s2)

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a payload, and mount it unless the option `mounted_payload` is set.

        Raises:
            CommandRefused: The payload is too heavy, or the arm is moving.
        """
        with self._command("set_payload", mass_kg=payload.mass, com_m=list(payload.com)):
            self._controller.require_connection()
            self._controller.set_payload(payload)
            return payload

    def prepare(self, segment: Segment) -> None:
        """Check and store the next segment.

        Raises:
            CommandRefused: The segment starts at a different position, is not at rest at its ends,
                or exceeds the limits.
        """
        with self._command("prepare", segment=segment.index, kind=segment.kind):
            self._controller.require_connection()
            self._controller.prepare(segment)

    def start(self) -> None:
        """Begin the prepared segment with the next sample.

        Raises:
            CommandRefused: No segment is prepared, or a segment is still running.
        """
        with self._command("start") as command:
            self._controller.require_connection()
            self._controller.start()
            command.details["segment"] = self._arm.motion.segment

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Return new rows: computed now on the virtual clock, or waiting in wall time.

        Each set-point of a segment gives one row. On the virtual clock, a block has at most `block`
        rows and ends with its segment. A fault ends the block with a row that contains the fault;
        the next call raises.

        Raises:
            RobotTimeout: No row arrived in time, measured in device time on the virtual clock.
            RobotFault: The robot has made a protective stop; `connect` clears it.
            RobotConnectionError: The robot is not connected, or was closed during the call.
        """
        return self._clock.read(timeout_s)

    def stop(self) -> None:
        """Decelerate along the current path with half of the acceleration limit, then hold.

        Raises:
            RobotConnectionError: The line was cut by an injected fault.
        """
        if self._arm.servo is None:
            return
        with self._command("stop") as command:
            command.details["moving"] = self._arm.moving
            if self._controller.connected:
                self._controller.require_connection()
            self._controller.brake("stop", command.at)

    def close(self) -> None:
        """Stop and disconnect; the robot retains its position until the next `connect`.

        In wall time, the call returns when the arm is at rest. A waiting `read` raises an error.
        """
        if not self._controller.connected:
            return
        with self._command("close") as command:
            command.details["moving"] = self._arm.moving
            if not self._controller.line.cut:
                self._controller.brake("" if self._controller.still else "close", command.at)
        self._clock.end()
        with self._lock:
            self._controller.note("closed")
            self._controller.disconnect()
            self._journal.close()
            self._lock.notify_all()

    def client_gone(self) -> None:
        """Record the death of the client; for drivers in a separate process."""
        with self._lock:
            self._controller.note("client_gone")

    def push(self, torque: Sequence[float] | FloatArray) -> None:
        """Apply an external joint torque (n,) [N·m] from now on; zeros end it."""
        with self._lock:
            self._controller.require_connection()
            self._arm.powered.push(np.asarray(torque, dtype=float))

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Begin a fault now; in a `with` statement, the fault ends with the block.

        Args:
            kind: Kind of fault, as in the option `faults` (docs/reference/mock.md).
            **keys: Further keys of the fault, such as `for_s`; `at_s` or `segment` for a later
                beginning.

        Raises:
            SpecError: There is no such kind or key.
            RobotConnectionError: The robot is not connected.
        """
        with self._lock:
            self._controller.require_connection()
            self._clock.catch_up()
            when = {} if {"at_s", "segment"} & set(keys) else {"at_s": self._arm.device_time}
            for each in EmbeddedFault.all_of([{"kind": kind, **when, **keys}], OPTION):
                self._controller.strike(each)
        over = contextlib.ExitStack()
        over.callback(self.clear)
        return over

    def clear(self) -> None:
        """End active faults and discard planned faults; a stop is cleared by `connect` only."""
        with self._lock:
            self._controller.clear()
            self._lock.notify_all()

    def wear(self, factor: Sequence[float] | FloatArray) -> None:
        """Scale all friction by `factor` (n,) from now on; a factor of 1 is that of a new joint."""
        with self._lock:
            self._controller.require_connection()
            self._arm.on.disturbances.wear[:] = factor

    def command_torque(self, torque: Sequence[float] | FloatArray | None) -> None:
        """Command joint torques (n,) [N·m] instead of positions; None brakes and holds the arm.

        The torque is converted with the drive's nominal gain, without compensation of gravity or
        friction.
        """
        with self._command("command_torque"):
            self._controller.require_connection()
            self._controller.command_torque(None if torque is None else np.asarray(torque))

    def _build(self) -> tuple[Controller, Clock]:
        options, arm = self._options, self._arm
        faults = EmbeddedFault.all_of(options.faults, OPTION)
        if options.clock == "virtual":
            controller = Controller(self._name, arm, faults, self._journal, 0.0)
            return controller, VirtualClock(controller, self._lock, options.block)
        pace = pace_of(options, arm.rate_hz)
        controller = Controller(self._name, arm, faults, self._journal, pace.spacing_s)
        clock = WallClock(controller, self._lock, pace)
        # The thread has no reference to this object, and ends when it is collected or at exit.
        weakref.finalize(self, clock.abandon)
        return controller, clock

    @contextlib.contextmanager
    def _command(self, event: str, **details: Any) -> Iterator[_CommandRecord]:
        """Hold the lock during a command, and write the command to the journal."""
        called = time.monotonic()
        with self._lock:
            self._clock.catch_up()
            command = _CommandRecord(self._controller.moment(called), details)
            try:
                yield command
            except HilError as error:
                details["refused"] = error.message
                raise
            finally:
                self._clock.contact()
                took_s = round(time.monotonic() - called, 6)
                self._controller.note(event, command.at, **details, took_s=took_s)


def _require_extra() -> None:
    missing = [name for name in ("mujoco", "numba") if find_spec(name) is None]
    if missing:
        raise plugins.not_installed("the mock robot", missing, "mock")


@dataclass(frozen=True, slots=True)
class _CommandRecord:
    """Command to the robot, with its time and details for the journal."""

    at: Moment
    details: dict[str, Any]
