"""Driver of an arm behind a TwinCAT PLC, which executes and records the motions.

The driver uploads a segment; the PLC checks the segment and executes one set-point per cycle.
During the motion the driver fetches rows from a ring buffer, into which the PLC writes in every
cycle (`reading`). Only heartbeats and stops must be punctual. Heartbeats and stops therefore each
have a separate line to the PLC (`controller`, with the lines of `ads`). If a command gets no
answer, the PLC possibly executes the command later. After a command without an answer the driver
sends a stop, and refuses further commands until `connect` is called again.

Driver and PLC communicate by variables, which are defined in a contract (`variables`). The PLC
program in docs/how-to/drive-twincat.md implements the PLC's side of the contract.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, RobotConnectionError, RobotFault, RobotTimeout, StructArray
from hil.robot import Address, Capabilities, Finding, Identity, Limits, Segment, Topic
from hil_drivers.arm import (
    ReportedLimits,
    capabilities_of,
    faulty,
    limits_of,
    not_connected,
    nothing_prepared,
    payload_finding,
    require_executable,
    require_liftable,
)
from hil_drivers.twincat.ads import RUN, STATES, listening_address
from hil_drivers.twincat.controller import EVERY_S, Controller, payload_in
from hil_drivers.twincat.options import options_of
from hil_drivers.twincat.reading import Reading, Ring, Watch, reading_topic
from hil_drivers.twincat.variables import CONTRACT, Order, Phase

AT_SET_POINT_RAD = 1e-3
"""Largest distance from the held set-point to a segment's first set-point [rad].

The PLC does not move the arm to the first set-point before the motion.
"""

LEAST_BEATS = 3
"""Minimum number of heartbeats within the PLC's watchdog time, because a heartbeat can be late."""


class TwinCatRobot:
    """Implementation of `hil.robot.Robot` for arms behind a Beckhoff PLC, by ADS.

    Args:
        name: Name of the robot in its station.
        model: Name of a built-in arm.
        options: Options of the station, as described in `hil_drivers.twincat.options.Options`.

    Raises:
        SpecError: An option of the station is missing, unknown or invalid.
    """

    def __init__(self, name: str, model: str, **options: Any) -> None:
        self._name, self._model = name, model
        self._options = options_of(options, model)
        self._controller: Controller | None = None
        self._reading: Reading | None = None
        self._topic = reading_topic(self._options.rate_hz)
        self._prepared: tuple[Segment, int] | None = None  # with the `nStop` for its start
        self._declared: Payload | None = None

    @property
    def resource(self) -> str:
        """Identifier of the PLC as an exclusive resource; see `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """Address of the PLC; see `hil.robot.HasAddress`."""
        return self._options.route

    def reach(self) -> Sequence[Finding]:
        """Return whether the PLC can be reached; see `hil.robot.HasReach`."""
        try:
            address = listening_address(self._options)
        except RobotConnectionError as error:
            return [Finding("port", False, error.message, hint=error.hint)]
        return [Finding("port", True, f"a PLC's ADS port answers at {address}")]

    @property
    def identity(self) -> Identity:
        """Identity of the arm and the PLC; see `hil.robot.Robot`."""
        return self._connected().identity

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of the arm; see `hil.robot.Robot`."""
        options = self._options
        return capabilities_of(
            self._model, options.rate_hz, options.effort, options.drive_gains_nm_a
        )

    @property
    def limits(self) -> Limits:
        """Limits of the arm; while connected, no limit is wider than that of the PLC."""
        controller = self._controller
        reported = None if controller is None else _reported_limits(controller.info)
        return limits_of(self._model, reported, self._options.speed_share)

    @property
    def topics(self) -> Sequence[Topic]:
        """Topic about the reading of rows; see `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """Return the rows about the reading since the last call; see `hil.robot.HasTopics`."""
        return {} if self._reading is None else self._reading.drain()

    def checks(self) -> Sequence[Finding]:
        """Return the preflight checks of this driver; see `hil.robot.HasChecks`."""
        controller = self._healthy()
        ring = self._active_reading().ring
        return list(_findings(controller, ring, self.limits, self._declared))

    def connect(self) -> None:
        """Read the PLC's variables, take control of the arm and start the heartbeat.

        After a fault or a lost connection, `connect` opens a new connection.

        Raises:
            RobotConnectionError: No PLC answers, or the PLC has a different arm.
            PluginError: The PLC's program implements a different version of the contract, or no
                contract.
            CommandRefused: Another client controls the arm.
            RobotFault: The arm has a fault that cannot be reset.
        """
        if self._controller is not None and not self._watch.faulty:
            return
        self._disconnect()
        controller = Controller(self._model, self._options)
        try:
            self._reading = Reading(controller, self._options, self._topic)
        except BaseException:
            controller.close()
            raise
        self._controller, self._declared = controller, None

    def set_payload(self, payload: Payload) -> Payload:
        """Set the payload in the model of the PLC; return the payload that the PLC reports.

        Raises:
            CommandRefused: The payload is too heavy for the arm, or the arm is moving.
            RobotError: The command failed; see `Orders.give`.
        """
        controller = self._healthy()
        require_liftable(payload, self.limits)
        with self._stop_unless_answered(controller):
            answer = controller.orders.give(
                Order.PAYLOAD,
                "declare a payload",
                fMass=payload.mass,
                aCom=payload.com,
                aInertia=payload.inertia,
            )
        self._declared = payload
        return payload_in(answer)

    def prepare(self, segment: Segment) -> None:
        """Check the next segment of the plan and upload it to the PLC, which also checks it.

        Raises:
            CommandRefused: The segment leaves the limits, does not begin at the held set-point or
                has too many set-points, or the arm moves.
            RobotFault: A fault occurred since `connect`.
            RobotError: The command failed; see `Orders.give`.
        """
        self._prepared = None
        controller = self._healthy()
        with self._stop_unless_answered(controller):
            state, stops = controller.stops.before_start()
            if state["nPhase"] in (Phase.PLAYING, Phase.STOPPING):
                raise CommandRefused(
                    "the arm is still moving", hint="read until the arm is at standstill"
                )
            standing = controller.variables.newest_row()["aQTarget"]
            require_executable(segment, self.limits, standing, at_set_point_rad=AT_SET_POINT_RAD)
            if segment.kind != "hold":
                controller.load(segment)
        self._prepared = segment, stops

    def start(self) -> None:
        """Start the motion along the prepared segment.

        Raises:
            CommandRefused: No segment is prepared, the arm moves, or the arm was stopped since
                `prepare`.
            RobotError: The command failed; see `Orders.give`.
        """
        prepared, self._prepared = self._prepared, None
        controller = self._healthy()
        if prepared is None:
            raise nothing_prepared()
        segment, stops = prepared
        order = Order.HOLD if segment.kind == "hold" else Order.START
        what = f"start segment {segment.index} ({segment.kind})"
        with self._stop_unless_answered(controller):
            controller.orders.give(order, what, nSegment=segment.index, nStop=stops)
        self._watch.begin(segment.index)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Wait for a block of rows, and return all rows since the last call.

        A call returns also the rows that show a fault. The call after these rows raises the fault,
        one time only, so that the motion of the arm is recorded until the arm is at rest.

        Raises:
            RobotTimeout: The PLC has written no row within the timeout.
            RobotFault: The PLC has a fault, or has ended this client's control of the arm.
            RobotConnectionError: The connection to the PLC is lost.
        """
        self._connected()
        return self._active_reading().read(timeout_s)

    def stop(self) -> None:
        """Bring the arm to rest along the ramp of the PLC.

        Raises:
            RobotConnectionError: The PLC was not reached; the watchdog of the PLC stops the arm.
        """
        controller, reading = self._controller, self._reading
        self._prepared = None
        if controller is not None and reading is not None:
            reading.watch.idle = True
            controller.stop()

    def close(self) -> None:
        """Stop the arm, release it for other clients, and close the connection."""
        if self._controller is None:
            return
        try:
            self.stop()
        except RobotConnectionError:
            return
        finally:
            self._disconnect()

    def _connected(self) -> Controller:
        if self._controller is None:
            raise not_connected(self._name)
        return self._controller

    def _active_reading(self) -> Reading:
        assert self._reading is not None
        return self._reading

    @property
    def _watch(self) -> Watch:
        return self._active_reading().watch

    def _healthy(self) -> Controller:
        controller = self._connected()
        if self._watch.faulty:
            raise faulty(self._name)
        if not controller.beat.alive:
            why = controller.beat.problem
            raise RobotConnectionError(
                f"{controller.where} receives no heartbeat any more"
                + (f": {why.message}" if why else ""),
                hint="connect() again",
            )
        return controller

    @contextmanager
    def _stop_unless_answered(self, controller: Controller) -> Iterator[None]:
        """Stop the arm if a command inside the `with` block gets no answer.

        The PLC possibly executes an unanswered command later.
        """
        watch = self._watch
        try:
            yield
        except (RobotTimeout, RobotConnectionError):
            watch.faulty = True
            with suppress(RobotConnectionError):
                controller.stop()
            raise
        except RobotFault:
            watch.faulty = True
            raise

    def _disconnect(self) -> None:
        controller, self._controller, self._reading = self._controller, None, None
        self._prepared = None
        if controller is not None:
            controller.close()


def _reported_limits(info: np.void) -> ReportedLimits:
    """Return the limits that the PLC checks, as reported in `stInfo`."""
    return ReportedLimits(
        q_min=info["aQMin"],
        q_max=info["aQMax"],
        qd_max=info["aQdMax"],
        qdd_max=info["aQddMax"],
        payload_max_kg=float(info["fPayloadMax"]),
    )


def _findings(
    controller: Controller, ring: Ring, limits: Limits, declared: Payload | None
) -> Iterator[Finding]:
    """Yield the driver's preflight checks, each with its measured value.

    Args:
        controller: Connected controller.
        ring: Reader of the ring buffer, for its counts of lost rows.
        limits: Limits against which plans are checked.
        declared: Payload that was last declared to the PLC; None if there is none.
    """
    info, state = controller.info, controller.state()
    computed = payload_in(controller.variables.structure("stAnswer"))

    runtime = controller.runtime_state()
    name = STATES.get(runtime, str(runtime))
    message = f"the PLC's runtime is in state {name}"
    yield Finding("runtime", runtime == RUN, message, name, "RUN", "start the PLC in TwinCAT")

    phase = int(state["nPhase"])
    name = Phase(phase).name if phase in tuple(Phase) else str(phase)
    message = f"the PLC program is in phase {name}"
    if phase == Phase.FAULT:
        message += f", {controller.fault(state)}"
    hint = "check the drives and the PLC program"
    yield Finding("phase", phase == Phase.HOLDING, message, name, "HOLDING", hint)

    session, ours = int(state["nSession"]), controller.session
    client = "this computer" if session == ours else "another client"
    hint = "end the other client, then connect again"
    message = f"{client} controls the arm"
    yield Finding("session", session == ours, message, str(session), str(ours), hint)

    cycle_s = float(info["fCycleS"])
    yield Finding("cycle", True, f"cycle {cycle_s * 1e3:g} ms, contract {CONTRACT}", cycle_s)

    watchdog_s, least_s = controller.watchdog_s, LEAST_BEATS * EVERY_S
    message = (
        f"the PLC stops the arm {watchdog_s:g} s after the last heartbeat, which is sent every "
        f"{EVERY_S:g} s"
    )
    hint = "set fWatchdogS in the PLC to some tenths of a second"
    right = least_s <= watchdog_s <= 1.0
    yield Finding("watchdog", right, message, watchdog_s, f"{least_s:g} … 1 s", hint)

    # Plans are checked against the stricter limits of manufacturer and PLC.
    wider = _reported_limits(info).exceeded_by(limits)
    message = "the joint limits used are within those that the PLC checks"
    yield Finding("joint-limits", not wider.any(), message, int(wider.sum()), 0)

    yield payload_finding(declared, computed, "check the PLC program")

    rows = int(info["nRingRows"])
    message = f"ring buffer of {rows} rows ({rows * cycle_s:.1f} s): "
    message += f"{ring.lost} rows lost in {ring.gaps} gaps"
    message += f", {ring.torn} blocks read again" if ring.torn else ""
    hint = "end other programs on this computer: they delay the reading"
    yield Finding("ring", ring.lost == 0, message, ring.lost, 0, hint)
