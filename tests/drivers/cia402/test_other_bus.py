"""A session over a field bus that is no CAN: what stands above the bus protocol knows none."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence

import numpy as np

from hil.arms import load_arm
from hil.robot import Finding
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.bus import Bus, Setting
from hil_drivers.cia402.mapping import MAPPINGS, Mapping
from hil_drivers.cia402.objects import NO_OBJECT, Aborted, Entry
from hil_drivers.cia402.options import Options, options_of
from hil_drivers.cia402.rows import raw_topic
from hil_drivers.cia402.session import Session
from hil_drivers.cia402.torque import TorqueModel
from hil_mock_robot.cia402.dictionary import registers_of
from hil_mock_robot.cia402.keys import key
from tests.support.cia402_parts import ENABLED, OFF, FakeDrives

ARM = load_arm("lab6")
GIVEN = {"bus": {"interface": "hil_unix", "channel": "none"}, "pace": "free"}
WATCHDOG = Entry("watchdog", 0x5FFF, 1, "H")


class Mailbox:
    """Implements `Acyclic` on dictionaries: no frames, no node ids, a watchdog for a heartbeat."""

    def __init__(self, drives: FakeDrives) -> None:
        self.n, self._drives = len(drives.drives), drives
        self.registers = [{**registers_of(ARM, axis), key(0x5FFF, 1): 0} for axis in range(self.n)]
        self.states: list[str] = []

    def name_of(self, axis: int) -> str:
        return f"{ARM.joint_names[axis]} (slave {1001 + axis})"

    def upload(self, axis: int, entry: Entry) -> int:
        if entry == od.STATUSWORD:
            return self._drives.drives[axis].status
        if key(entry.index, entry.sub) not in self.registers[axis]:
            raise Aborted(self.name_of(axis), NO_OBJECT)
        return int(self.registers[axis][key(entry.index, entry.sub)])

    def download(self, axis: int, entry: Entry, value: int) -> None:
        self.registers[axis][key(entry.index, entry.sub)] = value

    def upload_each(
        self, entry: Entry, axes: Iterable[int], within_s: float = 0.0
    ) -> dict[int, int]:
        return {axis: self.upload(axis, entry) for axis in axes}

    def download_each(
        self, entry: Entry, value: int, axes: Iterable[int], within_s: float = 0.0
    ) -> list[int]:
        return [axis for axis in axes if self.download(axis, entry, value) is None]

    def settings(self, options: Options, of_drive: Sequence[Setting]) -> list[Setting]:
        return [*of_drive, Setting(WATCHDOG, 100)]

    def unwatch(self, axes: Sequence[int], within_s: float) -> None:
        self.download_each(WATCHDOG, 0, axes)

    def preoperational(self) -> None:
        self.states.append("preoperational")

    def map(self, mapping: Mapping) -> None:
        self.states.append(f"mapped {mapping.name}")

    def operational(self) -> None:
        self.states.append("operational")

    def release(self) -> None:
        self.states.append("released")


class OtherBus:
    """Implements `Bus`."""

    def __init__(self) -> None:
        self.cyclic = FakeDrives(6, MAPPINGS["position"])
        self.acyclic = Mailbox(self.cyclic)
        self.celsius = np.full(6, np.nan)
        self.closed = threading.Event()

    def load(self) -> Finding:
        return Finding("bus-load", True, "one datagram a cycle")

    def losses(self) -> str:
        return ""

    def flush(self) -> None: ...

    def close(self) -> None:
        self.closed.set()


def test_axes_are_set_up_enabled_and_left_without_a_can_bus() -> None:
    other, options = OtherBus(), options_of(GIVEN, "lab6")
    bus: Bus = other
    topic = raw_topic(MAPPINGS[options.mapping], 6, options.rate_hz)
    session = Session("arm", ARM, options, bus, topic, None)
    try:
        session.begin()
        assert [drive.status for drive in other.cyclic.drives] == [ENABLED] * 6
        assert {each[key(0x5FFF, 1)] for each in other.acyclic.registers} == {100}
        assert len(session.samples.take(1.0))
        named = {finding.name: finding for finding in session.findings(TorqueModel("lab6"))}
        assert named["bus-load"].message == "one datagram a cycle"
        assert named["drives-enabled"].passed
    finally:
        session.leave(rest_s=1.0)
    assert other.acyclic.states == [
        "preoperational",
        "mapped position",
        "operational",
        "released",
    ]
    assert [drive.status for drive in other.cyclic.drives] == [OFF] * 6
    assert {each[key(0x5FFF, 1)] for each in other.acyclic.registers} == {0}
    assert other.closed.is_set()
