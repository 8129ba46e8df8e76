"""Lets faults strike the drives, their lines and the bus, and end again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from hil.core import CommandRefused, SpecError
from hil_mock_robot.cia402.bus import refused_mapping, refused_object
from hil_mock_robot.cia402.contracts import STEP_S
from hil_mock_robot.cia402.faults import KINDS, MASTER, Fault, fault_of
from hil_mock_robot.cia402.station import MotionWatch, Station, Unit
from hil_mock_robot.server.faults import Schedule

OVERCURRENT = 0x2310
EVERY_MODE = frozenset(range(-128, 128))


class MasterEnd(Protocol):
    """The other end of the bus."""

    def bus_off(self) -> None:
        """Put everybody who is on the bus now, but the drives, off it."""

    def recover(self) -> None:
        """Let them back."""


class Troubles:
    """What is wrong.

    Args:
        station: What suffers.
        motions: Which faults may wait for.
        master: The master's end of the bus.
        faults: What is to happen.

    Attributes:
        listeners: Told of each fault, and whether it begins.
    """

    def __init__(
        self,
        station: Station,
        motions: MotionWatch,
        master: MasterEnd,
        faults: Sequence[Fault] = (),
    ) -> None:
        self._station, self._master = station, master
        for i, fault in enumerate(faults):
            self._require_axes(f"faults[{i}] ({fault.kind})", fault)
        self._schedule = Schedule(faults, STEP_S, ("motion",))
        self.listeners: list[Callable[[Fault, bool], None]] = []
        self._effects: dict[str, Callable[[Unit, Fault, bool], None]] = {
            "emergency": lambda axis, fault, begins: self._fail(axis, fault.code, begins),
            "following_error": _slip,
            "overcurrent": lambda axis, _, begins: self._fail(axis, OVERCURRENT, begins),
            "overheat": self._overheat,
            "heartbeat_loss": _mute,
            "node_reboot": _reboot,
            "refused_mode": _refuse_modes,
            "bit12_low": _ignore_setpoints,
            "sync_ignored": _ignore_sync,
            "mapping_refused": _refuse_mapping,
            "sdo_abort": _abort_sdo,
            "sdo_silent": _lose_sdo,
            "lost_frames": _owe,
            "wrong_length": _owe,
            "late_frames": _delay,
            "bus_off": _bus_off,
        }
        motions.listeners.append(self._heard)

    @property
    def lasting(self) -> list[Fault]:
        """What has begun and is not over; what is a moment's matter is not in it."""
        return [fault for fault in self._schedule.lasting if "for_s" in KINDS[fault.kind]]

    def add(self, given: object) -> Fault:
        """One more fault, from the side channel; without a time it begins at once.

        Raises:
            SpecError: It is unknown or cannot be.
            CommandRefused: There is no such axis.
        """
        fault = fault_of("fault", given)
        self._require_axes(f"fault ({fault.kind})", fault)
        if self._schedule.add(fault):
            self._strike(fault, begins=True)
        return fault

    def clear(self) -> None:
        """End what lasts and forget what was to come; a reboot still takes its time."""
        for fault in self._schedule.clear(keep="node_reboot"):
            self._strike(fault, begins=False)
        for axis in self._station.axes:
            axis.line.owed.clear()
            axis.line.look()

    def passed(self, steps: int) -> None:
        """Steps of device time have passed."""
        if self._schedule.idle:
            self._schedule.ticks += steps
            return
        begun, over = self._schedule.turn(steps)
        for fault in over:
            self._strike(fault, begins=False)
        for fault in begun:
            self._strike(fault, begins=True)

    def _heard(self, begins: bool) -> None:
        if begins:
            self._schedule.began("motion")

    def _strike(self, fault: Fault, *, begins: bool) -> None:
        for listener in self.listeners:
            listener(fault, begins)
        if fault.axis == MASTER:
            (self._master.bus_off if begins else self._master.recover)()
        axes = self._station.axes
        for number in fault.axes[: len(axes)]:
            axis = axes[number]
            self._effects[fault.kind](axis, fault, begins)
            axis.line.look()

    def _fail(self, axis: Unit, code: int, begins: bool) -> None:
        if begins:
            axis.drive.fault(code)

    def _overheat(self, axis: Unit, fault: Fault, begins: bool) -> None:
        if begins:
            self._station.body.heat(axis.number, fault.celsius)

    def _require_axes(self, where: str, fault: Fault) -> None:
        count = len(self._station.axes)
        if isinstance(fault.axis, int) and fault.axis > count:
            raise CommandRefused(f"{where}: axis is {fault.axis}", hint=f"there are {count} axes")
        if fault.axis == MASTER and fault.kind != "bus_off":
            raise SpecError(f"{where}: axis is master", hint="only bus_off strikes the master")


def _slip(axis: Unit, fault: Fault, begins: bool) -> None:
    if begins:
        axis.drive.slip()


def _mute(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.line.mute = begins


def _reboot(axis: Unit, fault: Fault, begins: bool) -> None:
    (axis.power_off if begins else axis.power_on)()


def _refuse_modes(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.drive.operation.refused = set(EVERY_MODE if begins else ())


def _ignore_setpoints(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.drive.operation.deaf = begins


def _ignore_sync(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.follows_sync = not begins


def _refuse_mapping(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.line.refusals.pop(fault.kind, None)
    if begins:
        axis.line.refusals[fault.kind] = refused_mapping


def _abort_sdo(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.line.refusals.pop(fault.kind, None)
    if begins:
        axis.line.refusals[fault.kind] = refused_object(fault.index, fault.abort)


def _lose_sdo(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.line.unheard = begins


def _owe(axis: Unit, fault: Fault, begins: bool) -> None:
    if begins:
        axis.line.owed[fault.kind] += fault.frames
        axis.line.by_bytes = fault.by_bytes


def _delay(axis: Unit, fault: Fault, begins: bool) -> None:
    axis.line.late_steps = round(fault.by_s / STEP_S) if begins else 0


def _bus_off(axis: Unit, fault: Fault, begins: bool) -> None:
    (axis.bus_off if begins else axis.recover)()
