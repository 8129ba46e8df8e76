"""What lives in the process that moves the arm: `ur-rtde`, a reader of our own, one thread.

`hil.robot.child` hosts it like a driver: its members are called one after the other, but for
`stop`. When the process on the other side goes, it is told so, stopped, watched until the arm is
at rest, and closed.
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import HilError, StructArray
from hil.robot import Capabilities, Identity, Limits, Segment, Status
from hil_drivers.arm import not_connected, nothing_prepared
from hil_drivers.ur.control import LIBRARY, Control
from hil_drivers.ur.direct_stop import end_program, stop_directly
from hil_drivers.ur.facts import capabilities_of, limits_of
from hil_drivers.ur.mover import Mover
from hil_drivers.ur.options import options_of
from hil_drivers.ur.phases import Phase
from hil_drivers.ur.playing import state_of, wait_until_playing
from hil_drivers.ur.rows import STOPPED

RECEIVER = "hil_drivers.ur.receiver:Receiver"
REST_S = 3.0

PROGRESS = np.dtype(
    [("device_time", "<f8"), ("begun", "<f8"), ("qd", "<f8", (6,)), ("status", "<i4")]
)
"""One row per `read`: the controller's time now, when the newest motion began, how it stands."""


class UrMotion:
    """As much of a robot as the process next door needs.

    Args:
        name, model: Of the arm.
        library: Module that offers `RTDEControlInterface`; another one in tests.
        receiver: `module:Class` that offers the controller's rows.
        options: As the station has them.
    """

    def __init__(
        self,
        name: str,
        model: str,
        *,
        library: str = LIBRARY,
        receiver: str = RECEIVER,
        **options: Any,
    ) -> None:
        self._name, self._model = name, model
        self._options = options_of(options, model)
        self._library, self._receiver_kind = library, receiver
        self._receiver: Any = None
        self._control: Control | None = None
        self._mover: Mover | None = None
        self._prepared: Segment | None = None
        self._alone = False

    @property
    def identity(self) -> Identity:
        """The controller's software, as its RTDE server tells it."""
        version = ".".join(map(str, self._receiver.version))
        return Identity(self._model, "", version, "ur")

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`."""
        return limits_of(self._model, self._options)

    def connect(self) -> None:
        """Upload the robot program, and arm its watchdog.

        Raises:
            RobotConnectionError: Nobody is there, or somebody else owns the inputs.
            CommandRefused: The watchdog could not be armed.
        RobotFault: The program does not play.
        """
        if self._mover is not None:
            return
        rate = self.capabilities.rate_hz
        module, _, kind = self._receiver_kind.partition(":")
        receiver = getattr(import_module(module), kind)(self._options.address, rate)
        receiver.open()
        try:
            series = tuple(receiver.version[:2])
            control = Control(self._options.address, rate, series, library=self._library)
            try:
                control.arm_watchdog(self._options.watchdog_hz)
                wait_until_playing(receiver)
                mover = Mover(control, receiver, self._options, rate)
            except BaseException:
                self._end_program(control, receiver)
                raise
        except BaseException:
            receiver.close()
            raise
        self._receiver, self._control, self._mover = receiver, control, mover
        mover.alone = self._alone
        mover.start()

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a load; what the controller makes of it is for others to read back."""
        self._moving().use(lambda control: control.set_payload(payload))
        return payload

    def prepare(self, segment: Segment) -> None:
        """Keep the next segment, and be done with stops that came before."""
        self._moving().course.clear()
        self._prepared = segment

    def start(self) -> None:
        """Begin the prepared segment: `move` by the controller's own plan, else led along."""
        segment, self._prepared = self._prepared, None
        if segment is None:
            raise nothing_prepared()
        mover = self._moving()
        if segment.kind == "move" and self._options.moves == "movej":
            mover.start_move(segment)
        else:
            mover.start_led(segment)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """One row of `PROGRESS`.

        Raises:
            HilError: Why the newest motion was ended; told once.
        """
        course = self._moving().course
        phase, row = course.phase, course.newest
        failure, course.failure = course.failure, None
        if failure is not None:
            raise failure
        status = Status.HOLDING if phase is Phase.IDLE else Status.MOVING
        told = np.zeros(1, PROGRESS)
        told[0] = (row["timestamp"], course.begun, row["target_qd"], int(status))
        return told

    def stop(self) -> None:
        """See `hil.robot.Robot`; raises `RobotTimeout` when somebody else had better do it."""
        if self._mover is not None:
            self._mover.stop()

    def client_gone(self) -> None:
        """Whoever drove the arm has died: nobody else will stop it."""
        self._alone = True
        if self._mover is not None:
            self._mover.alone = True

    def close(self) -> None:
        """Bring the arm to rest, end the program, let go of the inputs."""
        mover, self._mover = self._mover, None
        if mover is None:
            return
        try:
            self._come_to_rest(mover)
        finally:
            mover.end()
            try:
                if self._control is not None:
                    self._end_program(self._control, self._receiver)
            finally:
                self._receiver.close()

    def _end_program(self, control: Control, receiver: Any) -> None:
        """Also one that a protective stop has paused: it would go on once that is unlocked."""
        try:
            control.end()
        finally:
            if state_of(receiver) != STOPPED:
                end_program(self._options.address)

    def _come_to_rest(self, mover: Mover) -> None:
        try:
            mover.stop()
        except HilError:
            stop_directly(self._options.address, self._options.stop_rad_s2)
        until = time.monotonic() + REST_S
        while mover.course.phase is not Phase.IDLE and time.monotonic() < until:
            time.sleep(0.005)

    def _moving(self) -> Mover:
        if self._mover is None:
            raise not_connected(self._name)
        return self._mover
