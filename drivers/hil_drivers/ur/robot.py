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
from hil.robot import Capabilities, Identity, Limits, Segment, Status
from hil.typing import StructArray
from hil_drivers.ur.checks import require_executable, require_liftable
from hil_drivers.ur.direct_stop import stop_directly, stop_program
from hil_drivers.ur.facts import capabilities_of, limits_of
from hil_drivers.ur.faults import fault_of
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
from hil_drivers.ur.standing import Standing

READ_BACK_S = 2.0
KEPT_S = 5.0
"""How much waits to be read while the arm stands, by its clock: nobody wants what it did while a
plan was made, for minutes. Of a motion everything is kept [s]."""

RAMP_GRACE_S = 0.5
"""How much longer than its ramp an arm may take to be seen standing still after a stop [s]."""

STILL_RAD_S = 1e-3


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
        self._standing = Standing()
        self._told = Told()
        self._connected = self._listening = False
        self._prepared: Segment | None = None
        self._newest: StructArray | None = None
        self._problem: HilError | None = None
        self._faulty = self._halted = False
        self._stopped_by: float | None = None
        self._replaced = False

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
        if self._connected and not self._faulty and self._receiver.alive and self._motion.alive:
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
        self._standing, self._further = Standing(), []
        self._problem, self._stopped_by = None, None
        self._faulty = self._replaced = self._halted = False
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
        if self._standing.moving:
            raise CommandRefused("a segment is still running", hint="read until it is over")
        if segment.kind == "hold":
            newest = -np.inf if self._newest is None else float(self._newest["timestamp"][-1])
            self._standing.begin(segment.index, newest, moves=False)
            return
        self._stopped_by, self._halted = None, False
        self._receiver.keep(None)
        begun = self._motion.start()
        self._replaced = False
        self._standing.begin(segment.index, begun, moves=True)

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
        if self._problem is not None:
            problem, self._problem = self._problem, None
            raise problem
        raw = self._receiver.take(timeout_s)
        self._newest = raw
        rows = state_rows(raw, self._options.torque_source)
        self._further.append(further_rows(raw, self._topic))
        if self._listening:
            return rows
        self._look(raw)
        self._standing.stamp(rows)
        if self._faulty:
            rows["status"][-1] |= Status.FAULT
        return rows

    def stop(self) -> None:
        """Bring the arm to rest: by the program that moves it, else by one that replaces it.

        Raises:
            RobotConnectionError: Nobody could be told.
        """
        if not self._connected:
            return
        self._prepared, self._halted = None, True
        newest = self._receiver.newest
        if newest is not None:
            speed = float(np.abs(newest["target_qd"]).max())
            ramp_s = speed / self._options.stop_rad_s2 + RAMP_GRACE_S
            self._stopped_by = float(newest["timestamp"][0]) + ramp_s
        try:
            self._motion.stop()
        except HilError:
            self._stop_directly()
        else:
            if self._faulty:
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

    def _look(self, raw: StructArray) -> None:
        """Find out how the motion stands; what is wrong is told by the next read."""
        row = raw[-1]
        fault: HilError | None = fault_of(row, program=not self._replaced)
        try:
            told = self._motion.look()[0]
            if self._standing.moving and not int(told["status"]) & Status.MOVING:
                self._standing.end(float(told["device_time"]))
                self._receiver.keep(KEPT_S)
        except HilError as error:
            fault = fault or error
        if self._standing.moving and self._halted and _still(row):
            # Who moved it may not be there any more to say that the motion is over.
            self._standing.end(float(row["timestamp"]))
        if fault is not None and not self._faulty:
            self._problem, self._faulty, self._halted = fault, True, True
        self._watch_stop(row)

    def _watch_stop(self, row: np.void) -> None:
        """A stop that has not worked is made again, in another way."""
        if self._stopped_by is None or float(row["timestamp"]) < self._stopped_by:
            return
        self._stopped_by = None
        if not _still(row):
            self._stop_directly()
            stop_program(self._options.address)

    def _stop_directly(self) -> None:
        self._replaced = True
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
        if self._faulty:
            raise RobotFault(
                f"{self._name} does not obey since a fault", hint="remove its cause, then connect()"
            )

    def _let_go(self) -> None:
        self._connected = self._listening = False
        self._motion.close()
        self._receiver.close()


def _still(row: Any) -> bool:
    return bool(np.abs(row["target_qd"]).max() < STILL_RAD_S)
