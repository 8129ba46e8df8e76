"""Robot in the process that owns the bus: a `hil.robot.Robot` with one drive per joint.

`AxesRobot` forwards the calls of `hil.robot.Robot` to a `Session` and selects the field bus.
Another thread can call `stop` at any moment, also while the drives are being connected or a segment
is being prepared. The attribute `_stops` counts the stops, so that a connection or preparation that
began before the last stop is refused.
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

GAINS_SOURCE = (
    "rated torque and rated current of the drives (6075h, 6076h) times gear ratio, or values of "
    "the station"
)

REST_S = 2.0
"""Longest wait for the arm to come to rest before its axes are switched off [s]."""


class AxesRobot:
    """Implementation of `hil.robot.Robot` in the process that owns the field bus.

    Only one thread may call the methods of this class; `stop` alone can be called by any thread.

    Args:
        name: Name of the robot in its station.
        model: Name of an arm model that comes with hil.
        options: Options of the station, as described in `hil_drivers.cia402.options.Options`.

    Raises:
        SpecError: An option of the station is missing, unknown or invalid.
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
        """Identifier of the bus as an exclusive resource; see `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """Address of the bus; see `hil.robot.HasAddress`."""
        return self._options.address

    @property
    def identity(self) -> Identity:
        """Identity of the arm and its drives; see `hil.robot.Robot`."""
        session = self._connected()
        return session.drives.identity(self._model, session.faults_reset)

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of the arm, with the gains of the drives while connected."""
        rate_hz, effort = self._options.rate_hz, self._options.effort
        if self._session is None:
            return capabilities_of(self._model, rate_hz, effort)
        gains = self._session.drives.scaling.drive_gains
        return capabilities_of(self._model, rate_hz, effort, gains, GAINS_SOURCE)

    @property
    def limits(self) -> Limits:
        """Limits of the arm; while connected, no limit is wider than that of the drives."""
        session = self._session
        return limits_of(self._model, session.drives.reported_limits if session else None)

    @property
    def topics(self) -> Sequence[Topic]:
        """Topic of the raw drive values; see `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """Return the raw drive values since the last call; see `hil.robot.HasTopics`."""
        return self._session.samples.drain() if self._session else {}

    def checks(self) -> Sequence[Finding]:
        """Return the preflight checks of this driver; see `hil.robot.HasChecks`."""
        session = self._healthy()
        model = session.torque or TorqueModel(self._model, self._options.urdf, self._gravity)
        model.mount(self._payload)
        return list(session.findings(model))

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Set the gravity vector of the torque model [m/s², base frame]; call before `connect`."""
        self._gravity = gravity_m_s2

    def connect(self) -> None:
        """Open the bus, configure all drives, start the cycles and enable all axes.

        After connecting, all axes hold their present positions.

        Raises:
            RobotConnectionError: See `Session`.
            RobotFault: See `Session`.
            RobotTimeout: See `Session`.
            CommandRefused: A drive does not accept a setting; or `stop` was called during
                connecting, and the axes are off.
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
        """Connect the drives; raise if the number of stops has changed from `stops`."""

        def go_on() -> None:
            if self._stops != stops:
                raise CommandRefused("the arm was stopped while connecting", hint="connect again")

        self._payload, self._has_moved = Payload(), False
        self._session = self._join()
        try:
            self._session.begin(go_on)
        except CommandRefused:
            go_on()
            raise

    def _join(self) -> Session:
        """Open the bus and configure all drives without enabling or moving an axis."""
        options, arm = self._options, load_arm(self._model)
        needed = options.feed_forward or options.trajectory_mode == "cst"
        torque = TorqueModel(self._model, options.urdf, self._gravity) if needed else None
        bus = CanBus(options, arm.joint_names)
        return Session(self._name, arm, options, bus, self._topic, torque)

    def set_payload(self, payload: Payload) -> Payload:
        """Set the payload of the torque model, and write it to drives that have a payload object.

        Raises:
            CommandRefused: The payload is too heavy for the arm, the arm is moving, or a drive does
                not accept the payload.
        """
        session = self._healthy()
        require_liftable(payload, self.limits)
        if session.player.moving:
            raise CommandRefused(
                "a payload can be declared only at standstill",
                hint="read until the status is HOLDING",
            )
        read_back = payload
        if self._options.payload_object:
            read_back = declare(session.acyclic, self._options.payload_object, payload)
        self._payload = payload
        if session.torque is not None:
            session.torque.mount(payload)
            session.hold_anew()
        return read_back

    def prepare(self, segment: Segment) -> None:
        """Check the next segment of the plan and store it for `start`.

        Raises:
            CommandRefused: The segment leaves the limits, jumps, has a speed other than 0 at its
                first or last sample, or does not begin at the present position; or `stop` was
                called during the preparation.
            RobotFault: A fault occurred since `connect`.
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
        if not self._prepared:  # `stop` was called during the preparation
            raise CommandRefused(
                "the arm was stopped while the segment was prepared",
                hint="prepare the segment again",
            )

    def start(self) -> None:
        """Start the motion along the prepared segment with the next cycle.

        Raises:
            CommandRefused: No segment is prepared, or the arm moves.
            RobotFault: A fault occurred since `connect`.
        """
        session = self._healthy()
        prepared, self._prepared = self._prepared, False
        if not prepared:
            raise nothing_prepared()
        session.core.start()
        self._has_moved = True

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Return all samples of the arm that were recorded since the last call.

        A call returns also the samples that show a fault. The call after these samples raises the
        fault, one time only, so that the motion of the arm is recorded until the arm is at rest.

        Raises:
            RobotTimeout: No sample arrived within the timeout.
            RobotFault: An axis has failed, and all axes were stopped.
            RobotConnectionError: The connection to the bus is lost.
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
        """Decelerate along the path from the next cycle on, then hold; any thread can call this."""
        self._stops += 1
        self._prepared = False
        session = self._session
        if session is not None:
            session.core.stop(self._options.stop_rad_s2)

    def close(self) -> None:
        """Stop the arm, switch all axes off and close the bus."""
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
                f"{self._name} accepts no commands since a fault: {session.trouble.text}", hint=NEXT
            )
        return session
