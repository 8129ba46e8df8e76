"""CANopen tools that know nothing of us, against the mock drives: `canopen` and its profile 402."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from hil.arms import load_arm
from hil_mock_robot.cia402.mock import HostedMock, mock_on_virtual_bus

pytestmark = pytest.mark.wire

AXIS = 6
ARM = load_arm("lab6")
COUNTS = float(ARM.gear_ratio[AXIS - 1]) * 2**20 / (2 * math.pi)
PERIOD_S = 0.008
_numbers = itertools.count(1)


@pytest.fixture
def tools() -> Iterator[tuple[HostedMock, canopen.Network]]:
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
            time.sleep(PERIOD_S)

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
    node.sdo[0x60C2][1].raw, node.sdo[0x60C2][2].raw = round(PERIOD_S * 1000), -3
    node.nmt.state = "OPERATIONAL"
    with cyclic(network, node):
        node.op_mode = "CYCLIC SYNCHRONOUS POSITION"
        start = node.sdo[0x6064].raw
        node.rpdo[1]["Target position"].raw = start
        node.state = "OPERATION ENABLED"
        steps = 60
        for k in range(1, steps + 1):
            way = 0.1 * (1 - math.cos(math.pi * k / steps)) / 2
            node.rpdo[1]["Target position"].raw = start + round(way * COUNTS)
            time.sleep(PERIOD_S)
        time.sleep(0.2)
        assert node.state == "OPERATION ENABLED"
        assert node.tpdo[1]["Position actual value"].raw - start == pytest.approx(
            0.1 * COUNTS, rel=0.05
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
