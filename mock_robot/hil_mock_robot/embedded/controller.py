"""Controller of the embedded robot: faults, rows for the host, and the journal."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import CommandRefused, FloatArray, RobotConnectionError, RobotFault, StructArray
from hil.robot import Segment, Status
from hil_mock_robot.embedded.arm import Arm, Sampling
from hil_mock_robot.embedded.faults import (
    EmbeddedFault,
    EmergencyStop,
    Line,
    ProtectiveStop,
    Refuse,
    Target,
)
from hil_mock_robot.plant.records import FAULT_KINDS, FAULTS
from hil_mock_robot.server.faults import ROUNDING, Fault, Faults
from hil_mock_robot.server.journal import REST_RAD_S, Journal, Moment, RestWatch

BRAKING_AT_MOST_S = 5.0
BRAKING_BLOCK = 16


class Controller:
    """Controller of one robot, for use by one thread at a time.

    Args:
        name: Name of the robot.
        arm: Arm of this controller.
        faults: Planned faults.
        journal: Journal of the robot.
        spacing_s: Wall time between samples [s], 0 on a virtual clock.

    Attributes:
        connected: Whether a host is connected to the controller.
        fault_told: Whether the host has received a row with the current fault.
    """

    def __init__(
        self,
        name: str,
        arm: Arm,
        faults: Sequence[EmbeddedFault],
        journal: Journal,
        spacing_s: float,
    ) -> None:
        self.name, self.arm = name, arm
        self.connected = False
        self.fault_told = False
        self.line = Line()
        self.rest = RestWatch(journal)
        self._journal = journal
        self._sampling = Sampling(arm)
        self._refusals = [fault for fault in faults if isinstance(fault, Refuse)]
        planned = [fault for fault in faults if not isinstance(fault, Refuse)]
        self._faults: Faults[Target] | None = None  # None for most robots
        if planned:
            self._faults = self._faults_of(planned)
        self._spacing_s = spacing_s

    @property
    def samples(self) -> int:
        """Number of samples since power-on."""
        return self.arm.on.samples

    @property
    def still(self) -> bool:
        """Whether the arm is known to be at rest, or cannot move any more."""
        arm = self.arm
        if arm.dead or arm.locked or self.rest.resting:
            return True
        return not (self.rest.waiting or arm.moving) and arm.fastest < REST_RAD_S

    def require_connection(self) -> None:
        """Raise if no host can use the controller.

        Raises:
            RobotConnectionError: The robot is not connected, or the line is cut.
        """
        if not self.connected:
            raise RobotConnectionError(
                f"mock robot {self.name} is not connected", hint="call connect() first"
            )
        if self.line.cut:
            raise RobotConnectionError(
                f"mock robot {self.name}: the line is cut",
                hint="call close() and connect() again",
            )

    def connect(self) -> None:
        """Connect a host with a new line and without line faults."""
        self.connected, self.fault_told = True, False
        self.line.mend()
        if self._faults:
            self._faults.mend()

    def disconnect(self) -> None:
        """Disconnect the host."""
        self.rest.finish()
        self.connected = False

    def strike(self, fault: EmbeddedFault) -> None:
        """Add an unplanned fault; a due fault begins with the next row."""
        if isinstance(fault, Refuse):
            self._refusals.append(fault)
        elif self._faults is None:
            self._faults = self._faults_of([fault])
        else:
            self._faults.plan(fault)

    def clear(self) -> None:
        """End faults of the line, and discard the faults that are planned."""
        self._refusals = []
        if self._faults:
            self._faults.clear()

    def prepare(self, segment: Segment) -> None:
        """Check and store the next segment.

        Raises:
            CommandRefused: There is a fault, the segment is invalid, or a refusal was injected.
        """
        self._require_no_fault()
        if self._refuses(segment.index):
            self.note("fault", kind="refuse", segment=segment.index)
            raise CommandRefused(
                f"segment {segment.index} ({segment.kind}): refused by an injected fault",
                hint="remove the refusal from the mock's option faults",
            )
        self.arm.motion.prepare(segment)

    def start(self) -> None:
        """Begin the prepared segment with the next sample.

        Raises:
            CommandRefused: There is a fault, no segment is prepared, or a segment is running.
        """
        self._require_no_fault()
        self.arm.motion.start()
        self.rest.moved()
        if self._faults:
            self._faults.began("segment", self.arm.motion.segment, at=self.samples)

    def set_payload(self, payload: Payload) -> None:
        """Declare a payload; see `Arm.set_payload`."""
        self._require_no_fault()
        self.arm.set_payload(payload)

    def command_torque(self, torque: FloatArray | None) -> None:
        """Command joint torques; see `Arm.command_torque`."""
        self.arm.command_torque(torque)
        if torque is not None:
            self.rest.moved()

    def brake(self, cause: str, at: Moment) -> None:
        """Decelerate the arm to rest; if there is a cause, observe the arm until it is at rest."""
        self.arm.brake()
        if cause:
            self.rest.stopped(cause, at)

    def trip(self, fault: int) -> None:
        """Stop because of a fault of the controller (a code of `FAULTS`)."""
        if self.arm.fault:
            return
        kind, at = FAULT_KINDS[fault], self.moment()
        self.note("fault", at, kind=kind, code=fault)
        self.rest.stopped(kind, at)
        self.arm.trip(fault)

    def fault_error(self) -> RobotFault:
        """Return the error for the current fault."""
        return RobotFault(
            f"{self.name}: {FAULTS[self.arm.fault]}", hint="find the cause, then reconnect"
        )

    def produce(self, most: int) -> StructArray:
        """Advance device time by up to `most` samples; return the rows for the host."""
        if self._faults:
            # A block ends before the next fault begins or ends, so faults apply to whole blocks.
            self._faults.reach(self.samples + 1)
            most = self._faults.unchanged(most)
        before = self.arm.fault
        rows = self._sampling.advance(most)
        if self._spacing_s:
            rows["host_time"] = time.time() - self._spacing_s * np.arange(len(rows))[::-1]
        if self.arm.fault != before:
            self._note_failure()
        if self.rest.waiting:
            now = time.monotonic()
            self.rest.see(rows["device_time"], self._sampling.qd, now, self._spacing_s)
        return self.line.carry(rows, self.arm.device_time) if self._faults else rows

    def hand_over(self, rows: StructArray) -> StructArray:
        """Record whether rows contain a fault, and return the rows for the host."""
        self.fault_told = self.fault_told or bool((rows["status"] & int(Status.FAULT)).any())
        return rows

    def come_to_rest(self) -> None:
        """Advance device time until the arm is at rest; needed on a virtual clock."""
        end = self.arm.device_time + BRAKING_AT_MOST_S
        while not self.still and self.arm.device_time < end:
            self.produce(BRAKING_BLOCK)

    def moment(self, monotonic_s: float | None = None) -> Moment:
        """Return the current time and speed, or those of an earlier monotonic time."""
        now = time.monotonic() if monotonic_s is None else monotonic_s
        return Moment(now, self.arm.device_time, self.arm.fastest)

    def note(self, event: str, at: Moment | None = None, **details: Any) -> None:
        """Write a line to the journal."""
        self._journal.note(event, at or self.moment(), **details)

    def _require_no_fault(self) -> None:
        if self.arm.fault:
            raise CommandRefused(
                f"{self.name}: {FAULTS[self.arm.fault]}", hint="find the cause, then reconnect"
            )

    def _faults_of(self, planned: Sequence[EmbeddedFault]) -> Faults[Target]:
        faults: Faults[Target] = Faults(
            self, EmbeddedFault, 1.0 / self.arm.rate_hz, planned, mend=self.line.mend
        )
        faults.listeners.append(self._struck)
        return faults

    def _struck(self, fault: Fault[Target], begins: bool) -> None:
        """Write an injected fault to the journal, except stops, which `trip` writes."""
        if not isinstance(fault, ProtectiveStop | EmergencyStop):
            self.note("fault" if begins else "fault_over", kind=fault.kind)

    def _refuses(self, segment: int) -> bool:
        """Return whether to refuse the next segment; each injected refusal applies once."""
        now_s = self.samples / self.arm.rate_hz
        for fault in self._refusals:
            due = fault.at_s is not None and now_s >= fault.at_s - ROUNDING / self.arm.rate_hz
            if due or fault.segment == segment:
                self._refusals.remove(fault)
                return True
        return False

    def _note_failure(self) -> None:
        """Write a fault of the simulation, after which the brakes were closed, to the journal."""
        code, at = self.arm.fault, self.moment()
        self.note("fault", at, kind=FAULT_KINDS[code], code=code)
        if self.arm.locked and not self.arm.dead:
            self.rest.locked(FAULT_KINDS[code], at)
