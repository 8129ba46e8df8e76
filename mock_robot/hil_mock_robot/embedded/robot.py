"""The embedded mock robot: a whole robot in this process, on a virtual clock or in wall time.

MuJoCo and numba load on `connect`; until then only names, rates and limits are known.
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
"""What messages about faults call their list."""


class MockRobot:
    """A robot of `hil` that exists only here; implements `hil.robot.Robot`.

    On its virtual clock, time advances only when it is read: the same seed, options and calls
    give the same bytes. In wall time it advances by itself, read or not. Beside the protocol it
    can be pushed, worn and driven by torque, for tests of what hil does about that.

    Args:
        name: The robot's name in the station file.
        model: A built-in arm.
        options: See `hil_mock_robot.embedded.options.Options`.

    Raises:
        PluginError: MuJoCo or numba is not installed.
        SpecError: There is no such arm, or an option cannot be.
    """

    simulated = True
    """`hil` drives nothing else by torque."""

    address = Address("this process", real=False)

    def __init__(self, name: str, model: str = "ur5", **options: Any) -> None:
        _require_extra()
        self._name = name
        self._options = options_of(options)
        self._arm = Arm(model, self._options)
        require_short_block(self._options, self._arm.rate_hz)
        self._journal = Journal(self._options.journal, name)
        # stop() may come from another thread than read(), or from a signal handler inside it:
        # a block takes well under 10 ms, and a reader waits for rows without the lock.
        self._lock = threading.Condition(threading.RLock())
        self._controller, self._clock = self._build()

    @property
    def truth(self) -> Truth:
        """The true parameters of this robot."""
        return self._arm.truth

    @property
    def identity(self) -> Identity:
        """Model and a serial number made of name, profile and seed."""
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
        """Nominal gains, the rate, and the clock of the options."""
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
        """The published limits of the arm."""
        return self._arm.limits

    def connect(self) -> None:
        """Switch the robot on, clear its fault, mend the line; else it does nothing.

        Raises:
            RobotConnectionError: The journal cannot be written.
        """
        self._journal.open()
        # Outside the lock: the first one compiles for seconds and stop() must not wait.
        built = self._arm.build()
        with self._command("connect"):
            if self._arm.fault:
                self._clock.forget()
            self._arm.switch_on(built)
            self._controller.connect()
        self._clock.begin()

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Mount the arm as the station has it.

        Raises:
            SpecError: The option `mount` says otherwise.
            CommandRefused: The robot is switched on already.
        """
        self._arm.mount(gravity_m_s2)

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a load and, unless `mounted_payload` is given, mount it.

        Raises:
            CommandRefused: It is too heavy, or the arm is moving.
        """
        with self._command("set_payload", mass_kg=payload.mass, com_m=list(payload.com)):
            self._controller.require_connection()
            self._controller.set_payload(payload)
            return payload

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It starts elsewhere, moves at its ends, or leaves the limits.
        """
        with self._command("prepare", segment=segment.index, kind=segment.kind):
            self._controller.require_connection()
            self._controller.prepare(segment)

    def start(self) -> None:
        """Begin the prepared segment with the next sample.

        Raises:
            CommandRefused: Nothing is prepared, or a segment is still running.
        """
        with self._command("start") as command:
            self._controller.require_connection()
            self._controller.start()
            command.details["segment"] = self._arm.motion.segment

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """New rows: computed now, up to `block` and not past a segment's end, or those that wait.

        Each set-point of a segment gives one row. A fault ends the block with a row that says
        so; the next call raises.

        Raises:
            RobotTimeout: No row in time; device time on the virtual clock.
            RobotFault: Protective stop; `connect` clears it.
            RobotConnectionError: Not connected, or closed while it waited.
        """
        return self._clock.read(timeout_s)

    def stop(self) -> None:
        """Decelerate along the present path with half the acceleration limit, then hold.

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
        """Stop and disconnect; the robot stays where it is and `connect` finds it again.

        In wall time it returns when the arm is at rest. A waiting `read` raises an error.
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
        """Note that the client has died; for drivers in a process of their own."""
        with self._lock:
            self._controller.note("client_gone")

    def push(self, torque: Sequence[float] | FloatArray) -> None:
        """Let an external joint torque (n,) [N·m] act from now on; zeros end it."""
        with self._lock:
            self._controller.require_connection()
            self._arm.powered.push(np.asarray(torque, dtype=float))

    def fault(self, kind: str, **keys: Any) -> contextlib.ExitStack:
        """Begin a fault now; in a `with` statement, until its end.

        Args:
            kind: As in the option `faults` (docs/reference/mock.md).
            **keys: Its further keys, such as `for_s`; `at_s` or `segment` for later.

        Raises:
            SpecError: There is no such kind or key.
            RobotConnectionError: Not connected.
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
        """End faults and forget later ones; a stop ends with `connect`."""
        with self._lock:
            self._controller.clear()
            self._lock.notify_all()

    def wear(self, factor: Sequence[float] | FloatArray) -> None:
        """Scale all friction by `factor` (n,) from now on, 1 for as good as new."""
        with self._lock:
            self._controller.require_connection()
            self._arm.on.disturbances.wear[:] = factor

    def command_torque(self, torque: Sequence[float] | FloatArray | None) -> None:
        """Drive the joints by torque (n,) [N·m] instead of position; None brakes and holds.

        The torque goes through the drive's nominal gain and compensates nothing, gravity included.
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
        # The thread knows nothing of this object: it ends when this is collected, or at exit.
        weakref.finalize(self, clock.abandon)
        return controller, clock

    @contextlib.contextmanager
    def _command(self, event: str, **details: Any) -> Iterator[_CommandRecord]:
        """Hold the lock during a command, and write it to the journal."""
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
    """A command to the robot: its time, and details for the journal."""

    at: Moment
    details: dict[str, Any]
