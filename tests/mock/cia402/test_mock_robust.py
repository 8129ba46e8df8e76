"""What the mock drives survive: noise on the bus, death, a bus that is gone."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from hil.core.errors import PluginError, RobotConnectionError
from hil_mock_robot.cia402.bus import PythonCanEnd, ignored
from hil_mock_robot.cia402.mock import CanRequests, Mock
from hil_mock_robot.plant.truth import draw_truth
from hil_mock_robot.server.side_channel import SideChannel
from tests.support.can_master import Master
from tests.support.mock_servers import mock_can


class NoBus:
    """Takes what is sent; frames are put in by the test."""

    where = "no bus"

    def __init__(self) -> None:
        self.heard = ignored
        self.sent: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes) -> None:
        assert 0 <= can_id <= 0x7FF
        assert len(data) <= 8
        self.sent.append((can_id, data))

    def flush(self) -> None:
        """Nothing is kept."""

    def serve(self, timeout_s: float, others: object = ()) -> bool:
        return False

    def bus_off(self) -> None:
        """Nobody is there."""

    def recover(self) -> None:
        """Nobody is there."""

    def close(self) -> None:
        """Nothing to leave."""


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
    with pytest.raises(RobotConnectionError, match="socketcan channel can0 is gone: Network"):
        end.serve(0.0)
    end.close()


def test_a_side_channel_in_use_is_not_taken_over(drives: Mock, tmp_path: Path) -> None:
    requests = CanRequests(drives.station, drives.faults)
    first = SideChannel(tmp_path / "a.side", requests)
    with pytest.raises(PluginError, match="cannot listen"):
        SideChannel(tmp_path / "a.side", requests)
    first.close()
    SideChannel(tmp_path / "a.side", requests).close()


@pytest.mark.thorough
def test_a_client_of_the_side_channel_that_does_not_read_holds_up_nobody(
    drives: Mock, tmp_path: Path
) -> None:
    side = SideChannel(tmp_path / "b.side", CanRequests(drives.station, drives.faults))
    with socket.socket(socket.AF_UNIX) as mute, socket.socket(socket.AF_UNIX) as other:
        mute.connect(str(side.path))
        other.connect(str(side.path))
        mute.setblocking(False)
        slowest = 0.0
        for _ in range(40):
            with contextlib.suppress(BlockingIOError):
                mute.sendall(b'{"do": "state"}\n' * 60)
            began = time.monotonic()
            side.serve()
            slowest = max(slowest, time.monotonic() - began)
        other.sendall(b'{"do": "clear"}\n')
        side.serve()
        assert other.recv(100) == b"{}\n"
        assert slowest < 0.5
        time.sleep(1.1)
        side.serve()
        assert len(side.sockets) == 2  # who does not read is hung up on
    side.close()


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
