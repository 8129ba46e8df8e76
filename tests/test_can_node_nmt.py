"""NMT of the mock drive: the state table, boot-up, both resets; heartbeats by the device's clock."""

from __future__ import annotations

import canopen
import pytest
from can_node_parts import (
    HEARTBEAT,
    NODE,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Bench,
)

from hil_mock_robot.cia402.contracts import key
from hil_mock_robot.cia402.nmt import State

STATES = {START: State.OPERATIONAL, STOP: State.STOPPED, PRE_OPERATIONAL: State.PRE_OPERATIONAL}
MASTER = 127
HEARTBEAT_LOST = 0x8130


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
    assert bench.told == [("nmt_changed", State.OPERATIONAL), ("nmt_changed", State.STOPPED)]


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


def heartbeats(
    bench: Bench, from_ms: int, until_ms: int, step_ms: int = 1
) -> list[tuple[int, int]]:
    """When they came, and the state in them."""
    seen = []
    for ms in range(from_ms, until_ms, step_ms):
        bench.node.ticked(ms / 1000)
        seen += [(ms, data[0]) for can_id, data in bench.taken() if can_id == HEARTBEAT]
    return seen


def test_heartbeats_begin_when_they_are_asked_for_and_keep_their_period():
    bench = Bench()
    assert heartbeats(bench, 0, 100) == [(0, 0)]
    bench.node.ticked(0.1)
    bench.write(0x1017, 0, 30, 2)
    assert heartbeats(bench, 100, 170) == [(100, 127), (130, 127), (160, 127)]


def test_heartbeats_carry_the_state():
    bench = Bench()
    bench.write(0x1017, 0, 10, 2)
    bench.taken()
    seen = []
    for i, code in enumerate((START, STOP, PRE_OPERATIONAL)):
        bench.command(code)
        seen += heartbeats(bench, 10 * i, 10 * i + 1)
    assert [state for _, state in seen] == [5, 4, 127]


def test_a_slow_clock_does_not_drop_heartbeats_that_fit():
    bench = Bench()
    bench.write(0x1017, 0, 10, 2)
    bench.taken()
    assert [ms for ms, _ in heartbeats(bench, 0, 60, step_ms=4)] == [0, 12, 20, 32, 40, 52]


def test_heartbeats_end_with_a_period_of_nothing():
    bench = Bench()
    bench.write(0x1017, 0, 10, 2)
    bench.write(0x1017, 0, 0, 2)
    bench.taken()
    assert heartbeats(bench, 0, 100) == []


def watching(timeout_ms: int = 250) -> Bench:
    """Operational, with the master's heartbeat watched."""
    bench = Bench()
    bench.write(0x1016, 1, MASTER << 16 | timeout_ms, 4)
    bench.operational()
    return bench


def beat(bench: Bench, at_s: float) -> None:
    bench.node.ticked(at_s)
    bench.node.heard(0x700 + MASTER, b"\x05")


def lost(bench: Bench) -> bool:
    return ("connection_lost", HEARTBEAT_LOST) in bench.told


def test_a_master_that_was_never_heard_is_not_missed():
    bench = watching()
    bench.node.ticked(10.0)
    assert not lost(bench)


def test_a_master_that_falls_silent_is_missed_after_the_time_out():
    bench = watching()
    beat(bench, 1.0)
    bench.node.ticked(1.25)
    assert not lost(bench)
    bench.node.ticked(1.251)
    assert lost(bench)
    assert bench.read(0x603F) == HEARTBEAT_LOST


def test_a_master_that_keeps_beating_is_not_missed():
    bench = watching()
    for i in range(100):
        beat(bench, 0.2 * i)
    assert not lost(bench)


def test_other_nodes_heartbeats_do_not_count():
    bench = watching()
    beat(bench, 1.0)
    bench.node.ticked(1.2)
    bench.node.heard(0x700 + MASTER - 1, b"\x05")
    bench.node.ticked(1.3)
    assert lost(bench)


def test_a_loss_is_told_once_until_the_master_is_back():
    bench = watching()
    for at_s in (1.0, 2.0):
        beat(bench, at_s)
        bench.node.ticked(at_s + 0.3)
        bench.node.ticked(at_s + 0.6)
    assert bench.told.count(("connection_lost", HEARTBEAT_LOST)) == 2


@pytest.mark.parametrize(
    ("reaction", "state"), [(0, "PRE-OPERATIONAL"), (1, "OPERATIONAL"), (2, "STOPPED")]
)
def test_1029h_says_what_the_node_becomes_when_the_master_is_lost(reaction, state):
    bench = watching()
    bench.write(0x1029, 1, reaction, 1)
    beat(bench, 1.0)
    bench.node.ticked(1.3)
    assert bench.node.nmt.state == state


def test_the_drive_hears_of_the_loss_before_the_node_leaves_operational():
    bench = watching()
    beat(bench, 1.0)
    bench.node.ticked(1.3)
    assert bench.told == [
        ("connection_lost", HEARTBEAT_LOST),
        ("nmt_changed", State.PRE_OPERATIONAL),
    ]


def test_a_watch_that_is_switched_off_misses_nobody():
    bench = watching()
    beat(bench, 1.0)
    bench.write(0x1016, 1, 0, 4)
    bench.node.ticked(5.0)
    assert not lost(bench)


def test_canopens_own_master_follows_boot_up_and_heartbeats():
    bench = Bench()
    master: canopen.nmt.NmtMaster = bench.remote.nmt
    assert master.state == "PRE-OPERATIONAL"
    bench.write(0x1017, 0, 10, 2)
    master.state = "OPERATIONAL"
    assert bench.node.nmt.state == "OPERATIONAL"
    bench.node.ticked(0.01)
    assert master.state == "OPERATIONAL"
