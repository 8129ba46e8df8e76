"""An arm behind a TwinCAT PLC: the PLC plays what was uploaded, and its ring is pulled."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.errors import CommandRefused, RobotConnectionError, RobotFault, RobotTimeout
from hil.payload import Payload
from hil.record.topic import Topic
from hil.robot import Capabilities, Finding, Identity, Limits, Segment
from hil.typing import StructArray
from hil_drivers.checks import require_executable, require_liftable
from hil_drivers.twincat.controller import Controller
from hil_drivers.twincat.facts import capabilities_of, limits_of
from hil_drivers.twincat.findings import Looked, findings_of
from hil_drivers.twincat.options import options_of
from hil_drivers.twincat.orders import LOAD_S, payload_fields, payload_in
from hil_drivers.twincat.ring import Ring
from hil_drivers.twincat.rows import TOPIC, HostClock, reading_rows, reading_topic, state_rows
from hil_drivers.twincat.symbols import Order, Phase
from hil_drivers.twincat.watch import Watch

AT_SET_POINT_RAD = 1e-3
"""The PLC begins with the first set-point as it is: it has to be where the arm is held."""

LEAST_NAP_S = 1e-3

KEPT_S = 5.0
"""Rows of an arm that nobody has moved or read: no more than these are told [s]."""


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
        self._ring: Ring | None = None
        self._watch = Watch(0, self._options.late_s)
        self._clock = HostClock()
        self._topic = reading_topic(self._options.rate_hz)
        self._further: list[StructArray] = []
        self._prepared: tuple[Segment, int] | None = None
        self._declared: Payload | None = None

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

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
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        controller = self._healthy()
        looked = Looked(
            controller,
            controller.runtime_state(),
            controller.state(),
            self.limits,
            self._declared,
            payload_in(controller.variables.structure("stAnswer")),
            self._reading(),
        )
        return list(findings_of(looked))

    def connect(self) -> None:
        """Find the PLC's variables, take the arm, begin with the heartbeat.

        After a fault or a lost connection it does so from the beginning.

        Raises:
            RobotConnectionError: Nobody is there, or it is another arm.
            PluginError: The PLC's program keeps another contract, or none.
            CommandRefused: Somebody else has the arm.
            RobotFault: It has a fault that cannot be reset.
        """
        if self._controller is not None and not self._watch.faulty:
            return
        self._let_go()
        self._controller = Controller(self._model, self._options)
        self._ring = self._controller.variables.ring()
        self._watch = Watch(self._controller.session, self._options.late_s)
        self._clock, self._further, self._declared = HostClock(), [], None

    def set_payload(self, payload: Payload) -> Payload:
        """Let the PLC compute with a load; returns what it says that it computes with.

        Raises:
            CommandRefused: It is too heavy, or the arm is moving.
        """
        controller = self._healthy()
        require_liftable(payload, self.limits)
        answer = controller.orders.give(Order.PAYLOAD, "declare a load", **payload_fields(payload))
        self._declared = payload
        return payload_in(answer)

    def prepare(self, segment: Segment) -> None:
        """Check the next segment and upload it; the PLC checks it as well.

        Raises:
            CommandRefused: It leaves the limits, begins elsewhere, or is too long.
            RobotFault: The arm does not obey any more.
        """
        self._prepared = None
        controller = self._healthy()
        stops = controller.stops
        state = controller.state()
        if state["nPhase"] in (Phase.PLAYING, Phase.STOPPING):
            raise CommandRefused("the arm is still moving", hint="read until it is at rest")
        standing = controller.variables.newest_row()["aQTarget"]
        require_executable(segment, self.limits, standing, at_set_point_rad=AT_SET_POINT_RAD)
        if segment.kind != "hold":
            self._load(controller, segment)
        self._prepared = segment, stops

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: Nothing is prepared, a motion is still on, or it was stopped meanwhile.
        """
        prepared, self._prepared = self._prepared, None
        controller = self._healthy()
        if prepared is None:
            raise CommandRefused("no segment is prepared", hint="call prepare() first")
        segment, stops = prepared
        order = Order.HOLD if segment.kind == "hold" else Order.START
        what = f"start segment {segment.index} ({segment.kind})"
        controller.orders.give(order, what, nSegment=segment.index, nStop=stops)
        self._watch.begun(segment.index)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All rows since the last call, a block of `block_rows` where there is time for it.

        A fault comes with the rows that show it; the next call raises it, once, so that whoever
        watches the arm come to rest still sees it.

        Raises:
            RobotTimeout: No row was written in time.
            RobotFault: The PLC has a fault, or has taken the arm away.
            RobotConnectionError: The connection is gone.
        """
        controller, ring = self._connected(), self._reading()
        problem, self._watch.problem = self._watch.problem, None
        if problem is not None:
            raise problem
        try:
            state = self._await_rows(controller, ring, timeout_s)
            now = time.time()
            if self._watch.idle and not self._watch.moving:
                ring.forget(int(state["nHead"]), round(KEPT_S * self._options.rate_hz))
            raw = ring.pull(int(state["nHead"]))
        except RobotConnectionError:
            self._watch.faulty = True
            raise
        rows = state_rows(raw, int(controller.info["nOffers"]))
        self._clock.stamp(rows, now, 1.0 / self._options.rate_hz)
        self._further.append(reading_rows(rows, raw, ring, self._topic))
        self._watch.see(rows, state, controller.fault)
        return rows

    def stop(self) -> None:
        """Bring the arm to rest on the PLC's own ramp.

        Raises:
            RobotConnectionError: The PLC could not be told; its watchdog does it then.
        """
        controller = self._controller
        self._prepared = None
        if controller is not None:
            self._watch.idle = True
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

    def client_gone(self) -> None:
        """For drivers in a process of their own: nothing to be told to this arm."""

    def _load(self, controller: Controller, segment: Segment) -> None:
        room, rows = int(controller.info["nSetPoints"]), len(segment.q)
        if rows > room:
            raise CommandRefused(
                f"segment {segment.index} has {rows} set-points, the PLC has room for {room}",
                hint="plan shorter motions, or raise SET_POINTS in the PLC",
            )
        fields = controller.variables.upload(segment)
        what = f"load segment {segment.index} ({segment.kind})"
        answer = controller.orders.give(Order.LOAD, what, LOAD_S, **fields)
        if (answer["nSumA"], answer["nSumB"]) != (fields["nSumA"], fields["nSumB"]):
            raise CommandRefused(
                f"{what}: the PLC reads back other set-points than were sent", hint="try again"
            )

    def _await_rows(self, controller: Controller, ring: Ring, timeout_s: float) -> np.void:
        """The PLC's state once a block is there, or some rows and no time left for more."""
        asked, wanted = time.monotonic(), self._options.block_rows
        until = asked + timeout_s
        enough = min(until, asked + 1.5 * wanted / self._options.rate_hz)
        while True:
            state = controller.state()
            waiting = int(state["nHead"]) - ring.next
            now = time.monotonic()
            if not self._watch.advanced(int(state["nHead"])) and self._watch.moving:
                # Both are there when it goes on: the stop, and the silence of our heartbeat.
                self._watch.faulty = True
                controller.beat.hush()
                controller.stop()
                raise self._watch.stands_still(controller.where)
            if waiting >= wanted or waiting < 0 or (waiting and now >= enough):
                return state
            if now >= until:
                raise RobotTimeout(
                    f"{controller.where} has written no rows within {timeout_s:g} s",
                    hint="is its task running? TwinCAT shows its cycle",
                )
            nap = (wanted - waiting) / self._options.rate_hz / 2
            time.sleep(max(LEAST_NAP_S, min(nap, until - now)))

    def _connected(self) -> Controller:
        if self._controller is None:
            raise RobotConnectionError(
                f"{self._name} is not connected", hint="call connect() first"
            )
        return self._controller

    def _reading(self) -> Ring:
        assert self._ring is not None
        return self._ring

    def _healthy(self) -> Controller:
        controller = self._connected()
        if self._watch.faulty:
            raise RobotFault(
                f"{self._name} does not obey since a fault", hint="remove its cause, then connect()"
            )
        if not controller.beat.alive:
            raise RobotConnectionError(
                f"{controller.where} does not get our heartbeat any more",
                hint="connect() again",
            )
        return controller

    def _let_go(self) -> None:
        controller, self._controller, self._ring = self._controller, None, None
        self._prepared = None
        if controller is not None:
            controller.close()
