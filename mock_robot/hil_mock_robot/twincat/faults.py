"""Faults of the mock PLC, one class each (docs/how-to/drive-twincat.md)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from hil_mock_robot.plant.records import EMERGENCY_STOP, FAULTS
from hil_mock_robot.server.faults import Fault, count, number
from hil_mock_robot.twincat.ads import CONFIG, RUN, Links, PlcHandler
from hil_mock_robot.twincat.program import PlcProgram

DRIVE_FAULT = 0x8611
"""CiA 402's following error, as good as any."""


@dataclass(slots=True)
class Target:
    """The parts of the mock that faults act on.

    Attributes:
        program, handler, links: Parts of the mock.
        stopped: How many faults let the PLC's task stand still, while ADS answers.
        lasting: How many faults of each kind last: the last one to end puts things right.
    """

    program: PlcProgram
    handler: PlcHandler
    links: Links
    stopped: int = 0
    lasting: Counter[str] = field(default_factory=Counter)

    def ends(self, kind: str) -> bool:
        """Count one less of a kind; whether it was the last one."""
        self.lasting[kind] -= 1
        return not self.lasting[kind]


class PlcFault(Fault[Target], counted=("motion",), example="{kind: silence, at_s: 2.0}"):
    """A fault of the PLC or of its arm."""

    motion: int | None = count(None)


def _code(default: int) -> int:
    value: int = number(default, 1, 65535, "a whole number from 1 to 65535", whole=True)
    return value


class _Stopping(PlcFault):
    """The arm comes to rest on its brakes; no client can reset that while the cause lasts."""

    for_s: float = 0.0

    def begin(self, mock: Target) -> None:
        mock.program.fail(*self.code_and_text())
        mock.program.commands.causes += 1

    def end(self, mock: Target) -> None:
        mock.program.commands.causes -= 1

    def code_and_text(self) -> tuple[int, str]:
        """Code and text of the fault."""
        raise NotImplementedError


class DriveFault(_Stopping, kind="drive_fault", lasts=True):
    """A drive fails."""

    code: int = _code(DRIVE_FAULT)

    def code_and_text(self) -> tuple[int, str]:
        return self.code, f"drive fault {self.code:#06x}"


class EmergencyStop(_Stopping, kind="emergency_stop", lasts=True):
    """The red button; until it is turned out again."""

    for_s: float = float("inf")

    def code_and_text(self) -> tuple[int, str]:
        return EMERGENCY_STOP, FAULTS[EMERGENCY_STOP]


class Freeze(PlcFault, kind="freeze", lasts=True):
    """The PLC's task stands still, while ADS answers."""

    def begin(self, mock: Target) -> None:
        mock.stopped += 1

    def end(self, mock: Target) -> None:
        mock.stopped -= 1


class Silence(PlcFault, kind="silence", lasts=True):
    """Requests are left unanswered until it is over."""

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.links.silent = True

    def end(self, mock: Target) -> None:
        mock.links.silent = not mock.ends(self.kind)


class Cut(PlcFault, kind="cut", lasts=True):
    """All connections are closed, and new ones are refused."""

    for_s: float = 0.0

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.links.cut()

    def end(self, mock: Target) -> None:
        if mock.ends(self.kind):
            mock.links.listen()


class Config(Freeze, kind="config", lasts=True):
    """TwinCAT is in config mode: the runtime is not there."""

    def begin(self, mock: Target) -> None:
        super().begin(mock)
        mock.lasting[self.kind] += 1
        mock.handler.state = CONFIG

    def end(self, mock: Target) -> None:
        super().end(mock)
        if mock.ends(self.kind):
            mock.handler.state = RUN


class Restart(PlcFault, kind="restart"):
    """The PLC's program begins anew, as after a reset."""

    def begin(self, mock: Target) -> None:
        mock.program.restart()


class OnlineChange(PlcFault, kind="online_change"):
    """The program is changed while it runs: every variable lies elsewhere."""

    def begin(self, mock: Target) -> None:
        mock.handler.memory.online_change()


class LoseStops(PlcFault, kind="lose_stops", lasts=True):
    """Writes to `nStop` are acknowledged and lost."""

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.handler.loses_stops = True

    def end(self, mock: Target) -> None:
        mock.handler.loses_stops = not mock.ends(self.kind)


class Spoil(PlcFault, kind="spoil", lasts=True):
    """Long writes arrive with one wrong bit."""

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.handler.spoils = True

    def end(self, mock: Target) -> None:
        mock.handler.spoils = not mock.ends(self.kind)


class Refuse(PlcFault, kind="refuse"):
    """The next command is refused with a result."""

    code: int = _code(1)

    def begin(self, mock: Target) -> None:
        mock.program.commands.refuse = self.code
