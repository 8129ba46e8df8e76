"""Injectable faults of the mock drives, one class each (docs/reference/mock-can-faults.md).

Most faults act on one axis or on all axes: `strike` and `heal` begin and end the fault in one
drive. `bus_off` can act on the master's side of the bus instead.
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
    """Interface to the participants on the master's side of the bus."""

    def bus_off(self) -> None:
        """Put all participants that are present, except the drives, off the bus."""

    def recover(self) -> None:
        """Put all participants except the drives back on the bus."""


class Target(NamedTuple):
    """Parts of the mock on which faults act."""

    station: Station
    master: MasterEnd


def _is_axis(given: Any) -> bool:
    if isinstance(given, str):
        return given in (ALL, MASTER)
    return isinstance(given, int) and not isinstance(given, bool) and 1 <= given <= MOST_AXES


class CanFault(Fault[Target], counted=("motion",), example="{kind: heartbeat_loss, at_s: 2.0}"):
    """Fault of one axis (from 1) or of `all` axes; for `bus_off` also of the `master`."""

    motion: int | None = count(None)
    axis: int | str = choice(2, _is_axis, "a number from 1, all, or master (bus_off only)")

    def require(self, mock: Target, where: str) -> None:
        """See `Fault`."""
        axes = len(mock.station.axes)
        if isinstance(self.axis, int) and self.axis > axes:
            raise CommandRefused(f"{where}: axis is {self.axis}", hint=f"there are {axes} axes")
        if self.axis == MASTER and not isinstance(self, BusOff):
            raise SpecError(f"{where}: axis is master", hint="only bus_off affects the master")

    def axes(self, station: Station) -> tuple[Unit, ...]:
        """Return the drives on which the fault acts."""
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
        """End the fault in one drive."""


class Emergency(CanFault, kind="emergency"):
    """Fault reaction of the drive with a selectable error code."""

    code: int = number(0xFF01, 1, 0xFFFF, "an error code, 0x0001 to 0xFFFF", whole=True)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.fault(self.code)


class FollowingError(CanFault, kind="following_error"):
    """Jump of the set-point out of the following error window."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.slip()


class Overcurrent(CanFault, kind="overcurrent"):
    """Fault of the drive: continuous over-current."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.fault(OVERCURRENT)


class Overheat(CanFault, kind="overheat"):
    """Sudden rise of the motor temperature."""

    celsius: float = number(120.0, -50, 300, "a temperature from −50 to 300 °C")

    def strike(self, unit: Unit, station: Station) -> None:
        station.body.heat(unit.number, self.celsius)


class HeartbeatLoss(CanFault, kind="heartbeat_loss", lasts=True):
    """Loss of the drive's heartbeats."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.mute = True

    def heal(self, unit: Unit) -> None:
        unit.line.mute = False


class NodeReboot(CanFault, kind="node_reboot", lasts=True):
    """Loss of the drive's supply; the drive restarts when the supply is back."""

    for_s: float = 0.5

    def strike(self, unit: Unit, station: Station) -> None:
        unit.power_off()

    def heal(self, unit: Unit) -> None:
        unit.power_on()


class RefusedMode(CanFault, kind="refused_mode", lasts=True):
    """Refusal of all modes: 6061h does not follow 6060h, although 6502h contains the mode."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.operation.refused = set(EVERY_MODE)

    def heal(self, unit: Unit) -> None:
        unit.drive.operation.refused = set()


class Bit12Low(CanFault, kind="bit12_low", lasts=True):
    """Disregard of set-points by the drive, shown by a low bit 12 of the statusword."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.drive.operation.deaf = True

    def heal(self, unit: Unit) -> None:
        unit.drive.operation.deaf = False


class SyncIgnored(CanFault, kind="sync_ignored", lasts=True):
    """Disregard of SYNC by the drive."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.follows_sync = False

    def heal(self, unit: Unit) -> None:
        unit.follows_sync = True


class MappingRefused(CanFault, kind="mapping_refused", lasts=True):
    """Fixed process data of the drive: writes to the PDO mapping are refused."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.refusals[self.kind] = refused_mapping

    def heal(self, unit: Unit) -> None:
        unit.line.refusals.pop(self.kind, None)


class SdoAbort(CanFault, kind="sdo_abort", lasts=True):
    """Abort of all transfers of an object, or of all objects for index 0."""

    index: int = number(0, 0, 0xFFFF, "an index of an object, or 0 for all", whole=True)
    abort: int = number(
        0x0800_0022, 1, 0xFFFF_FFFF, "an abort code, such as 0x06090030", whole=True
    )

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.refusals[self.kind] = refused_object(self.index, self.abort)

    def heal(self, unit: Unit) -> None:
        unit.line.refusals.pop(self.kind, None)


class SdoSilent(CanFault, kind="sdo_silent", lasts=True):
    """Loss of SDO requests."""

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.unheard = True

    def heal(self, unit: Unit) -> None:
        unit.line.unheard = False


class LostFrames(CanFault, kind="lost_frames"):
    """Loss of the next TPDOs of the drive."""

    frames: int = count()

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.owed[self.kind] += self.frames


class LateFrames(CanFault, kind="late_frames", lasts=True):
    """Delay of the drive's TPDOs."""

    by_s: float = seconds(REQUIRED, most=60.0)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.late_steps = round(self.by_s / STEP_S)

    def heal(self, unit: Unit) -> None:
        unit.line.late_steps = 0


class WrongLength(CanFault, kind="wrong_length"):
    """Wrong length of the next TPDOs of the drive."""

    frames: int = count()
    by_bytes: int = number(-1, -8, 8, "a whole number of bytes, −8 to 8", whole=True)

    def strike(self, unit: Unit, station: Station) -> None:
        unit.line.owed[self.kind] += self.frames
        unit.line.by_bytes = self.by_bytes


class BusOff(CanFault, kind="bus_off", lasts=True):
    """Bus-off of a drive's CAN controller, or of all participants on the master's side."""

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
    """Return the fault injection of one mock, with the faults that are planned from the start.

    Raises:
        SpecError: A planned fault is invalid for its axis.
        CommandRefused: A planned fault is for an axis that does not exist.
    """

    def mend() -> None:
        for axis in station.axes:
            axis.line.owed.clear()
            axis.line.look()

    target = Target(station, master)
    return Faults(target, CanFault, STEP_S, planned, stays=NodeReboot.kind, mend=mend)
