"""Journal of the mock controller: received commands, faults, and times of rest."""

from __future__ import annotations

import re
import time
from typing import Any

import numpy as np

from hil_mock_robot.server import journal
from hil_mock_robot.server.journal import Journal, Moment
from hil_mock_robot.ur.connections import TcpLink
from hil_mock_robot.ur.machine import Event, Machine
from hil_mock_robot.ur.pacing import Slip

NAMES = {
    1: "movej", 2: "movej_ik", 3: "movel", 4: "movel_fk", 6: "force_mode", 9: "speedj",
    10: "speedl", 11: "servoj", 12: "servoc", 15: "speed_stop", 16: "servo_stop",
    17: "set_payload", 24: "servol", 33: "stopl", 34: "stopj", 35: "set_watchdog",
    41: "jog_start", 42: "jog_stop", 45: "move_path", 51: "move_until_contact",
    65: "set_target_payload", 66: "direct_torque", 255: "stop_script",
}  # fmt: skip
"""Map from command number of the control script to name in the journal; other commands appear as
numbers."""

MOVES = frozenset({1, 2, 3, 4, 6, 9, 10, 11, 12, 24, 41, 45, 51, 66})
STOPS = frozenset({15, 16, 33, 34, 42, 255})
COMMAND_INPUTS = ("input_int_register_0", "input_int_register_24")
DASHBOARD, SCRIPTS = 29999, (30001, 30002, 30003)
DASHBOARD_STOPS = ("stop", "pause", "power off", "shutdown")
END = re.compile(rb"^end\s*$", re.MULTILINE)
MOVING = re.compile(rb"\b(?:move[jlpc]|servo[jlc]|speed[jl])\s*\(")
STOPPING = re.compile(rb"\bstop[jl]\s*\(")
NAMED = re.compile(rb"^\s*(?:def|sec)\s+(\w+)", re.MULTILINE)
CONTROL = b"rtde_control"
LONGEST_SCRIPT = 1_000_000
SAFETY_FAULT = {"fault": "safety_fault"}
"""Journal name of a fault of the safety system; `fault` is the name of an injected fault."""

TOLD = ("program_started", "program_stopped", "protective_stop", "emergency_stop", "watchdog",
        "safeguard_stop", "error", "refused", "fault", "power_cut", "booted")  # fmt: skip
STOPPING_EVENTS = ("program_stopped", "protective_stop", "emergency_stop", "watchdog", "fault",
                   "safeguard_stop")  # fmt: skip


class Witness(journal.Witness):
    """Writer of the journal of a UR controller.

    Args:
        machine: Controller whose events are written.
        journal: Journal to write.

    Attributes:
        sent: Number of motion commands and set-points received over RTDE.
    """

    def __init__(self, machine: Machine, journal: Journal) -> None:
        super().__init__(journal)
        self._machine = machine
        self._command = 0
        self._scripts: dict[TcpLink, bytes] = {}
        self.sent = 0
        machine.listeners.append(self.happened)
        machine.mishaps.listeners.append(self.stumbled)
        for name in COMMAND_INPUTS:
            machine.watches[name] = self.commanded

    def moment(self) -> Moment:
        """Return the present times and the speed of the arm; see `server.journal.Witness`."""
        machine = self._machine
        fastest = float(np.abs(machine.reading.true_qd).max())
        return Moment(time.monotonic(), machine.now_s, fastest)

    def connected(self, link: TcpLink) -> None:
        """Write to the journal that a client has connected."""
        self.note("connect", port=link.port, peer=link.peer)

    def disconnected(self, link: TcpLink) -> None:
        """Write to the journal that a client has disconnected."""
        self._scripts.pop(link, None)
        self.note("disconnect", port=link.port, peer=link.peer)

    def commanded(self, number: int) -> None:
        """Write a change of the command register; repeated commands until a stop give one line."""
        self.sent += number in MOVES
        if number == self._command:
            return
        self._command = number
        if number == 0:
            return
        playing = self._machine.program is not None
        name = NAMES.get(number, str(number))
        if number in STOPS:
            self._stopped(name, via="rtde", playing=playing)
        elif number in MOVES:
            self._started(name, via="rtde", playing=playing)
        else:
            self.note("command", by=name, via="rtde", playing=playing)

    def received(self, link: TcpLink, data: bytes) -> None:
        """Write the dashboard commands and scripts in received bytes to the journal."""
        if link.port == DASHBOARD:
            for line in data.decode("utf-8", "replace").splitlines():
                self._dashboard(line.strip().lower())
        elif link.port in SCRIPTS:
            text = (self._scripts.get(link, b"") + data)[-LONGEST_SCRIPT:]
            whole = END.search(text) is not None or not NAMED.search(text)
            self._scripts[link] = b"" if whole else text
            if whole and text.strip():
                self._script(text)

    def happened(self, event: Event) -> None:
        """Write an event of the machine to the journal."""
        if event.kind not in TOLD:
            return
        details = {"name": event.name, "text": event.text, "code": event.code}
        kind = SAFETY_FAULT.get(event.kind, event.kind)
        self.note(kind, **{key: value for key, value in details.items() if value})
        if event.kind == "power_cut":
            self._rest.locked(event.kind, self.moment())
        elif event.kind in STOPPING_EVENTS:
            self._command = 0
            self._rest.stopped(kind, self.moment())

    def slipped(self, slip: Slip) -> None:
        """Write that the computer could not keep the pace of the controller's clock."""
        self.note("slip", behind_s=round(slip.behind_s, 6), pace=round(slip.pace, 3))

    def ticked(self) -> None:
        """Check after a tick whether a stopped arm has come to rest."""
        if self._rest.waiting:
            machine = self._machine
            speed = machine.reading.true_qd[None]
            now = np.array([machine.now_s])
            self._rest.see(now, speed, time.monotonic(), 0.0)

    def _dashboard(self, line: str) -> None:
        if line in DASHBOARD_STOPS:
            self._stopped(line, via="dashboard")
        elif line:
            self.note("dashboard", by=line)

    def _script(self, text: bytes) -> None:
        found = NAMED.search(text)
        name = found[1].decode() if found else "line"
        details: dict[str, Any] = {"via": "script", "bytes": len(text)}
        if name.encode() == CONTROL:
            self.note("program", by=name, **details)
        elif MOVING.search(text):
            self._started(name, **details)
        elif STOPPING.search(text):
            self._stopped(name, **details)
        else:
            self.note("program", by=name, **details)

    def _started(self, by: str, **details: Any) -> None:
        self._rest.moved()
        self.note("start", by=by, **details)

    def _stopped(self, by: str, **details: Any) -> None:
        # After a stop from a different interface, the next streamed set-point counts as a new
        # command.
        if details.get("via") != "rtde":
            self._command = 0
        self.note("stop", by=by, moving=self._machine.motion is not None, **details)
        self._rest.stopped(by, self.moment())
