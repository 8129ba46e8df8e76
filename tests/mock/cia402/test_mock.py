"""The mock drives together: options, station, loop, journal, noise, a bus that is gone."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import random
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
from canopen.objectdictionary import import_od

from hil.arms import load_arm
from hil.arms.payload import Payload
from hil.core.errors import PluginError, RobotConnectionError, SpecError
from hil_mock_robot.cia402.bus import HubEnd, PythonCanEnd, end_of, side_path
from hil_mock_robot.cia402.mock import (
    CanRequests,
    HostedMock,
    Mock,
    main,
    mock_on_virtual_bus,
    nodes_of,
    parser_of,
)
from hil_mock_robot.plant.truth import draw_truth
from hil_mock_robot.server import side_channel
from hil_mock_robot.server.journal import read_journal
from hil_mock_robot.server.options import mounted_of, pose_of
from hil_mock_robot.server.side_channel import SideChannel
from tests.support.can_master import RPDO1, Master
from tests.support.can_station_parts import NoBus
from tests.support.in_time import InTime, measured_again
from tests.support.mock_servers import mock_can

PATIENT = 10.0
"""Wall time without SYNC that changes nothing: results do not depend on how busy we are."""
ARM = load_arm("lab6")
COUNTS = ARM.gear_ratio * 2**20 / (2 * math.pi)
ENABLE, QUICK_STOP = 0x0F, 0x02
_numbers = itertools.count(1)


@contextmanager
def mock(**options: object) -> Iterator[tuple[HostedMock, Master]]:
    channel = f"can-mock-{next(_numbers)}"
    options = {"patience_s": PATIENT, **options}
    with (
        mock_on_virtual_bus(channel, **options) as drives,  # type: ignore[arg-type]
        can.Bus(interface="virtual", channel=channel) as bus,
    ):
        yield drives, Master(bus)


def follow(master: Master, start: list[int], end_rad: float, cycles: int) -> None:
    """All axes by a cosine to `end_rad` from where they are."""
    for k in range(1, cycles + 1):
        way = end_rad * (1 - math.cos(math.pi * k / cycles)) / 2
        targets = [s + round(way * c) for s, c in zip(start, COUNTS, strict=True)]
        assert master.cycle(ENABLE, targets, within_s=PATIENT)


def test_six_axes_follow_set_points_by_sync() -> None:
    with mock() as (drives, master):
        master.map()
        held = master.enable()
        before = drives.tell("state")
        follow(master, held, 0.2, 200)
        for _ in range(25):
            master.cycle(ENABLE, [h + round(0.2 * c) for h, c in zip(held, COUNTS, strict=True)])
        after = drives.tell("state")
        assert np.subtract(after["q"], before["q"]) == pytest.approx([0.2] * 6, abs=2e-3)
        assert after["device_time"] - before["device_time"] == pytest.approx(225 * 0.004)
        assert after["states"] == ["OPERATION_ENABLED"] * 6
        assert master.position == pytest.approx(
            [h + 0.2 * c for h, c in zip(held, COUNTS, strict=True)], abs=2e-3 * COUNTS.max()
        )


def events(path: Path) -> list[tuple[str, object]]:
    """What happened, and who or what did it."""
    lines = read_journal(path)
    keys = ("by", "kind", "after", "axes")
    return [(line["event"], next((line[k] for k in keys if k in line), None)) for line in lines]


def test_the_journal_tells_of_commands_faults_and_rest(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    with mock(journal=journal) as (drives, master):
        master.map()
        held = master.enable()
        follow(master, held, 0.1, 50)
        drives.tell("fault", kind="following_error", axis=4)
        for _ in range(60):
            master.cycle(QUICK_STOP, master.position)
    beside = ("nmt", "booted", "sync", "motion_over", "disable")
    told = [each for each in events(journal) if each[0] not in beside]
    assert told == [
        ("enable", [1, 2, 3, 4, 5, 6]),
        ("start", None),
        ("fault", "following_error"),
        ("emergency", None),
        ("stop", "fault"),
        ("stop", "quick stop"),
        ("rest", "fault"),
        ("closed", None),
    ]
    emergency = next(line for line in read_journal(journal) if line["event"] == "emergency")
    assert (emergency["axis"], emergency["code"]) == (4, "8611")


def test_set_points_that_change_are_motions_where_no_master_announces_them() -> None:
    began: list[bool] = []
    with mock() as (drives, master):
        drives.ask(lambda it: it.motions.listeners.append(began.append))
        master.map()
        held = master.enable()
        for _ in range(2):
            follow(master, held, 0.02, 10)
            for _ in range(40):
                master.cycle(ENABLE, held)
    assert began == [True, False, True, False]


@pytest.mark.thorough
def test_what_the_payload_objects_say_hangs_at_the_flange() -> None:
    with mock() as (drives, master):
        for sub, value in enumerate((3.0, 0.0, 0.01, 0.05), start=1):
            master.download(1, 0x2100, sub, "f", value)
        state = drives.tell("state")
        assert (state["declared_kg"], state["mounted_kg"]) == (3.0, 3.0)
        for _ in range(10):
            master.cycle(0, [0] * 6)
        hanging = drives.ask(lambda it: it.station.body.mounted)
        assert hanging.mass == 3.0
        assert hanging.com == pytest.approx((0.0, 0.01, 0.05))


def test_what_really_hangs_there_is_not_changed_by_what_is_declared() -> None:
    with mock(mounted=Payload(1.0, (0.0, 0.0, 0.1))) as (drives, master):
        master.download(1, 0x2100, 1, "f", 3.0)
        state = drives.tell("state")
        assert (state["declared_kg"], state["mounted_kg"]) == (3.0, 1.0)
        drives.tell("mount", mass_kg=None)
        assert drives.tell("state")["mounted_kg"] == 3.0


def test_drives_have_the_node_ids_that_were_asked_for() -> None:
    with mock(nodes=(11, 12, 13, 14, 15, 16)) as (_, master):
        other = Master(master.bus, range(11, 17))
        assert [other.upload(node, 0x1018, 4) for node in other.nodes] == [
            402_001, 402_002, 402_003, 402_004, 402_005, 402_006,
        ]  # fmt: skip
        with pytest.raises(TimeoutError):
            master.upload(1, 0x1000, within_s=0.1)


def test_a_process_data_object_may_have_another_identifier() -> None:
    with mock() as (drives, master):
        master.map()
        held = master.enable()
        master.nmt(0x80, 3)
        master.download(3, 0x1400, 1, "I", 0x8000_0203)
        master.download(3, 0x1400, 1, "I", 0x0000_0333)
        master.nmt(0x01, 3)
        master.cycle(ENABLE, held)
        master.send(0x333, RPDO1.pack(QUICK_STOP, 8, held[2]))
        master.cycle(ENABLE, held)
        master.cycle(ENABLE, held)
        assert [status & 0x6F == 0x27 for status in master.status] == [True] * 2 + [False] + [
            True
        ] * 3
        assert drives.tell("state")["states"][2] != "OPERATION_ENABLED"


@pytest.mark.wire
def test_without_sync_heartbeats_go_by_the_drives_own_timer() -> None:
    with mock(patience_s=0.02) as (_, master):
        master.download(2, 0x1017, 0, "H", 20)
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            master.hear(0.01)
        assert 15 <= len(master.heartbeats[2]) <= 27


def test_requests_that_cannot_be_are_answered_in_words() -> None:
    with mock() as (drives, _):
        for request in ({"do": "quake"}, {"do": 3}, {}):
            with pytest.raises(SpecError, match="unknown request"):
                drives.ask(lambda it, request=request: it.requests.answer(request))
        answer = drives.ask(lambda it: it.requests.line(b"{no json"))
        assert "not JSON" in answer["error"]
        with pytest.raises(SpecError, match="6 numbers"):
            drives.tell("push", torque=[1.0])


# `hil mock can`: options, the data sheet, the truth, and what is said when something cannot be.


def test_without_options_it_is_lab6_on_can0() -> None:
    given = parser_of().parse_args([])
    assert (given.model, given.channel, given.interface) == ("lab6", "can0", "hil_unix")
    assert given.bitrate is None


def test_nodes_are_numbered_from_one_unless_somebody_says() -> None:
    assert nodes_of((), ARM, 127) == (1, 2, 3, 4, 5, 6)
    assert nodes_of((11, 12, 13, 14, 15, 16), ARM, 127) == (11, 12, 13, 14, 15, 16)


@pytest.mark.parametrize(
    ("nodes", "master_id"),
    [((1, 2, 3), 127), ((1, 1, 2, 3, 4, 5), 127), ((0, 1, 2, 3, 4, 5), 127), ((), 3), ((), 128)],
)
def test_nodes_that_cannot_share_a_bus_are_refused(nodes: Sequence[int], master_id: int) -> None:
    with pytest.raises(SpecError) as refused:
        nodes_of(nodes, ARM, master_id)
    assert refused.value.hint


@pytest.mark.parametrize("degrees", [(1, 2, 3), (999, 0, 0, 0, 0, 0), (math.nan,) * 6])
def test_what_is_no_pose_of_the_arm_is_refused(degrees: Sequence[float]) -> None:
    with pytest.raises(SpecError, match="is not a pose"):
        pose_of(degrees, ARM)


def test_a_pose_is_in_degrees() -> None:
    assert np.degrees(pose_of((10, 20, -30, 40, 50, 60), ARM)) == pytest.approx(
        [10, 20, -30, 40, 50, 60]
    )


def test_what_is_mounted_has_a_mass() -> None:
    assert mounted_of(None) is None
    mounted = mounted_of([2.0, 0.0, 0.0, 0.05])
    assert mounted is not None
    assert (mounted.mass, mounted.com) == (2.0, (0.0, 0.0, 0.05))
    with pytest.raises(SpecError):
        mounted_of([-1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    "given",
    [
        ("hil_unix", None, 10.0),
        ("socketcan", 1e6, 10.0),
        ("hil_unix", 1e6, 0.0),
        ("hil_unix", 1e6, math.nan),
        ("hil_unix", -1.0, None),
        ("hil_unix", math.inf, None),
    ],
)
def test_a_wire_that_cannot_be_is_refused(
    given: tuple[str, float | None, float | None], tmp_path: Path
) -> None:
    interface, bitrate, speed = given
    with pytest.raises(SpecError) as refused:
        end_of(interface, str(tmp_path / "can.sock"), bitrate, speed)
    assert refused.value.hint


@pytest.mark.parametrize(("speed", "times"), [(None, 1), (10.0, 10)])
def test_the_modelled_wire_goes_at_the_pace_of_the_master(
    speed: float | None, times: int, tmp_path: Path
) -> None:
    end = end_of("hil_unix", str(tmp_path / "can.sock"), 1e6, speed)
    end.send(0x181, bytes(8))
    assert isinstance(end, HubEnd)
    assert end.hub.wire is not None
    assert end.hub.wire.busy_s == pytest.approx(135e-6 / times)
    end.close()


def test_the_side_channel_lies_beside_the_bus(tmp_path: Path) -> None:
    assert side_path("hil_unix", str(tmp_path / "a.sock")) == str(tmp_path / "a.side")
    assert side_path("virtual", "x").endswith("virtual-x.side")


def test_an_interface_that_is_not_there_is_named() -> None:
    with pytest.raises(PluginError, match="nonsense channel can0") as refused:
        end_of("nonsense", "can0")
    assert "hil_unix" in refused.value.hint


def test_a_bus_is_let_go_when_an_option_cannot_be(tmp_path: Path) -> None:
    channel = str(tmp_path / "can.sock")
    assert main(["--channel", channel, "--nodes", "1", "2"]) == 2
    end_of("hil_unix", channel).close()


def test_the_data_sheet_can_be_had_as_a_file(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    assert main(["--eds", str(path)]) == 0
    dictionary = import_od(str(path), 5)
    assert dictionary["Statusword"].index == 0x6041
    assert dictionary[0x1400][1].default == 0x4000_0205


def test_a_data_sheet_that_cannot_be_written_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--eds", str(tmp_path / "nowhere" / "drive.eds")]) == 7
    assert "cannot write" in capsys.readouterr().err


# What the mock drives survive: noise on the bus, death, a bus that is gone.


@pytest.fixture(scope="module")
def bus() -> NoBus:
    return NoBus()


@pytest.fixture(scope="module")
def drives(bus: NoBus) -> Iterator[Mock]:
    mock = Mock(draw_truth("lab6", 1, "full"), bus)
    mock.station.boot()
    yield mock
    mock.loop.close()


@pytest.mark.parametrize("seed", range(4))
def test_noise_on_the_bus_harms_nobody(drives: Mock, bus: NoBus, seed: int) -> None:
    draw = random.Random(seed)
    bus.sent.clear()
    station = drives.station
    for step in range(6000):
        if step % 500 == 0:
            station.heard(0x000, bytes([1, 0]), 0.0)
        node = draw.randint(0, 7)
        kinds = (0x000, 0x080, 0x180, 0x200, 0x300, 0x580, 0x600, 0x700, draw.randint(0, 0x780))
        can_id = min(0x7FF, draw.choice(kinds) + node)
        data = draw.randbytes(draw.choice((0, 1, 2, 4, 6, 7, 8, 8, 8)))
        if can_id & ~0x7F == 0x600 and draw.random() < 0.7:  # whole requests go deeper
            index = draw.choice((0x1400, 0x1600, 0x1800, 0x1A00, 0x6040, 0x6060, 0x607A, 0x60C2))
            data = struct.pack(
                "<BHB", draw.choice((0x23, 0x2B, 0x2F, 0x40, 0x21, 0x80)), index, draw.randint(0, 5)
            ) + draw.randbytes(4)
        station.heard(can_id, data, 0.0)
    sent = [can_id & ~0x7F for can_id, _ in bus.sent]
    assert sent.count(0x580) > 100
    assert sent.count(0x180) > 5
    assert all(abs(seen.true_q) < 10 for seen in station.body.seen)


def test_sync_alone_drives_time_when_periods_are_nonsense(drives: Mock) -> None:
    unit = drives.station.axes[0]
    before = drives.station.clock.steps
    for value, index in ((0, 0), (255, 127), (255, -128), (1, -3)):
        unit.registers[0x60C2 << 8 | 1], unit.registers[0x60C2 << 8 | 2] = value, index
        drives.station._written(0, 0x60C2 << 8 | 1)
        drives.station.heard(0x080, b"", 0.0)
    assert 1 <= drives.station.clock.steps - before <= 3000


def test_a_bus_of_python_can_that_is_gone_is_said() -> None:
    class Gone(can.BusABC):
        def __init__(self) -> None:
            super().__init__(channel="x")

        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            raise can.CanOperationError("Network is down")

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("Network is down")

    end = PythonCanEnd(Gone(), "socketcan channel can0")
    end.send(0x181, b"")
    assert end.lost == 1
    with pytest.raises(RobotConnectionError, match="socketcan channel can0 is lost: Network"):
        end.serve(0.0)
    end.close()


def test_a_side_channel_in_use_is_not_taken_over(drives: Mock, tmp_path: Path) -> None:
    requests = CanRequests(drives.station, drives.faults)
    first = SideChannel(tmp_path / "a.side", requests)
    with pytest.raises(PluginError, match="cannot listen"):
        SideChannel(tmp_path / "a.side", requests)
    first.close()
    SideChannel(tmp_path / "a.side", requests).close()


@measured_again
def test_a_client_of_the_side_channel_that_does_not_read_holds_up_nobody(
    drives: Mock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(side_channel, "UNREAD_S", 100.0)
    requests = CanRequests(drives.station, drives.faults)
    with (
        contextlib.closing(SideChannel(tmp_path / "b.side", requests)) as side,
        socket.socket(socket.AF_UNIX) as mute,
        socket.socket(socket.AF_UNIX) as other,
    ):
        mute.connect(str(side.path))
        other.connect(str(side.path))
        mute.setblocking(False)
        for _ in range(40):
            with contextlib.suppress(BlockingIOError):
                mute.sendall(b'{"do": "state"}\n' * 60)
            served = InTime()
            side.serve()
            served.require(0.5)
        other.sendall(b'{"do": "clear"}\n')
        side.serve()
        assert other.recv(100) == b"{}\n"
        monkeypatch.setattr(side_channel, "UNREAD_S", 0.01)
        time.sleep(0.02)
        side.serve()
        assert len(side.sockets) == 2  # who does not read is hung up on


def test_a_client_of_the_side_channel_gets_all_of_a_long_answer(
    drives: Mock, tmp_path: Path
) -> None:
    side = SideChannel(tmp_path / "c.side", CanRequests(drives.station, drives.faults))
    with socket.socket(socket.AF_UNIX) as line:
        line.connect(str(side.path))
        line.setblocking(False)
        line.sendall(b'{"do": "state"}\n' * 800)
        answers, until = b"", time.monotonic() + 20.0
        while answers.count(b"\n") < 800 and time.monotonic() < until:
            side.serve()
            with contextlib.suppress(BlockingIOError):
                answers += line.recv(4096)
        assert answers.count(b"\n") == 800
    assert all(json.loads(each)["synced"] is not None for each in answers.splitlines())
    side.close()


@pytest.mark.wire
def test_requests_out_of_place_are_no_news_for_a_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        mock_can(channel=tmp_path / "can.sock", by_command=True) as mock,
        mock.bus() as bus,
    ):
        for request in (
            b"\xc6\x7a\x60\x00\x04\x00\x00\x00",
            b"\x01" + bytes(7),
            b"\xe0" + bytes(7),
        ):
            bus.send(can.Message(arbitration_id=0x601, data=request, is_extended_id=False))
        master = Master(bus)
        while master.hear(0.3) is not None:
            pass
        assert master.upload(1, 0x1000) == 0x0002_0192
    assert capfd.readouterr().err == ""
