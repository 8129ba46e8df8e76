"""The arm in the process that owns the bus: a `hil.robot.Robot` of as many drives as joints."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

from hil.errors import CommandRefused, HilError, RobotConnectionError, RobotFault
from hil.payload import Payload
from hil.record.topic import Topic
from hil.robot import Capabilities, Finding, Identity, Limits, Segment
from hil.typing import StructArray
from hil_drivers.checks import require_liftable
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.emergencies import error_text
from hil_drivers.cia402.facts import capabilities_of, identity_of, limits_of
from hil_drivers.cia402.findings import findings_of
from hil_drivers.cia402.mapping import MAPPINGS
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.payload_object import declare
from hil_drivers.cia402.rows import raw_topic
from hil_drivers.cia402.samples import Samples
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.thermometer import Thermometer
from hil_drivers.cia402.torque_model import GRAVITY, TorqueModel
from hil_drivers.cia402.tracks import track_of

REST_S = 2.0
"""How long an arm that was stopped is waited for before its axes are switched off [s]."""

NEXT = "see to the cause, then connect again"


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
        self._gravity = GRAVITY
        self._topic = raw_topic(
            MAPPINGS[self._options.mapping], len(self._options.nodes), self._options.rate_hz
        )
        self._session: Session | None = None
        self._samples: Samples | None = None
        self._torque: TorqueModel | None = None
        self._thermometer: Thermometer | None = None
        self._problem: HilError | None = None
        self._faulty = self._prepared = False
        self._stops = 0

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        session = self._connected()
        return identity_of(self._model, session.drives, session.were_reset)

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        drives = self._session.drives if self._session else None
        return capabilities_of(self._model, self._options, drives)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than the drives' own."""
        return limits_of(self._model, self._session.drives if self._session else None)

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        return self._samples.drain() if self._samples else {}

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        return list(findings_of(self._healthy()))

    def set_gravity(self, gravity_m_s2: tuple[float, float, float]) -> None:
        """Gravity in the base frame, for the torque model; before `connect`."""
        self._gravity = gravity_m_s2

    def connect(self) -> None:
        """Join the bus, set all drives up, start the cycles, enable all axes where they are.

        Raises:
            RobotConnectionError, RobotFault, RobotTimeout, CommandRefused: See `Session`.
        """
        if self._session is not None and not self._faulty:
            return
        self.close()
        if self._options.feed_forward or self._options.trajectory_mode == "cst":
            self._torque = TorqueModel(self._model, self._options.urdf, self._gravity)
        session = self._session = Session(self._model, self._options)
        self._samples = Samples(session, self._topic)
        self._thermometer = Thermometer(
            session.acyclic, self._options.temperature_object, session.core.temperature
        )
        try:
            session.begin()
            self._thermometer.ask_all()
            self._samples.forget()
        except BaseException:
            self.close()
            raise

    def set_payload(self, payload: Payload) -> Payload:
        """Keep a load for the torque model; declare it to drives that have an object for it.

        Raises:
            CommandRefused: It is too heavy, the arm is moving, or a drive does not take it.
        """
        session = self._healthy()
        require_liftable(payload, self.limits)
        if session.player.moving:
            raise CommandRefused("a load is declared at rest", hint="read until the arm holds")
        if self._torque is not None:
            self._torque.mount(payload)
        if self._options.payload_object:
            return declare(session.acyclic, self._options.payload_object, payload)
        return payload

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It leaves the limits, jumps, moves at its ends, or begins elsewhere.
            RobotFault: The arm does not obey any more.
        """
        session, stops = self._healthy(), self._stops
        self._prepared = False
        standing = session.drives.scaling.position(session.player.position)
        rate_hz, scaling = self._options.rate_hz, session.drives.scaling
        track = track_of(segment, self.limits, standing, rate_hz, scaling, self._torque)
        session.core.prepare(track)
        self._prepared = stops == self._stops
        if not self._prepared:  # a stop that has come meanwhile holds
            raise CommandRefused("stopped while it was prepared", hint="prepare it again")

    def start(self) -> None:
        """Begin the prepared segment with the next cycle.

        Raises:
            CommandRefused: Nothing is prepared, or a motion is still on.
            RobotFault: The arm does not obey any more.
        """
        session = self._healthy()
        prepared, self._prepared = self._prepared, False
        if not prepared:
            raise CommandRefused("no segment is prepared", hint="call prepare() first")
        session.core.start()

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All samples since the last call.

        A fault comes with the rows that show it; the next call raises it, once, so that whoever
        watches the arm come to rest still sees it.

        Raises:
            RobotTimeout: No sample in time.
            RobotFault: An axis has failed, and all were stopped.
            RobotConnectionError: The bus is gone.
        """
        session = self._connected()
        until = time.monotonic() + timeout_s
        rows = None
        while rows is None or not len(rows):
            self._raise_problem()
            rows = self._taken(max(until - time.monotonic(), 0.0))
            self._look(session)
        if self._thermometer is not None and not self._faulty:
            self._thermometer.look()
        session.flush()
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
            session.leave(rest_s=0.0 if self._faulty else REST_S)
        self._samples = self._thermometer = self._torque = self._problem = None
        self._faulty = False

    def client_gone(self) -> None:
        """For drivers in a process of their own: nothing to be told to drives."""

    def _taken(self, timeout_s: float) -> StructArray:
        assert self._samples is not None, "connected without samples"
        try:
            return self._samples.take(timeout_s)
        except RobotConnectionError:
            self._faulty = True
            raise

    def _look(self, session: Session) -> None:
        """Find out whether something is wrong; the next read tells it."""
        if said := session.core.take_problem():
            self._faulty = True
            self._problem = RobotFault(f"{self._name}: {said}{self._codes(session)}", hint=NEXT)

    def _codes(self, session: Session) -> str:
        """What faulty drives say of themselves (603Fh): an EMCY may have been lost."""
        said = []
        for axis in self._samples.faulty if self._samples else ():
            with contextlib.suppress(HilError):
                code = session.acyclic.upload(axis, od.ERROR_CODE)
                said.append(f"{session.acyclic.name_of(axis)} {error_text(code)}")
        return f" (603Fh: {'; '.join(said)})" if said else ""

    def _raise_problem(self) -> None:
        problem, self._problem = self._problem, None
        if problem is not None:
            raise problem

    def _connected(self) -> Session:
        if self._session is None:
            raise RobotConnectionError(
                f"{self._name} is not connected", hint="call connect() first"
            )
        return self._session

    def _healthy(self) -> Session:
        session = self._connected()
        if self._faulty:
            raise RobotFault(f"{self._name} does not obey since a fault", hint=NEXT)
        return session
