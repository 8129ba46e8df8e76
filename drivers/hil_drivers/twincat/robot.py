"""An arm behind a TwinCAT PLC as `hil` drives it: the PLC owns the cycle, plays and records.

A segment is uploaded, checked by the PLC and played on its own time; meanwhile rows are pulled from
a ring that the PLC writes in every cycle. So nothing here has to be punctual but the heartbeat and
the stop, which have lines of their own (`controller`). A command that is not answered might be
obeyed later: it is followed by a stop, and no further one is given until connected again.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from hil.arms import Payload
from hil.core import CommandRefused, RobotConnectionError, RobotFault, RobotTimeout, StructArray
from hil.robot import Address, Capabilities, Finding, Identity, Limits, Segment, Topic
from hil_drivers.arm import (
    faulty,
    not_connected,
    nothing_prepared,
    require_executable,
    require_liftable,
)
from hil_drivers.twincat.controller import Controller, payload_in
from hil_drivers.twincat.facts import capabilities_of, limits_of
from hil_drivers.twincat.findings import findings_of
from hil_drivers.twincat.options import options_of
from hil_drivers.twincat.reach import reached
from hil_drivers.twincat.reading import Reading, Watch, reading_topic
from hil_drivers.twincat.variables import Order, Phase

AT_SET_POINT_RAD = 1e-3
"""The PLC begins with the first set-point as it is: it has to be where the arm is held."""


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
        return reached(self._options)

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        return self._connected().identity

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than what the PLC checks."""
        info = None if self._controller is None else self._controller.info
        return limits_of(self._model, self._options, info)

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
        return list(findings_of(controller, self._reading_on().ring, self.limits, self._declared))

    def connect(self) -> None:
        """Find the PLC's variables, take the arm, begin with the heartbeat.

        After a fault or a lost connection it does so from the beginning.

        Raises:
            RobotConnectionError: No PLC answers, or it has another arm.
            PluginError: The PLC's program keeps another contract, or none.
            CommandRefused: Another client has the arm.
            RobotFault: It has a fault that cannot be reset.
        """
        if self._controller is not None and not self._watch.faulty:
            return
        self._let_go()
        controller = Controller(self._model, self._options)
        try:
            self._reading = Reading(controller, self._options, self._topic)
        except BaseException:
            controller.close()
            raise
        self._controller, self._declared = controller, None

    def set_payload(self, payload: Payload) -> Payload:
        """Let the PLC compute with a load; returns what it says that it computes with.

        Raises:
            CommandRefused: It is too heavy, or the arm is moving.
            RobotError: See `Orders.give`.
        """
        controller = self._healthy()
        require_liftable(payload, self.limits)
        with self._obeyed(controller):
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
            RobotFault: The arm does not obey any more.
            RobotError: See `Orders.give`.
        """
        self._prepared = None
        controller = self._healthy()
        with self._obeyed(controller):
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
            CommandRefused: Nothing is prepared, a motion is still on, or it was stopped meanwhile.
            RobotError: See `Orders.give`.
        """
        prepared, self._prepared = self._prepared, None
        controller = self._healthy()
        if prepared is None:
            raise nothing_prepared()
        segment, stops = prepared
        order = Order.HOLD if segment.kind == "hold" else Order.START
        what = f"start segment {segment.index} ({segment.kind})"
        with self._obeyed(controller):
            controller.orders.give(order, what, nSegment=segment.index, nStop=stops)
        self._watch.begun(segment.index)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All rows since the last call, a block of `block_rows` where there is time for it.

        A fault comes with the rows that show it; the next call raises it, once, so that the arm
        can still be watched coming to rest.

        Raises:
            RobotTimeout: No row was written in time.
            RobotFault: The PLC has a fault, or has taken the arm away.
            RobotConnectionError: The connection is gone.
        """
        self._connected()
        return self._reading_on().read(timeout_s)

    def stop(self) -> None:
        """Bring the arm to rest on the PLC's own ramp.

        Raises:
            RobotConnectionError: The PLC could not be told; its watchdog does it then.
        """
        controller, reading = self._controller, self._reading
        self._prepared = None
        if controller is not None and reading is not None:
            reading.watch.idle = True
            controller.stop()

    def close(self) -> None:
        """Stop, release the arm, let go of the PLC."""
        if self._controller is None:
            return
        try:
            self.stop()
        except RobotConnectionError:
            return
        finally:
            self._let_go()

    def _connected(self) -> Controller:
        if self._controller is None:
            raise not_connected(self._name)
        return self._controller

    def _reading_on(self) -> Reading:
        assert self._reading is not None
        return self._reading

    @property
    def _watch(self) -> Watch:
        return self._reading_on().watch

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
    def _obeyed(self, controller: Controller) -> Iterator[None]:
        """A command that gets no answer might be obeyed later: stop, and give no more of them."""
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

    def _let_go(self) -> None:
        controller, self._controller, self._reading = self._controller, None, None
        self._prepared = None
        if controller is not None:
            controller.close()
