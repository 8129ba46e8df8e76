"""The dashboard server: one line in, one line out (port 29999)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from hil_mock_robot.ur.contracts import Link, Program
from hil_mock_robot.ur.dashboard_commands import command_of
from hil_mock_robot.ur.disk import disk_of
from hil_mock_robot.ur.machine import Event, Machine
from hil_mock_robot.ur.pendant import Pendant

GREETING = "Connected: Universal Robots Dashboard Server"
REFUSED = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)
LONGEST_LINE = 4096
"""Bytes; nobody means more than that, and nothing is kept of it."""

MOST_PENDING = 64_000
"""Bytes of replies that nobody reads; the client is hung up on beyond that."""


class DashboardService:
    """Answers what a pendant would be used for.

    Args:
        machine: The controller.
        programs: File name → what makes that program, for files that do more than idle; those of
            `disk.py` when None.

    Attributes:
        port: TCP port.
        pendant: What the answers are about.
    """

    port = 29999

    def __init__(
        self, machine: Machine, programs: Mapping[str, Callable[[], Program]] | None = None
    ) -> None:
        self.pendant = Pendant(machine, disk_of(machine) if programs is None else programs)
        machine.listeners.append(self._heard)

    def accept(self, link: Link) -> DashboardSession:
        """Greet a client."""
        return DashboardSession(self.pendant, link)

    def _heard(self, event: Event) -> None:
        if event.kind == "booted":
            self.pendant.forget()


class DashboardSession:
    """One client's lines.

    Args:
        pendant: What the answers are about.
        link: The connection.
    """

    lossless = False

    def __init__(self, pendant: Pendant, link: Link) -> None:
        self._pendant, self._link = pendant, link
        self._waiting = bytearray()
        self._skipping = False
        self._say(GREETING)

    def received(self, data: bytes) -> None:
        """See `Session`: every complete line gets its reply, in order."""
        self._waiting += data
        while not self._link.closed and (end := self._waiting.find(b"\n")) >= 0:
            line = bytes(self._waiting[:end])
            del self._waiting[: end + 1]
            if not self._skipping:
                self._answer(line)
            self._skipping = False
        if len(self._waiting) > LONGEST_LINE:
            self._waiting.clear()
            if not self._skipping:
                self._say("could not understand: a line that does not end")
            self._skipping = True

    def ticked(self) -> None:
        """See `Session`: nothing is due."""

    def hung_up(self) -> None:
        """See `Session`."""

    def _answer(self, raw: bytes) -> None:
        line = raw.decode("utf-8", "replace").strip()
        if not line:
            return
        if line.lower() == "quit":
            self._say("Disconnected")
            self._link.close()
            return
        machine = self._pendant.machine
        found = command_of(line, machine.series)
        if found is None:
            self._say(f"could not understand: {line}")
            return
        command, argument = found
        local = machine.series.is_e and not machine.modes.remote
        self._say(REFUSED if local and command.remote else command.reply(self._pendant, argument))

    def _say(self, text: str) -> None:
        if self._link.pending > MOST_PENDING:
            self._link.close()
        else:
            self._link.send(text.encode() + b"\n")
