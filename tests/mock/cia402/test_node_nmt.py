"""NMT of the mock drive: the state table, boot-up, both resets."""

from __future__ import annotations

import canopen
import pytest

from hil_mock_robot.cia402.keys import key
from hil_mock_robot.cia402.node import NmtState
from tests.support.can_node_parts import (
    HEARTBEAT,
    NODE,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Bench,
)

STATES = {
    START: NmtState.OPERATIONAL,
    STOP: NmtState.STOPPED,
    PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}


@pytest.mark.parametrize("first", STATES)
@pytest.mark.parametrize("then", STATES)
def test_every_state_leads_to_every_other(first, then):
    bench = Bench()
    bench.command(first)
    bench.command(then)
    assert bench.node.nmt.state == STATES[then].name.replace("_", "-")


@pytest.mark.parametrize("code", [0, 3, 80, 96, 127, 131, 255])
def test_unknown_commands_change_nothing(code):
    bench = Bench()
    bench.command(START)
    bench.told.clear()
    bench.command(code)
    assert bench.node.nmt.state == "OPERATIONAL"
    assert bench.told == []


@pytest.mark.parametrize(("node", "heard"), [(NODE, True), (0, True), (NODE + 1, False)])
def test_commands_are_for_one_node_or_all(node, heard):
    bench = Bench()
    bench.command(START, node)
    assert (bench.node.nmt.state == "OPERATIONAL") is heard


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x03\x00"])
def test_a_command_of_another_length_is_none(data):
    bench = Bench()
    bench.node.heard(0, data)
    assert bench.node.nmt.state == "PRE-OPERATIONAL"


def test_power_on_is_a_boot_up_message_and_then_pre_operational():
    bench = Bench()
    assert bench.sent == [(HEARTBEAT, b"\x00")]
    assert bench.node.nmt.state == "PRE-OPERATIONAL"


def test_the_drive_is_told_of_each_new_state_once():
    bench = Bench()
    for code in (START, START, STOP):
        bench.command(code)
    assert bench.told == [("nmt_changed", NmtState.OPERATIONAL), ("nmt_changed", NmtState.STOPPED)]


def test_a_start_that_takes_time_is_over_after_it():
    bench = Bench(boot_s=0.5)
    bench.node.ticked(0.49)
    bench.command(START)
    assert bench.sent == []
    bench.node.ticked(0.5)
    assert bench.sent == [(HEARTBEAT, b"\x00")]
    assert bench.node.nmt.state == "PRE-OPERATIONAL"


def test_resetting_the_node_brings_back_all_defaults():
    bench = Bench()
    bench.map(1, [0x6064_0020], transmit=True)
    bench.write(0x1017, 0, 100, 2)
    bench.write(0x605A, 0, 6, 2)
    bench.write(0x607A, 0, 5, 4)
    bench.node.emergency(0x2310)
    bench.taken()
    bench.command(RESET_NODE)
    assert bench.taken() == [(HEARTBEAT, b"\x00")]
    assert bench.read(0x1A00, 1) == 0x6041_0010
    assert [bench.read(0x1017), bench.read(0x605A), bench.read(0x607A)] == [0, 2, 0]
    assert [bench.read(0x1001), bench.read(0x603F), bench.read(0x1003)] == [0, 0, 0]
    assert ("booted", True) in bench.told


def test_resetting_communication_leaves_the_drives_own_objects_and_errors():
    bench = Bench()
    bench.map(1, [0x6064_0020], transmit=True)
    bench.write(0x605A, 0, 6, 2)
    bench.node.emergency(0x2310)
    bench.command(RESET_COMMUNICATION)
    assert bench.read(0x1A00, 1) == 0x6041_0010
    assert bench.read(0x605A) == 6
    assert [bench.read(0x603F), bench.read(0x1003, 1)] == [0x2310, 0x2310]
    assert ("booted", False) in bench.told


@pytest.mark.parametrize("code", [RESET_NODE, RESET_COMMUNICATION])
def test_what_is_measured_and_what_hangs_at_the_flange_stay_through_a_reset(code):
    bench = Bench()
    bench.registers[key(0x6064)] = 4711
    bench.remote.sdo.download(0x2100, 1, b"\x00\x00\x00\x40")
    bench.command(code)
    assert bench.read(0x6064) == 4711
    assert bench.remote.sdo.upload(0x2100, 1) == b"\x00\x00\x00\x40"


def test_after_a_reset_pdos_go_by_the_defaults_again():
    bench = Bench()
    bench.map(1, [0x6064_0020], transmit=True)
    bench.operational()
    bench.command(RESET_NODE)
    bench.operational()
    bench.node.synced()
    bench.registers[key(0x6041)] = 0x40
    bench.node.ticked(0.1)
    assert bench.taken() == [(0x180 + NODE, b"\x40\x00")]


@pytest.mark.parametrize("code", [STOP, PRE_OPERATIONAL])
def test_pdos_are_exchanged_in_operational_only(code):
    bench = Bench()
    bench.map(1, [0x6041_0010], transmit=True)
    bench.map(1, [0x6040_0010], transmit=False)
    bench.operational()
    bench.command(code)
    bench.node.heard(0x200 + NODE, b"\x06\x00")
    bench.node.synced()
    bench.node.ticked(1.0)
    assert bench.taken() == []
    assert bench.registers[key(0x6040)] == 0


def test_canopens_own_master_follows_boot_up_and_heartbeats():
    bench = Bench()
    master: canopen.nmt.NmtMaster = bench.remote.nmt
    assert master.state == "PRE-OPERATIONAL"
    bench.write(0x1017, 0, 10, 2)
    master.state = "OPERATIONAL"
    assert bench.node.nmt.state == "OPERATIONAL"
    bench.node.ticked(0.01)
    assert master.state == "OPERATIONAL"
