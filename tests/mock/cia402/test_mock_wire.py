"""Mock drives on a bus: between two processes in wall time, and with tools of CANopen."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import can
import canopen
import numpy as np
import pytest
from canopen.profiles.p402 import BaseNode402

from hil.arms import load_arm
from hil_mock_robot.cia402.mock import HostedMock, mock_on_virtual_bus
from tests.support.can_master import Master
from tests.support.mock_servers import mock_can

pytestmark = pytest.mark.wire

ARM = load_arm("lab6")
COUNTS = ARM.gear_ratio * 2**20 / (2 * math.pi)
ENABLE, QUICK_STOP = 0x0F, 0x02
PERIOD_S = 0.004
WAY_RAD = 0.3


def commanded(held: list[int], way: float) -> list[int]:
    return [h + round(way * c) for h, c in zip(held, COUNTS, strict=True)]


def swing(master: Master, held: list[int], cycles: int, stop_after: int | None = None) -> int:
    """All axes by a cosine in real time; returns how many cycles lacked answers."""
    due, lacking = time.monotonic(), 0
    for k in range(1, (stop_after or cycles) + 1):
        way = WAY_RAD * (1 - math.cos(math.pi * k / cycles)) / 2
        lacking += not master.cycle(ENABLE, commanded(held, way))
        due += PERIOD_S
        time.sleep(max(0.0, due - time.monotonic()))
    return lacking


def events(journal: list[dict[str, object]], *names: str) -> list[dict[str, object]]:
    return [line for line in journal if line["event"] in names]


@pytest.mark.journey
def test_six_axes_follow_set_points_between_two_processes(tmp_path: Path) -> None:
    with mock_can(journal=tmp_path / "journal") as mock, mock.bus() as bus:
        master = Master(bus)
        master.map()
        held = master.enable()
        before = mock.state()["q"]
        master.marker(0, 1)
        assert swing(master, held, 150) == 0
        master.marker(0, 2)
        for _ in range(40):
            master.cycle(ENABLE, commanded(held, WAY_RAD))
        after = mock.state()["q"]
        for _ in range(60):
            master.cycle(QUICK_STOP, commanded(held, WAY_RAD))
        assert mock.state()["states"] == ["SWITCH_ON_DISABLED"] * 6
        assert np.subtract(after, before) == pytest.approx([WAY_RAD] * 6, abs=3e-3)
        told = [line["event"] for line in mock.journal()]
    wanted = ["sync", "enable", "start", "motion_over", "rest", "stop"]
    assert [each for each in told if each in wanted] == wanted


def test_drives_whose_master_is_gone_stop_by_themselves(tmp_path: Path) -> None:
    with mock_can(journal=tmp_path / "journal") as mock:
        with mock.bus() as bus:
            master = Master(bus)
            master.map(heartbeat_ms=60)
            master.master_heartbeat = 5
            held = master.enable()
            swing(master, held, 200, stop_after=100)
        gone = time.monotonic()
        mock.wait_until(lambda state: "OPERATION_ENABLED" not in state["states"])
        mock.wait_until(lambda _: bool(events(mock.journal(), "rest")))
        journal = mock.journal()
    lost = events(journal, "connection_lost")
    assert {line["code"] for line in lost} == {"8130"}
    assert {line["axis"] for line in lost} == {1, 2, 3, 4, 5, 6}
    rest = events(journal, "rest")[-1]
    assert float(str(rest["monotonic_s"])) - gone < 1.0


def test_a_frame_takes_its_time_on_a_modelled_wire() -> None:
    with mock_can("--bitrate", "1e6") as mock, mock.bus() as bus:
        master = Master(bus)
        master.map()
        master.cycle(0, [0] * 6)
        took = []
        for _ in range(10):
            began = time.monotonic()
            assert master.cycle(0, [0] * 6)
            took.append(time.monotonic() - began)
        # SYNC, 6 RPDOs and 6 TPDOs of 7 bytes, 6 of 8: at least their bits without stuffing.
        assert min(took) >= (47 + 12 * (47 + 56) + 6 * (47 + 64)) * 1e-6


def test_any_tool_of_python_can_sees_the_bus() -> None:
    with mock_can() as mock, mock.bus() as bus:
        bus.send(can.Message(arbitration_id=0, data=[0x81, 4], is_extended_id=False))
        found = [bus.recv(1.0)]
        assert [(m.arbitration_id, bytes(m.data)) for m in found if m] == [(0x704, b"\x00")]


# CANopen tools that know nothing of us, against the mock drives: `canopen` and its profile 402.


AXIS = 6
TOOL_COUNTS = float(ARM.gear_ratio[AXIS - 1]) * 2**20 / (2 * math.pi)
TOOL_PERIOD_S = 0.008
_numbers = itertools.count(1)


@pytest.fixture
def tools(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[HostedMock, canopen.Network]]:
    # A client that gives up after 0.3 s reads half a data sheet on a busy computer.
    monkeypatch.setattr(canopen.sdo.SdoClient, "RESPONSE_TIMEOUT", 10.0)
    channel = f"can-tools-{next(_numbers)}"
    with mock_on_virtual_bus(channel) as drives:
        network = canopen.Network()
        network.connect(interface="virtual", channel=channel)
        try:
            yield drives, network
        finally:
            network.disconnect()


def test_a_scanner_finds_six_nodes(tools: tuple[HostedMock, canopen.Network]) -> None:
    _, network = tools
    network.scanner.search(10)
    until = time.monotonic() + 3.0
    while len(network.scanner.nodes) < 6 and time.monotonic() < until:
        time.sleep(0.02)
    assert sorted(network.scanner.nodes) == [1, 2, 3, 4, 5, 6]


def test_a_client_reads_the_data_sheet_from_the_drive_itself(
    tools: tuple[HostedMock, canopen.Network],
) -> None:
    _, network = tools
    node = network.add_node(2, upload_eds=True)
    assert node.sdo["Statusword"].raw & 0x4F == 0x40
    assert node.sdo[0x6502].raw & 0b11_1000_0000 == 0b11_1000_0000
    with pytest.raises(canopen.SdoAbortedError, match="read only"):
        node.sdo[0x6041].raw = 1


def test_an_emergency_and_a_boot_up_reach_their_consumers(
    tools: tuple[HostedMock, canopen.Network],
) -> None:
    drives, network = tools
    node = network.add_node(3, upload_eds=True)
    drives.tell("fault", kind="emergency", axis=3, code=0x7305)
    until = time.monotonic() + 3.0
    while not node.emcy.log and time.monotonic() < until:
        time.sleep(0.01)
    assert [error.code for error in node.emcy.log] == [0x7305]
    node.nmt.send_command(0x81)
    node.nmt.wait_for_bootup(3.0)


@contextmanager
def cyclic(network: canopen.Network, node: BaseNode402) -> Iterator[None]:
    """SYNC and the node's RPDOs, which the profile itself never sends when they go by SYNC."""
    ended = threading.Event()

    def run() -> None:
        while not ended.is_set():
            network.sync.transmit()
            for rpdo in node.rpdo.values():
                if rpdo.enabled:
                    rpdo.transmit()
            time.sleep(TOOL_PERIOD_S)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_canopens_own_profile_402_enables_an_axis_and_moves_it(
    tools: tuple[HostedMock, canopen.Network],
) -> None:
    drives, network = tools
    node = BaseNode402(AXIS, network.add_node(AXIS, upload_eds=True).object_dictionary)
    network.add_node(node)
    node.sdo[0x1017].raw = 50
    node.nmt.state = "PRE-OPERATIONAL"
    node.nmt.wait_for_heartbeat(3.0)
    node.setup_402_state_machine()
    lay_out(node)
    node.sdo[0x60C2][1].raw, node.sdo[0x60C2][2].raw = round(TOOL_PERIOD_S * 1000), -3
    node.nmt.state = "OPERATIONAL"
    with cyclic(network, node):
        node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
        start = node.sdo[0x6064].raw
        node.rpdo[1]["Target position"].raw = start
        node.state = "OPERATION ENABLED"
        steps = 60
        for k in range(1, steps + 1):
            way = 0.1 * (1 - math.cos(math.pi * k / steps)) / 2
            node.rpdo[1]["Target position"].raw = start + round(way * TOOL_COUNTS)
            time.sleep(TOOL_PERIOD_S)
        time.sleep(0.2)
        assert node.state == "OPERATION ENABLED"
        assert node.tpdo[1]["Position actual value"].raw - start == pytest.approx(
            0.1 * TOOL_COUNTS, rel=0.05
        )
        assert drives.tell("state")["q"][AXIS - 1] == pytest.approx(0.1, abs=0.005)
        node.state = "SWITCH ON DISABLED"
    assert drives.tell("state")["states"][AXIS - 1] == "SWITCH_ON_DISABLED"


def lay_out(node: BaseNode402) -> None:
    """Process data of CSP by the library's own means."""
    rpdo, tpdo = node.rpdo[1], node.tpdo[1]
    for pdo, names in (
        (rpdo, (0x6040, 0x6060, 0x607A)),
        (tpdo, (0x6041, 0x6061, 0x6064)),
    ):
        pdo.clear()
        for index in names:
            pdo.add_variable(index)
        pdo.trans_type, pdo.enabled = 1, True
    node.pdo.save()
    node.setup_402_state_machine()
