"""The mock drive on a bus of python-can, with what `canopen` itself brings for such drives."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import can
import canopen
import pytest
from canopen.profiles.p402 import BaseNode402

from hil.arms import load_arm
from hil_mock_robot.cia402.dictionary import registers_of
from hil_mock_robot.cia402.keys import key
from hil_mock_robot.cia402.node import MockNode
from tests.support.can_node_parts import NODE, SYNC, Bench, dictionary_of

TICK_S = 0.002


class OnBus:
    """A node that a thread serves on a virtual bus."""

    def __init__(self, channel: str) -> None:
        self._bus = can.Bus(channel=channel, interface="virtual")
        self.registers = registers_of(load_arm("lab6"), NODE - 1)
        self.node = MockNode(NODE, self.registers, self._send)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._ends.set()
        self._thread.join()
        self._bus.shutdown()

    def _send(self, can_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def _run(self) -> None:
        self.node.boot()
        while not self._ends.is_set():
            message = self._bus.recv(TICK_S)
            if message is not None and message.arbitration_id == SYNC:
                self.node.synced()
            elif message is not None:
                self.node.heard(message.arbitration_id, bytes(message.data))
            self.node.ticked(time.monotonic())


@contextmanager
def on_bus() -> Iterator[tuple[OnBus, canopen.Network]]:
    channel = str(uuid4())
    network = canopen.Network()
    network.connect(channel=channel, interface="virtual")
    drive = OnBus(channel)
    try:
        yield drive, network
    finally:
        network.disconnect()
        drive.close()


def until(condition, patience_s: float = 2.0) -> bool:
    end_s = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.001)
    return True


def test_canopen_reads_and_saves_the_pdo_configuration():
    bench = Bench()
    remote = bench.remote
    remote.pdo.read()
    assert [variable.index for variable in remote.tpdo[3].map] == [0x6041, 0x6064]
    remote.tpdo[1].clear()
    for index in (0x6041, 0x6064, 0x6061):
        remote.tpdo[1].add_variable(index)
    remote.tpdo[1].trans_type, remote.tpdo[1].enabled = 1, True
    remote.rpdo[2].clear()
    remote.rpdo[2].add_variable(0x607A)
    remote.rpdo[2].trans_type, remote.rpdo[2].enabled = 1, True
    remote.pdo.save()
    bench.operational()
    remote.rpdo[2]["Target position"].raw = -77
    remote.rpdo[2].transmit()
    bench.registers[key(0x6064)] = 123456
    bench.node.synced()
    assert remote.tpdo[1]["Position actual value"].raw == 123456
    assert bench.registers[key(0x607A)] == -77
    assert remote.rpdo[1].cob_id == 0x200 + NODE


def test_what_canopen_saves_can_be_saved_again():
    bench = Bench()
    before = dict(bench.registers)
    bench.remote.pdo.read()
    bench.remote.pdo.save()
    assert bench.registers == before


@pytest.mark.wire
def test_sdo_nmt_emergency_and_heartbeat_on_a_bus():
    with on_bus() as (drive, network):
        remote = network.add_node(canopen.RemoteNode(NODE, dictionary_of(NODE - 1)))
        remote.sdo.RESPONSE_TIMEOUT = 2.0
        assert remote.sdo[0x1000].raw == 0x20192
        remote.sdo[0x1017].raw = 20
        remote.nmt.state = "OPERATIONAL"
        remote.nmt.wait_for_heartbeat(2.0)
        assert until(lambda: remote.nmt.state == "OPERATIONAL")
        remote.sdo[0x2101].raw = 0x8611
        assert until(lambda: [error.code for error in remote.emcy.log] == [0x8611])
        remote.nmt.send_command(129)
        remote.nmt.wait_for_bootup(2.0)
        assert drive.registers[key(0x1017)] == 0


@pytest.mark.wire
def test_canopens_profile_402_finds_its_objects_and_moves_the_controlword():
    with on_bus() as (drive, network):
        node = network.add_node(BaseNode402(NODE, dictionary_of(NODE - 1)))
        node.sdo.RESPONSE_TIMEOUT = 2.0
        node.nmt.state = "PRE-OPERATIONAL"
        node.setup_402_state_machine()
        node.nmt.state = "OPERATIONAL"
        node.controlword = 0x06
        assert until(lambda: drive.registers[key(0x6040)] == 0x06)
        drive.registers[key(0x6041)] = 0x0231
        assert until(lambda: node.state == "READY TO SWITCH ON")
        assert node.is_op_mode_supported("CYCLIC SYNCHRONOUS POSITION")
        assert not node.is_op_mode_supported("PROFILED TORQUE")


@pytest.mark.wire
def test_a_tool_without_a_file_loads_the_eds_from_the_drive():
    with on_bus() as (_, network):
        remote = network.add_node(NODE, upload_eds=True)
        assert remote.object_dictionary[0x6041].name == "Statusword"
