"""Faults of the mock PLC, one class each (docs/how-to/drive-twincat.md)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from hil_mock_robot.plant.records import EMERGENCY_STOP, FAULTS
from hil_mock_robot.server.faults import Fault, count, number
from hil_mock_robot.twincat.ads import CONFIG, RUN, Links, PlcHandler
from hil_mock_robot.twincat.program import PlcProgram

DRIVE_FAULT = 0x8611
"""Default code of a drive fault: the code for a following error in CiA 402."""


@dataclass(slots=True)
class Target:
    """Parts of the mock on which faults act.

    Attributes:
        program, handler, links: PLC program, ADS handler and connections of the mock.
        stopped: Number of active faults that stop the PLC task while ADS still answers.
        lasting: Map from kind to the number of active faults of this kind; the effect ends with the
            last of these faults.
    """

    program: PlcProgram
    handler: PlcHandler
    links: Links
    stopped: int = 0
    lasting: Counter[str] = field(default_factory=Counter)

    def ends(self, kind: str) -> bool:
        """Decrement the number of active faults of a kind; return whether none of them is left."""
        self.lasting[kind] -= 1
        return not self.lasting[kind]


class PlcFault(Fault[Target], counted=("motion",), example="{kind: silence, at_s: 2.0}"):
    """Fault of the PLC, of its arm or of its connections."""

    motion: int | None = count(None)


def _code(default: int) -> int:
    value: int = number(default, 1, 65535, "a whole number from 1 to 65535", whole=True)
    return value


class _Stopping(PlcFault):
    """Fault that stops the arm and closes its brakes.

    No client can reset the fault while its cause lasts.
    """

    for_s: float = 0.0

    def begin(self, mock: Target) -> None:
        mock.program.fail(*self.code_and_text())
        mock.program.commands.causes += 1

    def end(self, mock: Target) -> None:
        mock.program.commands.causes -= 1

    def code_and_text(self) -> tuple[int, str]:
        """Return code and text of the fault."""
        raise NotImplementedError


class DriveFault(_Stopping, kind="drive_fault", lasts=True):
    """Fault of a drive."""

    code: int = _code(DRIVE_FAULT)

    def code_and_text(self) -> tuple[int, str]:
        return self.code, f"drive fault {self.code:#06x}"


class EmergencyStop(_Stopping, kind="emergency_stop", lasts=True):
    """Emergency stop by its button, until the button is released."""

    for_s: float = float("inf")

    def code_and_text(self) -> tuple[int, str]:
        return EMERGENCY_STOP, FAULTS[EMERGENCY_STOP]


class Freeze(PlcFault, kind="freeze", lasts=True):
    """Stop of the PLC task, while the ADS server still answers."""

    def begin(self, mock: Target) -> None:
        mock.stopped += 1

    def end(self, mock: Target) -> None:
        mock.stopped -= 1


class Silence(PlcFault, kind="silence", lasts=True):
    """Missing answers to all requests until the fault ends."""

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.links.silent = True

    def end(self, mock: Target) -> None:
        mock.links.silent = not mock.ends(self.kind)


class Cut(PlcFault, kind="cut", lasts=True):
    """Disconnection of all clients; new connections are refused."""

    for_s: float = 0.0

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.links.cut()

    def end(self, mock: Target) -> None:
        if mock.ends(self.kind):
            mock.links.listen()


class Config(Freeze, kind="config", lasts=True):
    """Change of TwinCAT to config mode, in which the PLC runtime does not answer."""

    def begin(self, mock: Target) -> None:
        super().begin(mock)
        mock.lasting[self.kind] += 1
        mock.handler.state = CONFIG

    def end(self, mock: Target) -> None:
        super().end(mock)
        if mock.ends(self.kind):
            mock.handler.state = RUN


class Restart(PlcFault, kind="restart"):
    """Restart of the PLC program, as after a reset."""

    def begin(self, mock: Target) -> None:
        mock.program.restart()


class OnlineChange(PlcFault, kind="online_change"):
    """Online change of the PLC program, after which every variable has a different address."""

    def begin(self, mock: Target) -> None:
        mock.handler.memory.online_change()


class LoseStops(PlcFault, kind="lose_stops", lasts=True):
    """Loss of writes to `nStop`, which are acknowledged but not executed."""

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.handler.loses_stops = True

    def end(self, mock: Target) -> None:
        mock.handler.loses_stops = not mock.ends(self.kind)


class Spoil(PlcFault, kind="spoil", lasts=True):
    """Corruption of one bit in every long write."""

    def begin(self, mock: Target) -> None:
        mock.lasting[self.kind] += 1
        mock.handler.spoils = True

    def end(self, mock: Target) -> None:
        mock.handler.spoils = not mock.ends(self.kind)


class Refuse(PlcFault, kind="refuse"):
    """Refusal of the next command with a result code."""

    code: int = _code(1)

    def begin(self, mock: Target) -> None:
        mock.program.commands.refuse = self.code
