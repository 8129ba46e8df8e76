"""Faults of the mock drives on request: what each of them does to the drives and on the bus."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import can
import pytest

from hil.core.errors import CommandRefused, SpecError
from hil_mock_robot.cia402.bus import Line, refused_mapping, refused_object
from hil_mock_robot.cia402.faults import CanFault
from hil_mock_robot.cia402.mock import HostedMock, mock_on_virtual_bus
from tests.support.can_master import Abort, Master

ENABLE, QUICK_STOP = 0x0F, 0x02
FAULT = 0x08
CHANNEL = "can-mock-faults"


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[HostedMock, Master]]:
    with (
        mock_on_virtual_bus(CHANNEL, patience_s=10.0) as drives,
        can.Bus(interface="virtual", channel=CHANNEL) as bus,
    ):
        yield drives, Master(bus)


@pytest.fixture
def anew(running: tuple[HostedMock, Master]) -> tuple[HostedMock, Master]:
    drives, master = running
    drives.tell("clear")
    master.reset()
    pass_time(drives, master, 60)  # who was moving is brought to rest
    return drives, master


@pytest.fixture
def enabled(anew: tuple[HostedMock, Master]) -> tuple[HostedMock, Master, list[int]]:
    drives, master = anew
    master.map()
    return drives, master, master.enable()


def cycles(master: Master, held: list[int], count: int, controlword: int = ENABLE) -> list[bool]:
    return [master.cycle(controlword, held) for _ in range(count)]


def pass_time(drives: HostedMock, master: Master, syncs: int) -> None:
    """SYNC alone, until all was heard, and all that came of it."""
    before = drives.tell("state")["syncs"]
    for _ in range(syncs):
        master.send(0x080)
    while drives.tell("state")["syncs"] < before + syncs:
        time.sleep(0.005)
    while master.hear():
        pass


def others(values: list[object], axis: int) -> list[object]:
    return values[: axis - 1] + values[axis:]


# What can be asked for


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("quake", "faults is 'quake'"),
        ([{"kind": "quake", "at_s": 1}], r"faults\[0\] is .*quake"),
        ([{"kind": "bit12_low"}], r"faults\[0\] is"),
        ([{"kind": "bit12_low", "at_s": 1, "motion": 2}], r"faults\[0\]"),
        ([{"kind": "bit12_low", "at_s": 1, "frames": 3}], "has no key frames"),
        ([{"kind": "bit12_low", "at_s": 1, "axis": 0}], "axis is 0"),
        ([{"kind": "bit12_low", "at_s": 1, "axis": "elbow"}], "axis is 'elbow'"),
        ([{"kind": "bit12_low", "at_s": 1, "axis": True}], "axis is True"),
        ([{"kind": "late_frames", "at_s": 1}], "lacks by_s"),
        ([{"kind": "emergency", "at_s": 1, "code": 0}], "code is 0"),
        ([{"kind": "emergency", "at_s": 1, "code": 0x10000}], "code is 65536"),
        ([{"kind": "lost_frames", "at_s": 1, "frames": 0}], "frames is 0"),
        ([{"kind": "wrong_length", "at_s": 1, "by_bytes": 9}], "by_bytes is 9"),
        ([{"kind": "overheat", "at_s": 1, "celsius": "hot"}], "celsius is 'hot'"),
        ([{"kind": "sdo_abort", "at_s": 1, "index": -1}], "index is -1"),
    ],
)
def test_what_cannot_be_is_refused_in_words(given: object, words: str) -> None:
    with pytest.raises(SpecError, match=words) as refused:
        CanFault.all_of(given)
    assert refused.value.hint


def test_a_file_holds_faults_with_hexadecimal_codes(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text("- {kind: emergency, motion: 2, after_s: 0.3, axis: 4, code: 0x2310}\n")
    (fault,) = CanFault.read(path)
    told = fault.kind, fault.motion, fault.after_s, fault.axis, fault.code
    assert told == ("emergency", 2, 0.3, 4, 0x2310)


def test_a_fault_strikes_one_axis_or_all_or_the_master() -> None:
    station = SimpleNamespace(axes=tuple("abcdef"))

    def struck(**given: object) -> tuple[str, ...]:
        return CanFault.one_of("f", given).axes(station)  # type: ignore[arg-type, return-value]

    assert struck(kind="bit12_low", axis=3) == ("c",)
    assert struck(kind="bit12_low", axis="all") == tuple("abcdef")
    assert struck(kind="bus_off", axis="master") == ()


def test_an_axis_that_the_arm_lacks_is_refused(anew: tuple[HostedMock, Master]) -> None:
    drives, _ = anew
    with pytest.raises(CommandRefused, match="axis is 7"):
        drives.tell("fault", kind="bit12_low", axis=7)
    with pytest.raises(SpecError, match="master"):
        drives.tell("fault", kind="bit12_low", axis="master")


# Drives


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"kind": "emergency", "code": 0x7305}, 0x7305),
        ({"kind": "following_error"}, 0x8611),
        ({"kind": "overcurrent"}, 0x2310),
        ({"kind": "overheat", "celsius": 200.0}, 0x4310),
    ],
)
def test_a_drive_that_fails_says_so_by_emcy_and_stops(
    enabled: tuple[HostedMock, Master, list[int]], fault: dict[str, object], code: int
) -> None:
    drives, master, held = enabled
    drives.tell("fault", axis=3, **fault)
    cycles(master, held, 100)
    assert (3, code) in master.emergencies
    assert master.status[2] & 0x4F == FAULT
    assert all(status & 0x6F == 0x27 for status in others(list(master.status), 3))
    assert master.upload(3, 0x603F) == code
    drives.tell("fault", kind="overheat", axis=3, celsius=20.0)


def test_heartbeats_of_one_drive_are_lost(anew: tuple[HostedMock, Master]) -> None:
    drives, master = anew
    for node in master.nodes:
        master.download(node, 0x1017, 0, "H", 20)
    drives.tell("fault", kind="heartbeat_loss", axis=5)
    master.heartbeats.clear()
    pass_time(drives, master, 30)
    assert sorted(master.heartbeats) == [1, 2, 3, 4, 6]
    assert master.upload(5, 0x1017) == 20


@pytest.mark.thorough
def test_a_drive_that_reboots_is_dark_and_comes_back_as_after_power_on(
    enabled: tuple[HostedMock, Master, list[int]],
) -> None:
    drives, master, held = enabled
    drives.tell("fault", kind="node_reboot", axis=2, for_s=0.1)
    assert not any(cycles(master, held, 10)[2:])
    with pytest.raises(TimeoutError):
        master.upload(2, 0x1000, within_s=0.1)
    pass_time(drives, master, 30)
    assert master.heartbeats[2][-1] in (0, 127)
    assert master.upload(2, 0x6041) & 0x4F == 0x40
    assert master.upload(2, 0x1A00) == 1


def test_a_mode_that_is_refused_is_not_displayed(anew: tuple[HostedMock, Master]) -> None:
    drives, master = anew
    drives.tell("fault", kind="refused_mode", axis=4)
    master.map()
    cycles(master, [0] * 6, 5, 0x06)
    assert others(list(master.mode), 4) == [8] * 5
    assert master.mode[3] != 8
    drives.tell("clear")
    cycles(master, [0] * 6, 5, 0x06)
    assert master.mode[3] == 8


def test_a_drive_that_ignores_set_points_says_so_by_bit_12(
    enabled: tuple[HostedMock, Master, list[int]],
) -> None:
    drives, master, held = enabled
    assert all(status & 0x1000 for status in master.status)
    drives.tell("fault", kind="bit12_low", axis=6)
    for k in range(1, 51):
        master.cycle(ENABLE, [each + 4000 * k for each in held])
    assert [bool(status & 0x1000) for status in master.status] == [True] * 5 + [False]
    assert master.position[0] == pytest.approx(held[0] + 200_000, abs=40_000)
    assert master.position[5] == pytest.approx(held[5], abs=4000)


def test_a_drive_that_ignores_sync_sends_no_tpdos(
    enabled: tuple[HostedMock, Master, list[int]],
) -> None:
    drives, master, held = enabled
    drives.tell("fault", kind="sync_ignored", axis=1)
    cycles(master, held, 1)
    master.frames.clear()
    cycles(master, held, 1)
    assert {m.arbitration_id & 0x7F for m in master.frames} == {2, 3, 4, 5, 6}


# SDO


def test_a_mapping_that_is_refused_is_aborted_as_not_mappable(
    anew: tuple[HostedMock, Master],
) -> None:
    drives, master = anew
    drives.tell("fault", kind="mapping_refused", axis=1)
    with pytest.raises(Abort, match="06040041"):
        master.map()
    assert master.upload(1, 0x1000) == 0x0002_0192


def test_an_object_is_refused_with_the_abort_code_that_was_asked_for(
    anew: tuple[HostedMock, Master],
) -> None:
    drives, master = anew
    drives.tell("fault", kind="sdo_abort", axis=2, index=0x6065, abort=0x0609_0030)
    with pytest.raises(Abort, match="06090030"):
        master.download(2, 0x6065, 0, "I", 1000)
    assert master.upload(2, 0x1000) == 0x0002_0192
    drives.tell("clear")
    master.download(2, 0x6065, 0, "I", 1000)


def test_a_drive_that_answers_no_sdo_goes_on_else(anew: tuple[HostedMock, Master]) -> None:
    drives, master = anew
    drives.tell("fault", kind="sdo_silent", axis=3, for_s=0.2)
    with pytest.raises(TimeoutError):
        master.upload(3, 0x1000, within_s=0.1)
    pass_time(drives, master, 60)
    assert master.upload(3, 0x1000) == 0x0002_0192


# Frames


def test_as_many_tpdos_are_lost_as_said(enabled: tuple[HostedMock, Master, list[int]]) -> None:
    drives, master, held = enabled
    drives.tell("fault", kind="lost_frames", axis=2, frames=2)
    assert cycles(master, held, 3) == [False, True, True]


def test_tpdos_come_late_and_in_order(enabled: tuple[HostedMock, Master, list[int]]) -> None:
    drives, master, _ = enabled
    drives.tell("fault", kind="late_frames", axis=2, by_s=0.008)
    master.frames.clear()
    pass_time(drives, master, 4)
    count = {node: sum(m.arbitration_id == 0x180 + node for m in master.frames) for node in (1, 2)}
    assert count == {1: 4, 2: 2}


def test_a_tpdo_is_too_short_once(enabled: tuple[HostedMock, Master, list[int]]) -> None:
    drives, master, held = enabled
    drives.tell("fault", kind="wrong_length", axis=2, by_bytes=-3)
    master.frames.clear()
    cycles(master, held, 2)
    assert [m.dlc for m in master.frames if m.arbitration_id == 0x182] == [4, 7]


@pytest.mark.thorough
def test_a_drive_that_is_off_the_bus_stops_by_itself(
    enabled: tuple[HostedMock, Master, list[int]],
) -> None:
    drives, master, held = enabled
    drives.tell("fault", kind="bus_off", axis=2)
    assert not any(cycles(master, held, 4))
    state = drives.tell("state")
    assert state["states"][1] != "OPERATION_ENABLED"
    assert others(state["states"], 2) == ["OPERATION_ENABLED"] * 5


def test_a_master_that_is_off_the_bus_is_missed_by_the_drives(
    anew: tuple[HostedMock, Master],
) -> None:
    drives, master = anew
    master.map(heartbeat_ms=100)
    master.master_heartbeat = 5
    held = master.enable()
    drives.tell("fault", kind="bus_off", axis="master")
    assert not master.cycle(ENABLE, held)
    drives.ask(lambda mock: [mock.station._advance(5, synced=False) for _ in range(40)])
    assert drives.tell("state")["states"] != ["OPERATION_ENABLED"] * 6


# When


def test_a_fault_waits_for_its_motion_as_the_master_announces_it() -> None:
    faults = [CanFault.make("following_error", axis=2, motion=2, after_s=0.04)]
    told = []
    with (
        mock_on_virtual_bus(f"{CHANNEL}-motions", patience_s=10.0, faults=faults),
        can.Bus(interface="virtual", channel=f"{CHANNEL}-motions") as bus,
    ):
        master = Master(bus)
        master.map()
        master.marker(0, 0)
        held = master.enable()
        for segment in (3, 4):
            master.marker(segment, 1)
            cycles(master, held, 6)
            told.append(list(master.emergencies))
            cycles(master, held, 10)
            master.marker(segment, 2)
            cycles(master, held, 2)
    assert told == [[], []]
    assert master.emergencies == [(2, 0x8611)]


def test_what_lasts_is_in_the_state_until_it_is_over(
    enabled: tuple[HostedMock, Master, list[int]],
) -> None:
    drives, master, held = enabled
    drives.tell("fault", kind="bit12_low", axis=1, for_s=0.04)
    drives.tell("fault", kind="lost_frames", axis=1)
    assert drives.tell("state")["faults"] == ["bit12_low"]
    cycles(master, held, 15)
    assert drives.tell("state")["faults"] == []
    assert all(status & 0x1000 for status in master.status)


def test_every_kind_of_fault_can_be_asked_for_and_cleared(
    anew: tuple[HostedMock, Master],
) -> None:
    drives, master = anew
    needed = {"late_frames": {"by_s": 0.01}}
    for kind in CanFault.kinds:
        assert drives.tell("fault", kind=kind, axis=1, **needed.get(kind, {})) == {"fault": kind}
    drives.tell("clear")
    assert drives.tell("state")["faults"] == ["node_reboot"]
    pass_time(drives, master, 200)
    assert drives.tell("state")["faults"] == []


# The line alone


def test_a_line_that_is_sound_again_passes_frames_as_they_are() -> None:
    sent: list[tuple[int, bytes]] = []
    line = Line(1, lambda can_id, data: sent.append((can_id, data)))
    line.late_steps = 3
    line.look()
    line.send(0x181, b"a")
    line.send(0x081, b"emcy")
    line.late_steps = 0
    line.look()
    assert not line.sound
    line.send(0x181, b"b")
    line.passed(3)
    line.release()
    assert [data for _, data in sent] == [b"emcy", b"a", b"b"]
    assert line.sound


def test_refusals_are_for_the_beginning_of_transfers_alone() -> None:
    assert refused_mapping(1, 0x1A00, 1) == 0x0604_0041
    assert refused_mapping(1, 0x1A00, 0) == 0
    assert refused_mapping(2, 0x1A00, 1) == 0
    assert refused_object(0, 5)(3, 0x1234, 0) == 0
    assert refused_object(0x1234, 5)(2, 0x1234, 7) == 5
    assert math.isinf(CanFault.one_of("f", {"kind": "sdo_abort"}).for_s)
