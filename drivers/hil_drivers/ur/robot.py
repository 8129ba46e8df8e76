"""A UR arm as `hil` drives it: samples by a reader of our own, motion by `ur-rtde` next door."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import (
    CommandRefused,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StructArray,
)
from hil.robot import Address, Capabilities, Finding, Identity, Limits, Segment, Topic, is_loopback
from hil_drivers.arm import faulty, not_connected, nothing_prepared, require_liftable
from hil_drivers.ur.controller import KEPT_S, READ_BACK_S, Controller
from hil_drivers.ur.direct_stop import stop_directly, stop_program
from hil_drivers.ur.facts import capabilities_of, require_playable
from hil_drivers.ur.faults import slider_of
from hil_drivers.ur.findings import Looked, findings_of
from hil_drivers.ur.motion import MotionProcess
from hil_drivers.ur.options import options_of
from hil_drivers.ur.reach import reached
from hil_drivers.ur.rows import TOPIC, further_rows, further_topic, program_running, state_rows
from hil_drivers.ur.session import told_by_dashboard
from hil_drivers.ur.watch import Watch


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
        self._name, self._model, self._given = name, model, options
        self._options = options_of(options, model)
        self._controller = Controller(model, self._options)
        self._motion = MotionProcess(name, model, options)
        self._topic = further_topic(self.capabilities.rate_hz)
        self._further: list[StructArray] = []
        self._watch = Watch(self._options)
        self._declared: Payload | None = None
        self._connected = self._listening = False
        self._prepared: Segment | None = None
        self._stops = 0
        self._newest: StructArray | None = None
        self._slider = math.nan

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """See `hil.robot.HasAddress`."""
        return Address(self._options.address, real=not is_loopback(self._options.address))

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        self._require_connection()
        return self._controller.identity

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than the controller's own."""
        return self._controller.limits

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    @property
    def speed_scaling(self) -> float:
        """See `hil.robot.HasSpeedScaling`: the speed slider of the teach pendant."""
        return self._slider

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        self._require_health()
        looked = Looked(
            self._model,
            self._options,
            self._controller,
            told_by_dashboard(self._controller.host),
            self._declared,
            self._motion.alive,
        )
        return list(findings_of(looked))

    def reach(self) -> Sequence[Finding]:
        """See `hil.robot.HasReach`."""
        return list(reached(self._options.address))

    def connect(self) -> None:
        """Listen, look whether the arm may be moved, upload the program that moves it.

        After a fault or a lost connection it does so from the beginning.

        Raises:
            RobotConnectionError: Nobody is there, it is another arm, or somebody else moves it.
            RobotFault: The arm is not in a state in which it may move, or a program plays.
        """
        alive = self._controller.receiver.alive and self._motion.alive
        if self._connected and alive and not (self._watch.faulty or self._watch.severed):
            return
        self._let_go()
        try:
            self._controller.open()
            given = self._given | {"address": self._controller.host}
            self._motion = MotionProcess(self._name, self._model, given)
            self._motion.connect()
            self._controller.forget_rows()
        except BaseException:
            self._let_go()
            raise
        self._watch, self._further, self._declared = Watch(self._options), [], None
        self._connected = True

    def listen(self) -> None:
        """Be told, and command nothing; see `hil.robot.Listens`.

        Raises:
            RobotConnectionError: Nobody is there, or it is another arm.
            SpecError: It does not send what shall be the effort.
        """
        if self._listening and self._controller.receiver.alive:
            return
        self._let_go()
        try:
            self._controller.listen()
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
        self._declared = payload
        until = time.monotonic() + READ_BACK_S
        while not payload.agrees_with(self._controller.believed) and time.monotonic() < until:
            time.sleep(0.005)
        return self._controller.believed

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It leaves the limits, moves at its ends, or begins elsewhere.
            RobotFault: The arm does not obey any more.
        """
        self._require_health()
        stops = self._stops
        require_playable(segment, self.limits, self._controller.row["target_q"])
        if segment.kind != "hold":
            self._motion.prepare(segment)
        self._prepared = segment
        if self._stops != stops:  # one that has come meanwhile holds
            self._prepared = None
            raise CommandRefused("stopped while it was prepared", hint="prepare it again")

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: Nothing is prepared, or a motion is still on.
        """
        segment, self._prepared = self._prepared, None
        self._require_health()
        if segment is None:
            raise nothing_prepared()
        if self._watch.moving:
            raise CommandRefused("a segment is still running", hint="read until it is over")
        self._controller.receiver.keep(None)  # a dwell is measured as much as a motion
        if segment.kind == "hold":
            # What waits to be read was before it, and may be seconds old.
            now = float(self._controller.row["timestamp"])
            self._watch.begun(segment.index, now, moves=False)
            return
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
        raw = self._controller.receiver.take(timeout_s)
        # From here on nothing is raised: what was taken is in nobody else's hands.
        self._newest = raw
        self._slider = slider_of(raw)
        rows = state_rows(raw, self._options.torque_source)
        self._further.append(further_rows(raw, self._topic))
        if self._listening:
            return rows
        self._look(raw)
        self._watch.stamp(rows)
        return rows

    def stop(self) -> None:
        """Bring the arm to rest: by the program that moves it, else by one that replaces it.

        Seconds after our program was ended by somebody else, their programs are left alone.

        Raises:
            RobotConnectionError: Nobody could be told.
        """
        if not self._connected:
            return
        self._stops += 1
        self._prepared = None
        newest = self._controller.receiver.newest
        row = None if newest is None else newest[0]
        if self._watch.is_for_others(row):
            return
        self._watch.stopping(row)
        try:
            self._motion.stop()
        except HilError as error:
            self._watch.severed |= isinstance(error, RobotTimeout)
            self._stop_directly()
        else:
            if self._watch.must_not_go_on(row):
                # A program that a protective stop has paused must not go on once it is unlocked.
                stop_program(self._controller.host)

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

    def _look(self, raw: StructArray) -> None:
        """Find out how the motion stands; what is wrong is told by the next read."""
        told, error = None, None
        try:
            told = None if self._watch.severed else self._motion.look()[0]
        except HilError as caught:
            error = caught
        ended = self._watch.look(raw, told, error, left=self._motion.left)
        if self._watch.stop_has_failed(raw):
            self._watch.severed = True
            try:
                self._stop_directly()
            except RobotConnectionError as caught:
                self._watch.found(caught)
            stop_program(self._controller.host)
        if self._watch.halted and not self._watch.moving:
            self._controller.receiver.keep(KEPT_S)
        elif ended:
            self._controller.receiver.keep(None, forgiving=True)

    def _stop_directly(self) -> None:
        self._watch.replaced = True
        if not stop_directly(self._controller.host, self._options.stop_rad_s2):
            raise RobotConnectionError(
                f"{self._options.address}: the controller could not be told to stop; its watchdog "
                f"stops the program within {1 / self._options.watchdog_hz:.2f} s",
                hint="see to the robot itself, by its emergency stop if need be",
            )

    def _require_connection(self) -> None:
        if not (self._connected or self._listening):
            raise not_connected(self._name)

    def _require_health(self) -> None:
        self._require_connection()
        if self._listening:
            raise CommandRefused(f"{self._name} is only listened to", hint="call connect() first")
        if self._watch.severed:
            raise RobotFault(
                f"{self._name} was stopped by a program that has replaced the one that moves it",
                hint="connect() again",
            )
        if self._watch.faulty:
            raise faulty(self._name)

    def _let_go(self) -> None:
        self._connected = self._listening = False
        self._prepared = self._newest = None
        self._motion.close()
        self._controller.close()
