"""The robot in the process that owns the bus: a `hil.robot.Robot` of as many drives as joints.

`AxesRobot` turns the calls of `hil.robot.Robot` into those of a `Session` and decides on which
field bus that runs. Another thread may stop at any moment, also while the drives are being
connected or a segment is being prepared: `_stops` counts the stops, and a connection or preparation
that began before the last stop is refused.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from hil.arms import Payload, load_arm
from hil.core import CommandRefused, RobotFault, RobotTimeout, StructArray
from hil.robot import Address, Capabilities, Finding, Identity, Limits, Segment, Topic
from hil_drivers.arm import (
    capabilities_of,
    limits_of,
    not_connected,
    nothing_prepared,
    require_liftable,
)
from hil_drivers.cia402.can_bus import CanBus
from hil_drivers.cia402.commissioning import declare
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.rows import raw_topic
from hil_drivers.cia402.session import NEXT, Session
from hil_drivers.cia402.torque import GRAVITY, TorqueModel
from hil_drivers.cia402.track import track_of

GAINS_SOURCE = "rated torque and current of the drives (6075h, 6076h) times gear, or the station's"

REST_S = 2.0
"""How long an arm may take to come to rest before its axes are switched off [s]."""


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
        self._session: Session | None = None
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
        session = self._connected()
        return session.drives.identity(self._model, session.faults_reset)

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`; once connected, the gains are those of the drives."""
        rate_hz, effort = self._options.rate_hz, self._options.effort
        if self._session is None:
            return capabilities_of(self._model, rate_hz, effort)
        gains = self._session.drives.scaling.drive_gains
        return capabilities_of(self._model, rate_hz, effort, gains, GAINS_SOURCE)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than the drives' own."""
        session = self._session
        return limits_of(self._model, session.drives.reported_limits if session else None)

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        return self._session.samples.drain() if self._session else {}

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        session = self._healthy()
        model = session.torque or TorqueModel(self._model, self._options.urdf, self._gravity)
        model.mount(self._payload)
        return list(session.findings(model))

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set gravity in the base frame [m/s²] for the torque model; call before `connect`."""
        self._gravity = gravity_m_s2

    def connect(self) -> None:
        """Join the bus, set all drives up, start the cycles, enable all axes where they are.

        Raises:
            RobotConnectionError, RobotFault, RobotTimeout: See `Session`.
            CommandRefused: Likewise; or `stop` was called meanwhile, and the axes are off.
        """
        if self._session is not None and not self._session.trouble.is_there:
            return
        stops = self._stops
        self.close()
        try:
            self._begin(stops)
        except BaseException:
            self.close()
            raise

    def _begin(self, stops: int) -> None:
        """Connect, unless `stop` was called since there were so many stops."""

        def go_on() -> None:
            if self._stops != stops:
                raise CommandRefused("stopped while connecting", hint="connect again")

        self._payload, self._has_moved = Payload(), False
        self._session = self._join()
        try:
            self._session.begin(go_on)
        except CommandRefused:
            go_on()
            raise

    def _join(self) -> Session:
        """Join the bus and set all drives up; nothing moves, no axis is enabled yet."""
        options, arm = self._options, load_arm(self._model)
        needed = options.feed_forward or options.trajectory_mode == "cst"
        torque = TorqueModel(self._model, options.urdf, self._gravity) if needed else None
        bus = CanBus(options, arm.joint_names)
        return Session(self._name, arm, options, bus, self._topic, torque)

    def set_payload(self, payload: Payload) -> Payload:
        """Keep a load for the torque model; declare it to drives that have an object for it.

        Raises:
            CommandRefused: It is too heavy, the arm is moving, or a drive does not take it.
        """
        session = self._healthy()
        require_liftable(payload, self.limits)
        if session.player.moving:
            raise CommandRefused("a load is declared at rest", hint="read until the arm holds")
        read_back = payload
        if self._options.payload_object:
            read_back = declare(session.acyclic, self._options.payload_object, payload)
        self._payload = payload
        if session.torque is not None:
            session.torque.mount(payload)
            session.hold_anew()
        return read_back

    def prepare(self, segment: Segment) -> None:
        """Check the next segment and keep it for `start`.

        Raises:
            CommandRefused: It leaves the limits, jumps, moves at its ends, or begins elsewhere.
            RobotFault: There was a fault since `connect`.
        """
        session, stops = self._healthy(), self._stops
        self._prepared = False
        scaling = session.drives.scaling
        track = track_of(
            segment,
            self.limits,
            scaling.position(session.player.position),
            self._options.rate_hz,
            scaling,
            session.torque,
            led=self._options.trajectory_mode != "csp",
            first=not self._has_moved,
        )
        session.core.prepare(track)
        self._prepared = stops == self._stops
        if not self._prepared:  # a stop meanwhile takes effect
            raise CommandRefused("stopped while it was prepared", hint="prepare it again")

    def start(self) -> None:
        """Begin the prepared segment with the next cycle.

        Raises:
            CommandRefused: Nothing is prepared, or the arm moves.
            RobotFault: There was a fault since `connect`.
        """
        session = self._healthy()
        prepared, self._prepared = self._prepared, False
        if not prepared:
            raise nothing_prepared()
        session.core.start()
        self._has_moved = True

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Return all samples since the last call.

        The rows that show a fault are returned; the next call raises the fault, once, so that the
        arm can be followed until it is at rest.

        Raises:
            RobotTimeout: No sample in time.
            RobotFault: An axis has failed, and all were stopped.
            RobotConnectionError: The bus is gone.
        """
        session = self._connected()
        until = time.monotonic() + timeout_s
        while True:
            session.trouble.raise_it()
            try:
                rows = session.samples.take(max(until - time.monotonic(), 0.0))
            except RobotTimeout:
                raise session.trouble.silence(timeout_s) from None
            session.trouble.look(rows)
            if len(rows):
                break
        if not session.trouble.is_there:
            session.thermometer.look()
        session.bus.flush()
        return rows

    def stop(self) -> None:
        """Ramp down along the way, with the next cycle, and hold; from any thread."""
        self._stops += 1
        self._prepared = False
        session = self._session
        if session is not None:
            session.core.stop(self._options.stop_rad_s2)

    def close(self) -> None:
        """Stop, switch all axes off, leave the bus."""
        session, self._session = self._session, None
        self._prepared = False
        if session is not None:
            session.leave(rest_s=0.0 if session.trouble.is_there else REST_S)

    def _connected(self) -> Session:
        if self._session is None:
            raise not_connected(self._name)
        return self._session

    def _healthy(self) -> Session:
        session = self._connected()
        if session.trouble.is_there:
            raise RobotFault(
                f"{self._name} does not obey since a fault: {session.trouble.text}", hint=NEXT
            )
        return session
