"""The primary and secondary interface: the robot state at 10 Hz, messages, programs in."""

from __future__ import annotations

from hil_mock_robot.arm import FAULTS, PROTECTIVE_STOP, RUNAWAY
from hil_mock_robot.ur.contracts import Link
from hil_mock_robot.ur.inbox import ScriptInbox
from hil_mock_robot.ur.machine import Event, Machine
from hil_mock_robot.ur.primary_messages import (
    Level,
    error_message,
    exception_message,
    greeting,
    key_message,
    popup_message,
    safety_mode_message,
    text_message,
)
from hil_mock_robot.ur.primary_state import state_packet

PRIMARY, SECONDARY = 30001, 30002
RATE_HZ = 10
MOST_PENDING = 200_000
"""Bytes that wait for a client that does not read; messages are dropped whole beyond that."""

OWN_CODES = 10
"""Below that, a code is one of `hil_mock_robot.arm.FAULTS`; from there on it is UR's own C…."""

ERROR_CODES = {1: 153, 2: 157, RUNAWAY: 153, PROTECTIVE_STOP: 158}
"""Fault → C153: position deviates from path, C157: a joint collides, C158: the arm does."""


class PrimaryService:
    """Port 30001 tells everything, port 30002 only the state.

    Args:
        machine: The controller.
        port: 30001 or 30002.

    Attributes:
        port: TCP port.
        sessions: Clients that are connected.
    """

    def __init__(self, machine: Machine, port: int = PRIMARY) -> None:
        self.machine, self.port = machine, port
        self.sessions: list[PrimarySession] = []
        self._safety = machine.modes.safety
        if port == PRIMARY:
            machine.listeners.append(self._heard)

    def accept(self, link: Link) -> PrimarySession:
        """Tell a client the version; states follow."""
        if not self.sessions:
            self._safety = self.machine.modes.safety
        session = PrimarySession(self, link)
        self.sessions.append(session)
        return session

    def watch_safety(self) -> None:
        """Tell when the safety mode has changed since the last tick."""
        safety = self.machine.modes.safety
        if safety is not self._safety:
            self._safety = safety
            if self.port == PRIMARY:
                self._tell(safety_mode_message(int(safety), self.machine.now_s))

    def _heard(self, event: Event) -> None:
        for each in messages_of(event, self.machine.now_s):
            self._tell(each)

    def _tell(self, message: bytes) -> None:
        for session in list(self.sessions):
            session.tell(message)


class PrimarySession:
    """One client.

    Args:
        service: What it is connected to.
        link: The connection.
    """

    lossless = False

    def __init__(self, service: PrimaryService, link: Link) -> None:
        self._service, self._link = service, link
        self._inbox = ScriptInbox(service.machine)
        self._sent = -1
        link.send(greeting(service.machine.series))
        self._publish()

    def received(self, data: bytes) -> None:
        """See `Session`: a piece of a program."""
        self._inbox.feed(data)

    def ticked(self) -> None:
        """See `Session`."""
        self._service.watch_safety()
        self._publish()

    def hung_up(self) -> None:
        """See `Session`."""
        self._service.sessions.remove(self)

    def tell(self, message: bytes) -> None:
        """Send a message, unless the client reads nothing."""
        if not self._link.closed and self._link.pending < MOST_PENDING:
            self._link.send(message)

    def _publish(self) -> None:
        """Send the state when one is due and the last one is out."""
        machine = self._service.machine
        due = machine.ticks * RATE_HZ // round(machine.series.rate_hz)
        if due != self._sent and not self._link.pending:
            self._sent = due
            self._link.send(state_packet(machine))


def messages_of(event: Event, now_s: float) -> list[bytes]:
    """What a primary client is told of an event."""
    kind, name, text = event.kind, event.name, event.text
    if kind == "program_started":
        return [key_message("PROGRAM_XXX_STARTED", name, now_s)]
    if kind == "program_stopped":
        return [key_message("PROGRAM_XXX_STOPPED", name, now_s)]
    if kind == "popup":
        return [popup_message(name, text, now_s)]
    if kind == "error":
        return _error_messages(event, now_s)
    if kind in ("protective_stop", "fault"):
        code = event.code if event.code >= OWN_CODES else ERROR_CODES.get(event.code, 0)
        level = Level.FAULT if kind == "fault" else Level.VIOLATION
        return [error_message(code, level, text or FAULTS.get(event.code, kind), now_s)]
    if kind in ("text", "watchdog", "refused"):
        return [text_message(text or kind, now_s)]
    return []


def _error_messages(event: Event, now_s: float) -> list[bytes]:
    """A runtime exception; where the controller has a word for it, a line for the log explains."""
    place = event.place
    told = [exception_message(place.token or event.text, now_s, place.line, place.column)]
    if place.token:
        told.append(text_message(event.text, now_s))
    if event.code:
        told.append(error_message(event.code, Level.FAULT, event.text, now_s))
    return told
