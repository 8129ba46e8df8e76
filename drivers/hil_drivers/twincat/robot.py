"""Driver of an arm behind a TwinCAT PLC: the PLC owns the cycle, plays and records.

A segment is uploaded, checked by the PLC and played on its own time; meanwhile rows are pulled from
a ring that the PLC writes in every cycle (`reading`). So only heartbeat and stop have to be
punctual, and they have lines of their own (`controller`, on the lines of `ads`). A command without
an answer might be obeyed later: it is followed by a stop, and no further command is given until
`connect` is called again.

The variables by which driver and PLC talk are a contract (`variables`); its other half is the
PLC program in docs/how-to/drive-twincat.md.
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
"""The PLC begins with the first set-point as it is: it has to be where the arm is held."""

LEAST_BEATS = 3
"""Beats that have to fit into the PLC's watchdog: one may come late."""


class TwinCatRobot:
    """Implements `hil.robot.Robot` for arms behind a Beckhoff PLC, by ADS.

    Args:
        name: The robot's name in its station.
        model: A built-in arm.
        options: See `hil_drivers.twincat.options.Options`.

    Raises:
        SpecError: An option is missing, unknown, or cannot be.
    """

    def __init__(self, name: str, model: str, **options: Any) -> None:
        self._name, self._model = name, model
        self._options = options_of(options, model)
        self._controller: Controller | None = None
        self._reading: Reading | None = None
        self._topic = reading_topic(self._options.rate_hz)
        self._prepared: tuple[Segment, int] | None = None  # with the `nStop` it may be started at
        self._declared: Payload | None = None

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """See `hil.robot.HasAddress`."""
        return self._options.route

    def reach(self) -> Sequence[Finding]:
        """See `hil.robot.HasReach`."""
        try:
            address = listening_address(self._options)
        except RobotConnectionError as error:
            return [Finding("port", False, error.message, hint=error.hint)]
        return [Finding("port", True, f"a PLC's ADS port answers at {address}")]

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        return self._connected().identity

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        options = self._options
        return capabilities_of(
            self._model, options.rate_hz, options.effort, options.drive_gains_nm_a
        )

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than what the PLC checks."""
        controller = self._controller
        reported = None if controller is None else _reported_limits(controller.info)
        return limits_of(self._model, reported, self._options.speed_share)

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        return {} if self._reading is None else self._reading.drain()

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        controller = self._healthy()
        ring = self._active_reading().ring
        return list(_findings(controller, ring, self.limits, self._declared))

    def connect(self) -> None:
        """Find the PLC's variables, take the arm, start the heartbeat.

        After a fault or a lost connection everything is done anew.

        Raises:
            RobotConnectionError: No PLC answers, or it has another arm.
            PluginError: The PLC's program keeps another contract, or none.
            CommandRefused: Another client has the arm.
            RobotFault: It has a fault that cannot be reset.
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
        """Let the PLC compute with a load; return the load that it reports back.

        Raises:
            CommandRefused: It is too heavy, or the arm is moving.
            RobotError: See `Orders.give`.
        """
        controller = self._healthy()
        require_liftable(payload, self.limits)
        with self._stop_unless_answered(controller):
            answer = controller.orders.give(
                Order.PAYLOAD,
                "declare a load",
                fMass=payload.mass,
                aCom=payload.com,
                aInertia=payload.inertia,
            )
        self._declared = payload
        return payload_in(answer)

    def prepare(self, segment: Segment) -> None:
        """Check the next segment and upload it; the PLC checks it as well.

        Raises:
            CommandRefused: It leaves the limits, begins elsewhere, is too long, or the arm moves.
            RobotFault: There was a fault since `connect`.
            RobotError: See `Orders.give`.
        """
        self._prepared = None
        controller = self._healthy()
        with self._stop_unless_answered(controller):
            state, stops = controller.stops.before_start()
            if state["nPhase"] in (Phase.PLAYING, Phase.STOPPING):
                raise CommandRefused("the arm is still moving", hint="read until it is at rest")
            standing = controller.variables.newest_row()["aQTarget"]
            require_executable(segment, self.limits, standing, at_set_point_rad=AT_SET_POINT_RAD)
            if segment.kind != "hold":
                controller.load(segment)
        self._prepared = segment, stops

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: Nothing is prepared, the arm moves, or was stopped since `prepare`.
            RobotError: See `Orders.give`.
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
        """Return all rows since the last call, at least `block_rows` where time allows.

        The rows that show a fault are returned; the next call raises the fault, once, so that the
        arm can be followed until it is at rest.

        Raises:
            RobotTimeout: No row was written in time.
            RobotFault: The PLC has a fault, or has taken the arm away.
            RobotConnectionError: The connection is gone.
        """
        self._connected()
        return self._active_reading().read(timeout_s)

    def stop(self) -> None:
        """Bring the arm to rest on the PLC's own ramp.

        Raises:
            RobotConnectionError: The PLC was not reached; its watchdog stops the arm.
        """
        controller, reading = self._controller, self._reading
        self._prepared = None
        if controller is not None and reading is not None:
            reading.watch.idle = True
            controller.stop()

    def close(self) -> None:
        """Stop, release the arm, close the connection."""
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
                f"{controller.where} does not get our heartbeat any more"
                + (f": {why.message}" if why else ""),
                hint="connect() again",
            )
        return controller

    @contextmanager
    def _stop_unless_answered(self, controller: Controller) -> Iterator[None]:
        """Stop if a command in this context gets no answer: it might be obeyed later."""
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
    """Return the limits that the PLC checks, by its `stInfo`."""
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
    """Yield the driver's lines of a preflight, with the figures.

    Args:
        controller: Connected.
        ring: As it is read.
        limits: That plans are held against.
        declared: The load that the PLC was last given; None when it was not.
    """
    info, state = controller.info, controller.state()
    computed = payload_in(controller.variables.structure("stAnswer"))

    runtime = controller.runtime_state()
    name = STATES.get(runtime, str(runtime))
    message = f"the PLC's runtime is in state {name}"
    yield Finding("runtime", runtime == RUN, message, name, "RUN", "start the PLC in TwinCAT")

    phase = int(state["nPhase"])
    name = Phase(phase).name if phase in tuple(Phase) else str(phase)
    message = f"the PLC's program says {name}"
    if phase == Phase.FAULT:
        message += f", {controller.fault(state)}"
    hint = "see to the drives and the PLC's program"
    yield Finding("phase", phase == Phase.HOLDING, message, name, "HOLDING", hint)

    session, ours = int(state["nSession"]), controller.session
    obeys = "this computer" if session == ours else "somebody else"
    hint = "end the other client, then connect again"
    yield Finding(
        "session", session == ours, f"the PLC obeys {obeys}", str(session), str(ours), hint
    )

    cycle_s = float(info["fCycleS"])
    yield Finding("cycle", True, f"cycle {cycle_s * 1e3:g} ms, contract {CONTRACT}", cycle_s)

    watchdog_s, least_s = controller.watchdog_s, LEAST_BEATS * EVERY_S
    message = (
        f"the PLC stops the arm {watchdog_s:g} s after our last beat, one comes every {EVERY_S:g} s"
    )
    hint = "set fWatchdogS in the PLC to some tenths of a second"
    right = least_s <= watchdog_s <= 1.0
    yield Finding("watchdog", right, message, watchdog_s, f"{least_s:g} … 1 s", hint)

    # Plans are held against the stricter limits of maker and PLC.
    wider = _reported_limits(info).exceeded_by(limits)
    message = "joint limits used are no wider than what the PLC checks"
    yield Finding("joint-limits", not wider.any(), message, int(wider.sum()), 0)

    yield payload_finding(declared, computed, "see to the PLC's program")

    rows = int(info["nRingRows"])
    message = f"ring of {rows} rows ({rows * cycle_s:.1f} s): {ring.lost} rows lost in {ring.gaps} "
    message += "gaps" + (f", {ring.torn} blocks read again" if ring.torn else "")
    hint = "something kept hil from reading: look for other load on this computer"
    yield Finding("ring", ring.lost == 0, message, ring.lost, 0, hint)
