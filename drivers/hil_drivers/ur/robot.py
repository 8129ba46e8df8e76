"""A UR arm as `hil` drives it: samples by a reader of our own, motion by `ur-rtde` next door."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.errors import (
    CommandRefused,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
)
from hil.payload import Payload
from hil.record.topic import Topic
from hil.robot import Capabilities, Identity, Limits, Segment
from hil.typing import StructArray
from hil_drivers.ur.checks import require_executable, require_liftable
from hil_drivers.ur.direct_stop import stop_directly, stop_program
from hil_drivers.ur.facts import capabilities_of, limits_of
from hil_drivers.ur.motion import MotionProcess
from hil_drivers.ur.options import options_of
from hil_drivers.ur.receiver import Receiver
from hil_drivers.ur.rows import (
    TOPIC,
    further_rows,
    further_topic,
    program_running,
    require_source,
    state_rows,
)
from hil_drivers.ur.session import Told, require_arm, require_ready, told_by_dashboard
from hil_drivers.ur.watch import Watch

READ_BACK_S = 2.0
KEPT_S = 5.0
"""How much waits to be read while the arm stands, by its clock: nobody wants what it did while a
plan was made, for minutes. Of a motion everything is kept [s]."""


class UrRobot:
    """Implements `hil.robot.Robot` for arms of Universal Robots.

    Args:
        name: The robot's name in its station.
        model: A built-in arm: ur3, ur5, ur10, or these with an e.
        options: See `hil_drivers.ur.options.Options`.

    Raises:
        SpecError: An option is missing, unknown, or cannot be.
    """

    def __init__(self, name: str, model: str, **options: Any) -> None:
        self._name, self._model = name, model
        self._options = options_of(options, model)
        self._receiver = Receiver(self._options.address, self._options.frequency_hz)
        self._motion = MotionProcess(name, model, options)
        self._topic = further_topic(self.capabilities.rate_hz)
        self._further: list[StructArray] = []
        self._watch = Watch(self._options)
        self._told = Told()
        self._connected = self._listening = False
        self._prepared: Segment | None = None
        self._newest: StructArray | None = None

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        self._require_connection()
        version = ".".join(map(str, self._receiver.version))
        details = {
            "address": self._options.address,
            "torque_source": self._options.torque_source,
            "moves": self._options.moves,
            "polyscope": self._told.polyscope,
            "not_sent": ", ".join(self._receiver.missing),
        }
        return Identity(self._model, self._told.serial, version, "ur", details)

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`."""
        return limits_of(self._model, self._options)

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def connect(self) -> None:
        """Listen, look whether the arm may be moved, upload the program that moves it.

        After a fault or a lost connection it does so from the beginning.

        Raises:
            RobotConnectionError: Nobody is there, it is another arm, or somebody else moves it.
            RobotFault: The arm is not in a state in which it may move.
        """
        alive = self._receiver.alive and self._motion.alive
        if self._connected and alive and not self._watch.faulty:
            return
        self._let_go()
        try:
            self._told = told_by_dashboard(self._options.address)
            self._receiver.open()
            require_source(self._options.torque_source, self._receiver.missing)
            row = self._receiver.take(READ_BACK_S)[-1]
            require_ready(
                self._options.address, self._model, self._told, self._receiver.version, row
            )
            self._motion.connect()
            self._receiver.take(READ_BACK_S)  # from before the program was uploaded
            self._receiver.keep(KEPT_S)
        except BaseException:
            self._let_go()
            raise
        self._watch, self._further = Watch(self._options), []
        self._connected = True

    def listen(self) -> None:
        """Be told, and command nothing; see `hil.robot.Listens`.

        Raises:
            RobotConnectionError: Nobody is there, or it is another arm.
            SpecError: It does not send what shall be the effort.
        """
        if self._listening and self._receiver.alive:
            return
        self._let_go()
        address = self._options.address
        with contextlib.suppress(RobotConnectionError):  # RTDE alone will do for listening
            self._told = told_by_dashboard(address)
        try:
            self._receiver.open()
            require_source(self._options.torque_source, self._receiver.missing)
            require_arm(address, self._model, self._told, self._receiver.version)
        except BaseException:
            self._let_go()
            raise
        self._listening, self._further, self._newest = True, [], None

    @property
    def program_running(self) -> bool:
        """See `hil.robot.Listens`."""
        return self._newest is not None and bool(program_running(self._newest[-1:])[0])

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a load and wait until the controller says that it believes in it.

        Raises:
            CommandRefused: It is too heavy, the arm is moving, or it was not accepted.
        """
        self._require_health()
        require_liftable(payload, self.limits)
        self._motion.set_payload(payload)
        until = time.monotonic() + READ_BACK_S
        while not payload.agrees_with(self._believed()) and time.monotonic() < until:
            time.sleep(0.005)
        return self._believed()

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It leaves the limits, moves at its ends, or begins elsewhere.
            RobotFault: The arm does not obey any more.
        """
        self._require_health()
        require_executable(segment, self.limits, self._row()["target_q"])
        if segment.kind != "hold":
            self._motion.prepare(segment)
        self._prepared = segment

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: Nothing is prepared, or a motion is still on.
        """
        segment, self._prepared = self._prepared, None
        self._require_health()
        if segment is None:
            raise CommandRefused("no segment is prepared", hint="call prepare() first")
        if self._watch.moving:
            raise CommandRefused("a segment is still running", hint="read until it is over")
        if segment.kind == "hold":
            newest = -np.inf if self._newest is None else float(self._newest["timestamp"][-1])
            self._watch.begun(segment.index, newest, moves=False)
            return
        self._receiver.keep(None)
        self._watch.begun(segment.index, self._motion.start(), moves=True)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All samples since the last call.

        A fault comes with the rows that show it; the next call raises it, once, so that whoever
        watches the arm come to rest still sees it.

        Raises:
            RobotTimeout: No sample arrived in time.
            RobotFault: The arm stopped, or was stopped because it did not follow.
            RobotConnectionError: The controller or the process that moves it is gone.
        """
        self._require_connection()
        problem, self._watch.problem = self._watch.problem, None
        if problem is not None:
            raise problem
        raw = self._receiver.take(timeout_s)
        self._newest = raw
        rows = state_rows(raw, self._options.torque_source)
        self._further.append(further_rows(raw, self._topic))
        if self._listening:
            return rows
        self._look(raw[-1])
        self._watch.stamp(rows)
        return rows

    def stop(self) -> None:
        """Bring the arm to rest: by the program that moves it, else by one that replaces it.

        Raises:
            RobotConnectionError: Nobody could be told.
        """
        if not self._connected:
            return
        self._prepared = None
        newest = self._receiver.newest
        self._watch.stopping(None if newest is None else newest[0])
        try:
            self._motion.stop()
        except HilError:
            self._stop_directly()
        else:
            if self._watch.faulty:
                # A program that a protective stop has paused must not go on once it is unlocked.
                stop_program(self._options.address)

    def close(self) -> None:
        """Stop, end the program, let go of the controller."""
        if self._listening:
            self._let_go()
        if not self._connected:
            return
        try:
            self.stop()
        except RobotConnectionError:
            return
        finally:
            self._let_go()

    def client_gone(self) -> None:
        """For drivers in a process of their own: nothing to be told to this arm."""

    def _look(self, row: Any) -> None:
        """Find out how the motion stands; what is wrong is told by the next read."""
        told, error = None, None
        try:
            told = self._motion.look()[0]
        except HilError as caught:
            error = caught
        if self._watch.look(row, told, error):
            self._receiver.keep(KEPT_S)
        if self._watch.stop_has_failed(row):
            self._stop_directly()
            stop_program(self._options.address)

    def _stop_directly(self) -> None:
        self._watch.replaced = True
        if not stop_directly(self._options.address, self._options.stop_rad_s2):
            raise RobotConnectionError(
                f"{self._options.address}: the controller could not be told to stop; its watchdog "
                f"stops the program within {1 / self._options.watchdog_hz:.2f} s",
                hint="see to the robot itself, by its emergency stop if need be",
            )

    def _believed(self) -> Payload:
        row = self._row()
        x, y, z = (float(value) for value in row["payload_cog"])
        inertia: Any = (0.0,) * 6
        if "payload_inertia" in (row.dtype.names or ()):
            inertia = tuple(float(value) for value in row["payload_inertia"])
        return Payload(float(row["payload"]), (x, y, z), inertia)

    def _row(self) -> Any:
        newest = self._receiver.newest
        if newest is None:
            raise RobotTimeout("the controller has not said anything yet", hint="connect again")
        return newest[0]

    def _require_connection(self) -> None:
        if not (self._connected or self._listening):
            raise RobotConnectionError(
                f"{self._name} is not connected", hint="call connect() first"
            )

    def _require_health(self) -> None:
        self._require_connection()
        if self._listening:
            raise CommandRefused(f"{self._name} is only listened to", hint="call connect() first")
        if self._watch.faulty:
            raise RobotFault(
                f"{self._name} does not obey since a fault", hint="remove its cause, then connect()"
            )

    def _let_go(self) -> None:
        self._connected = self._listening = False
        self._motion.close()
        self._receiver.close()
