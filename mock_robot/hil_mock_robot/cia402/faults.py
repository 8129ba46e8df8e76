"""Faults of the mock drives, one class each (docs/reference/mock-can-faults.md).

Most strike one axis or all of them: their `strike` and `heal` see one drive. `bus_off` can strike
the master's end of the bus instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from hil.core import CommandRefused, SpecError
from hil_mock_robot.cia402.body import STEP_S
from hil_mock_robot.cia402.bus import refused_mapping, refused_object
from hil_mock_robot.cia402.station import Station, Unit
from hil_mock_robot.server.faults import REQUIRED, Fault, Faults, choice, count, number, seconds

ALL, MASTER = "all", "master"
MOST_AXES = 16
OVERCURRENT = 0x2310
EVERY_MODE = frozenset(range(-128, 128))


class MasterEnd(Protocol):
    """The other end of the bus."""

    def bus_off(self) -> None:
        """Put everybody who is on the bus now, but the drives, off it."""

    def recover(self) -> None:
        """Let the drives back onto the bus."""


class Target(NamedTuple):
    """The parts of the mock that faults act on."""

    station: Station
    master: MasterEnd


def _is_axis(given: Any) -> bool:
    if isinstance(given, str):
        return given in (ALL, MASTER)
    return isinstance(given, int) and not isinstance(given, bool) and 1 <= given <= MOST_AXES


class CanFault(Fault[Target], counted=("motion",), example="{kind: heartbeat_loss, at_s: 2.0}"):
    """A fault of one axis, counted from 1, or of `all`; of the `master` for `bus_off` only."""

    motion: int | None = count(None)
    axis: int | str = choice(2, _is_axis, "a number from 1, all, or master (bus_off only)")

    def require(self, mock: Target, where: str) -> None:
        """See `Fault`."""
        axes = len(mock.station.axes)
        if isinstance(self.axis, int) and self.axis > axes:
            raise CommandRefused(f"{where}: axis is {self.axis}", hint=f"there are {axes} axes")
        if self.axis == MASTER and not isinstance(self, BusOff):
            raise SpecError(f"{where}: axis is master", hint="only bus_off strikes the master")

    def axes(self, station: Station) -> tuple[Unit, ...]:
        """The drives that it strikes."""
        if isinstance(self.axis, int):
            return station.axes[self.axis - 1 : self.axis]
        return station.axes if self.axis == ALL else ()

    def begin(self, mock: Target) -> None:
        """See `Fault`."""
        for unit in self.axes(mock.station):
            self.strike(unit, mock.station)
            unit.line.look()

    def end(self, mock: Target) -> None:
        """See `Fault`."""
        for unit in self.axes(mock.station):
            self.heal(unit)
            unit.line.look()

    def strike(self, unit: Unit, station: Station) -> None:
        """Begin the fault in one drive."""

    def heal(self, unit: Unit) -> None:
        """One drive has it no longer."""


class Emergency(CanFault, kind="emergency"):
    """The drive fails with an error code of its own."""

    code: int = number(0xFF01, 1, 0xFFFF, "an error code, 0x0001 to 0xFFFF", whole=True)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.fault(self.code)


class FollowingError(CanFault, kind="following_error"):
    """The set-point jumps out of the window around the joint."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.slip()


class Overcurrent(CanFault, kind="overcurrent"):
    """The drive fails with continuous over-current."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.fault(OVERCURRENT)


class Overheat(CanFault, kind="overheat"):
    """The motor is hot at once."""

    celsius: float = number(120.0, -50, 300, "a temperature from −50 to 300 °C")

    def strike(self, unit: Unit, station: Station) -> None:
        station.body.heat(unit.number, self.celsius)


class HeartbeatLoss(CanFault, kind="heartbeat_loss", lasts=True):
    """Its heartbeats are lost."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.mute = True

    def heal(self, unit: Unit) -> None:
        unit.line.mute = False


class NodeReboot(CanFault, kind="node_reboot", lasts=True):
    """The drive loses its supply, and starts anew when it is back."""

    for_s: float = 0.5

    def strike(self, unit: Unit, station: Station) -> None:
        unit.power_off()

    def heal(self, unit: Unit) -> None:
        unit.power_on()


class RefusedMode(CanFault, kind="refused_mode", lasts=True):
    """6061h does not follow 6060h, though 6502h has the mode."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.operation.refused = set(EVERY_MODE)

    def heal(self, unit: Unit) -> None:
        unit.drive.operation.refused = set()


class Bit12Low(CanFault, kind="bit12_low", lasts=True):
    """The drive ignores its set-points and shows that by bit 12 of the statusword."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.operation.deaf = True

    def heal(self, unit: Unit) -> None:
        unit.drive.operation.deaf = False


class SyncIgnored(CanFault, kind="sync_ignored", lasts=True):
    """The drive takes no notice of SYNC."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.follows_sync = False

    def heal(self, unit: Unit) -> None:
        unit.follows_sync = True


class MappingRefused(CanFault, kind="mapping_refused", lasts=True):
    """The drive's process data is laid out for good."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.refusals[self.kind] = refused_mapping

    def heal(self, unit: Unit) -> None:
        unit.line.refusals.pop(self.kind, None)


class SdoAbort(CanFault, kind="sdo_abort", lasts=True):
    """Transfers of an object, or of all for 0, end with an abort code."""

    index: int = number(0, 0, 0xFFFF, "an index of an object, or 0 for all", whole=True)
    abort: int = number(
        0x0800_0022, 1, 0xFFFF_FFFF, "an abort code, such as 0x06090030", whole=True
    )

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.refusals[self.kind] = refused_object(self.index, self.abort)

    def heal(self, unit: Unit) -> None:
        unit.line.refusals.pop(self.kind, None)


class SdoSilent(CanFault, kind="sdo_silent", lasts=True):
    """SDO requests are lost."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.unheard = True

    def heal(self, unit: Unit) -> None:
        unit.line.unheard = False


class LostFrames(CanFault, kind="lost_frames"):
    """The next TPDOs of the drive are lost."""

    frames: int = count()

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.owed[self.kind] += self.frames


class LateFrames(CanFault, kind="late_frames", lasts=True):
    """TPDOs come late."""

    by_s: float = seconds(REQUIRED, most=60.0)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.late_steps = round(self.by_s / STEP_S)

    def heal(self, unit: Unit) -> None:
        unit.line.late_steps = 0


class WrongLength(CanFault, kind="wrong_length"):
    """The next TPDOs of the drive are too short or too long."""

    frames: int = count()
    by_bytes: int = number(-1, -8, 8, "a whole number of bytes, −8 to 8", whole=True)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.owed[self.kind] += self.frames
        unit.line.by_bytes = self.by_bytes


class BusOff(CanFault, kind="bus_off", lasts=True):
    """A CAN controller gives up: that of a drive, or everybody's at the master's end."""

    def begin(self, mock: Target) -> None:
        if self.axis == MASTER:
            mock.master.bus_off()
        super().begin(mock)

    def end(self, mock: Target) -> None:
        if self.axis == MASTER:
            mock.master.recover()
        super().end(mock)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.bus_off()

    def heal(self, unit: Unit) -> None:
        unit.recover()


def faults_of_station(
    station: Station, master: MasterEnd, planned: Sequence[CanFault] = ()
) -> Faults[Target]:
    """The faults of one mock, under way.

    Raises:
        SpecError, CommandRefused: A planned fault is for an axis that it lacks.
    """

    def mend() -> None:
        for axis in station.axes:
            axis.line.owed.clear()
            axis.line.look()

    target = Target(station, master)
    return Faults(target, CanFault, STEP_S, planned, stays=NodeReboot.kind, mend=mend)
