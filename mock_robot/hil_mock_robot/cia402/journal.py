"""Journal of the mock drives, with states, faults, motions, and times of coming to rest."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.body import STEP_S
from hil_mock_robot.cia402.faults import CanFault
from hil_mock_robot.cia402.power import FAULTED, Command, State, command_of
from hil_mock_robot.cia402.station import MotionWatch, Station
from hil_mock_robot.server import journal
from hil_mock_robot.server.faults import Fault
from hil_mock_robot.server.journal import Journal, Moment

ENABLED = State.OPERATION_ENABLED
HEXADECIMAL = ("emergency", "connection_lost")


class Witness(journal.Witness):
    """Writer of the journal of the mock drives.

    Args:
        station: Mock station whose events are recorded.
        motions: Detector of the arm's motions.
        journal: Journal to which events are written.
    """

    def __init__(self, station: Station, motions: MotionWatch, journal: Journal) -> None:
        super().__init__(journal)
        self._station, self._motions = station, motions
        self._states = [axis.drive.state for axis in station.axes]
        station.listeners.append(self.happened)
        motions.listeners.append(self.moved)

    def moment(self) -> Moment:
        """Return the time and state for a journal entry; see `server.journal.Witness`."""
        return Moment(time.monotonic(), self._station.clock.device_s, self._station.body.fastest)

    def struck(self, fault: Fault[Any], begins: bool) -> None:
        """Record the beginning or end of an injected fault; see `server.journal.Witness`."""
        axis = fault.axis if isinstance(fault, CanFault) else 0
        self.note("fault" if begins else "fault_over", kind=fault.kind, axis=axis)

    def happened(self, event: str, details: dict[str, int | float | str]) -> None:
        """Write an event of a drive to the journal."""
        noted: dict[str, Any] = dict(details)
        if event in HEXADECIMAL:
            noted["code"] = f"{int(details['code']):04X}"
        self.note(event, **noted)

    def moved(self, begins: bool) -> None:
        """Write to the journal that a motion begins or ends."""
        marker = self._station.marker
        segment = {"segment": marker.segment} if marker.known else {}
        if begins:
            self._rest.moved()
            self.note("start", **segment)
        else:
            self.note("motion_over", **segment)
            self._rest.stopped("motion_over", self.moment())

    def passed(self, steps: int) -> None:
        """Record changes of state during the last steps, and whether the arm is at rest."""
        states = [axis.drive.state for axis in self._station.axes]
        if states != self._states:
            before, self._states = self._states, states
            self._changed(before, states)
        if self._rest.waiting:
            speeds = np.array([[seen.true_qd for seen in self._station.body.seen]])
            now = np.array([self._station.clock.device_s])
            self._rest.see(now, speeds, time.monotonic(), STEP_S)

    def _changed(self, before: list[State], after: list[State]) -> None:
        changes: dict[tuple[str, str], list[int]] = {}
        for axis, old, new in zip(self._station.axes, before, after, strict=True):
            if event_and_cause := _event_of(old, new, axis.registers[keys.CONTROLWORD]):
                changes.setdefault(event_and_cause, []).append(axis.number + 1)
        for (event, by), axes in changes.items():
            if event == "stop":
                self.note(event, by=by, axes=axes, moving=self._motions.moving)
                self._rest.stopped(by, self.moment())
            else:
                self.note(event, axes=axes)


def _event_of(old: State, new: State, controlword: int) -> tuple[str, str] | None:
    """Return event and cause of a change of state; None if the change is not recorded."""
    if old is new:
        return None
    if new is ENABLED:
        return "enable", ""
    quick = new is State.QUICK_STOP_ACTIVE or command_of(controlword, 0) is Command.QUICK_STOP
    if new in FAULTED:
        return None if old in FAULTED else ("stop", "fault")
    if old is ENABLED:
        return "stop", "quick stop" if quick else "disable"
    return ("disable", "") if old is State.QUICK_STOP_ACTIVE else None
