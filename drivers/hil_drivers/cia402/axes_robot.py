"""The arm in the process that owns the bus: a `hil.robot.Robot` of as many drives as joints."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from hil.arms import Payload
from hil.core import CommandRefused, RobotFault, RobotTimeout, StructArray
from hil.robot import Address, Capabilities, Finding, Identity, Limits, Segment, Topic
from hil_drivers.arm import not_connected, nothing_prepared, require_liftable
from hil_drivers.cia402.drives import Commissioned
from hil_drivers.cia402.facts import capabilities_of, identity_of, limits_of
from hil_drivers.cia402.findings import findings_of
from hil_drivers.cia402.line import Line, line_to
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.payload_object import declare
from hil_drivers.cia402.rows import raw_topic
from hil_drivers.cia402.torque_model import GRAVITY, TorqueModel
from hil_drivers.cia402.tracks import track_of
from hil_drivers.cia402.trouble import NEXT

REST_S = 2.0
"""How long an arm that was stopped is waited for before its axes are switched off [s]."""


class AxesRobot:
    """Implements `hil.robot.Robot`; everything but `stop` is called by one thread.

    Args:
        name: The robot's name in its station.
        model: A built-in arm.
        options: See `hil_drivers.cia402.options.Options`.

    Raises:
        SpecError: An option is missing, unknown, or cannot be.
    """

    def __init__(self, name: str, model: str, **options: Any) -> None:
        self._name, self._model = name, model
        self._options = options_of(options, model)
        self._gravity, self._payload = GRAVITY, Payload()
        self._topic = raw_topic(
            MAPPINGS[self._options.mapping], len(self._options.nodes), self._options.rate_hz
        )
        self._line: Line | None = None
        self._prepared = False
        self._has_moved = False
        self._stops = 0

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """See `hil.robot.HasAddress`."""
        return self._options.address

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        session = self._connected().session
        return identity_of(self._model, session.drives, session.were_reset)

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options, self._drives)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than the drives' own."""
        return limits_of(self._model, self._drives)

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        return self._line.samples.drain() if self._line else {}

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        line = self._healthy()
        model = line.torque or TorqueModel(self._model, self._options.urdf, self._gravity)
        model.mount(self._payload)
        return list(findings_of(line.session, model))

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Gravity in the base frame, for the torque model; before `connect`."""
        self._gravity = gravity_m_s2

    def connect(self) -> None:
        """Join the bus, set all drives up, start the cycles, enable all axes where they are.

        Raises:
            RobotConnectionError, RobotFault, RobotTimeout: See `Session`.
            CommandRefused: Likewise; or `stop` came meanwhile, and the axes are off.
        """
        if self._line is not None and not self._line.trouble.is_there:
            return
        stops = self._stops
        self.close()
        try:
            self._begin(stops)
        except BaseException:
            self.close()
            raise

    def _begin(self, stops: int) -> None:
        """Connect, unless a stop is more than so many."""

        def go_on() -> None:
            if self._stops != stops:
                raise CommandRefused("stopped while connecting", hint="connect again")

        self._payload, self._has_moved = Payload(), False
        line = self._line = line_to(
            self._name, self._model, self._options, self._topic, self._gravity
        )
        try:
            line.session.begin(go_on, line.look)
        except CommandRefused:
            go_on()
            raise
        line.thermometer.ask_all()
        line.samples.forget()
        go_on()

    def set_payload(self, payload: Payload) -> Payload:
        """Keep a load for the torque model; declare it to drives that have an object for it.

        Raises:
            CommandRefused: It is too heavy, the arm is moving, or a drive does not take it.
        """
        line = self._healthy()
        require_liftable(payload, self.limits)
        if line.session.player.moving:
            raise CommandRefused("a load is declared at rest", hint="read until the arm holds")
        told = payload
        if self._options.payload_object:
            told = declare(line.session.acyclic, self._options.payload_object, payload)
        self._payload = payload
        if line.torque is not None:
            line.torque.mount(payload)
            line.hold_anew()
        return told

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It leaves the limits, jumps, moves at its ends, or begins elsewhere.
            RobotFault: The arm does not obey any more.
        """
        line, stops = self._healthy(), self._stops
        self._prepared = False
        scaling = line.session.drives.scaling
        track = track_of(
            segment,
            self.limits,
            scaling.position(line.session.player.position),
            self._options.rate_hz,
            scaling,
            line.torque,
            led=self._options.trajectory_mode != "csp",
            first=not self._has_moved,
        )
        line.session.core.prepare(track)
        self._prepared = stops == self._stops
        if not self._prepared:  # a stop that has come meanwhile holds
            raise CommandRefused("stopped while it was prepared", hint="prepare it again")

    def start(self) -> None:
        """Begin the prepared segment with the next cycle.

        Raises:
            CommandRefused: Nothing is prepared, or a motion is still on.
            RobotFault: The arm does not obey any more.
        """
        line = self._healthy()
        prepared, self._prepared = self._prepared, False
        if not prepared:
            raise nothing_prepared()
        line.session.core.start()
        self._has_moved = True

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All samples since the last call.

        A fault comes with the rows that show it; the next call raises it, once, so that whoever
        watches the arm come to rest still sees it.

        Raises:
            RobotTimeout: No sample in time.
            RobotFault: An axis has failed, and all were stopped.
            RobotConnectionError: The bus is gone.
        """
        line = self._connected()
        until = time.monotonic() + timeout_s
        while True:
            line.trouble.raise_it()
            try:
                rows = line.samples.take(max(until - time.monotonic(), 0.0))
            except RobotTimeout:
                raise line.trouble.silence(timeout_s) from None
            line.trouble.look(rows)
            if len(rows):
                break
        if not line.trouble.is_there:
            line.thermometer.look()
        line.session.flush()
        return rows

    def stop(self) -> None:
        """Ramp down along the way, with the next cycle, and hold; from any thread."""
        self._stops += 1
        self._prepared = False
        line = self._line
        if line is not None:
            line.session.core.stop(self._options.stop_rad_s2)

    def close(self) -> None:
        """Stop, switch all axes off, leave the bus."""
        line, self._line = self._line, None
        self._prepared = False
        if line is not None:
            line.session.leave(rest_s=0.0 if line.trouble.is_there else REST_S)

    @property
    def _drives(self) -> Commissioned | None:
        return self._line.session.drives if self._line else None

    def _connected(self) -> Line:
        if self._line is None:
            raise not_connected(self._name)
        return self._line

    def _healthy(self) -> Line:
        line = self._connected()
        if line.trouble.is_there:
            said = f"{self._name} does not obey since a fault: {line.trouble.said}"
            raise RobotFault(said, hint=NEXT)
        return line
