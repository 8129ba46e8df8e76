"""The mock drive as a node of CANopen: NMT, heartbeats, errors, and tools that talk to it."""

from __future__ import annotations

import struct
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
from hil_mock_robot.cia402.node import MockNode, NmtState
from tests.support.can_node_parts import (
    EMERGENCY,
    HEARTBEAT,
    NODE,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    SYNC,
    Bench,
    dictionary_of,
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


# Heartbeats of the mock drive by the device's clock, and its watch over the master's.


MASTER = 127
HEARTBEAT_LOST = 0x8130


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
        ("nmt_changed", NmtState.PRE_OPERATIONAL),
    ]


def test_a_watch_that_is_switched_off_misses_nobody():
    bench = watching()
    beat(bench, 1.0)
    bench.write(0x1016, 1, 0, 4)
    bench.node.ticked(5.0)
    assert not lost(bench)


def test_a_watch_that_a_reset_has_ended_misses_nobody():
    bench = watching()
    beat(bench, 1.0)
    bench.command(RESET_COMMUNICATION)
    bench.told.clear()
    bench.node.ticked(5.0)
    assert not lost(bench)


# EMCY of the mock drive, its error register and its history of errors.


OVERCURRENT, OVERVOLTAGE, FOLLOWING = 0x2310, 0x3210, 0x8611
NO_DATA = 0x0800_0024


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.taken()
    return made


def emergencies(bench: Bench) -> list[tuple[int, int]]:
    return [struct.unpack_from("<HB", data) for can_id, data in bench.taken()
            if can_id == EMERGENCY]  # fmt: skip


def history(bench: Bench) -> list[int]:
    return [bench.read(0x1003, sub) for sub in range(1, bench.read(0x1003) + 1)]


@pytest.mark.parametrize(
    ("code", "register"),
    [
        (0x1000, 0x01), (OVERCURRENT, 0x03), (0x2320, 0x03), (OVERVOLTAGE, 0x05), (0x3220, 0x05),
        (0x4310, 0x09), (0x5000, 0x01), (0x6320, 0x01), (0x7305, 0x21), (0x8130, 0x11),
        (0x8210, 0x11), (0x8250, 0x11), (0x8700, 0x21), (FOLLOWING, 0x21), (0x8400, 0x21),
        (0x7121, 0x21), (0xFF01, 0x81),
    ],
)  # fmt: skip
def test_an_error_sets_the_bits_of_its_kind(bench, code, register):
    bench.node.emergency(code)
    assert emergencies(bench) == [(code, register)]
    assert bench.read(0x1001) == register
    assert bench.read(0x603F) == code


def test_the_message_has_eight_bytes_with_the_makers_own(bench):
    bench.node.emergency(OVERCURRENT, data=b"abc")
    assert bench.taken() == [(EMERGENCY, b"\x10\x23\x03abc\x00\x00")]


def test_who_reports_an_error_may_say_what_it_sets(bench):
    bench.node.emergency(OVERCURRENT, 0x20)
    assert emergencies(bench) == [(OVERCURRENT, 0x21)]


def test_an_error_that_is_there_is_not_told_again(bench):
    bench.node.emergency(OVERCURRENT)
    bench.node.emergency(OVERCURRENT)
    assert len(emergencies(bench)) == 1
    assert history(bench) == [OVERCURRENT]


def test_errors_add_up_in_the_register_and_go_one_by_one(bench):
    bench.node.emergency(OVERCURRENT)
    bench.node.emergency(OVERVOLTAGE)
    bench.node.recovered(OVERCURRENT)
    bench.node.recovered(OVERVOLTAGE)
    assert emergencies(bench) == [(OVERCURRENT, 3), (OVERVOLTAGE, 7), (0, 5), (0, 0)]


def test_code_0_says_that_nothing_is_wrong_any_more(bench):
    bench.node.emergency(OVERCURRENT)
    bench.node.emergency(OVERVOLTAGE)
    bench.taken()
    bench.node.emergency(0)
    assert emergencies(bench) == [(0, 0)]
    assert bench.read(0x1001) == 0


def test_nothing_is_told_when_nothing_was_wrong(bench):
    bench.node.emergency(0)
    bench.node.recovered(OVERCURRENT)
    assert emergencies(bench) == []


def test_an_error_may_come_again_once_it_was_gone(bench):
    for code in (FOLLOWING, 0, FOLLOWING):
        bench.node.emergency(code)
    assert emergencies(bench) == [(FOLLOWING, 0x21), (0, 0), (FOLLOWING, 0x21)]


def test_the_history_has_the_newest_first_and_eight_at_most(bench):
    codes = [0xFF00 + i for i in range(10)]
    for code in codes:
        bench.node.emergency(code)
    assert history(bench) == codes[:1:-1]


def test_writing_0_to_its_number_clears_the_history(bench):
    bench.node.emergency(OVERCURRENT)
    bench.write(0x1003, 0, 0, 1)
    assert bench.read(0x1003) == 0
    assert bench.read(0x1001) == 3
    bench.node.emergency(OVERVOLTAGE)
    assert history(bench) == [OVERVOLTAGE]


def test_the_history_has_no_data_beyond_its_number(bench):
    bench.node.emergency(OVERCURRENT)
    assert bench.read(0x1003, 1) == OVERCURRENT
    for sub in (2, 8):
        with pytest.raises(canopen.SdoAbortedError) as refused:
            bench.read(0x1003, sub)
        assert refused.value.code == NO_DATA


def test_a_stopped_node_sends_no_emergency_but_keeps_the_error(bench):
    bench.command(STOP)
    bench.node.emergency(OVERCURRENT)
    assert emergencies(bench) == []
    assert bench.node.errors.active == (OVERCURRENT,)


def test_1014h_switches_emergencies_off_and_gives_them_another_identifier(bench):
    bench.write(0x1014, 0, 0x8000_0000 | EMERGENCY, 4)
    bench.node.emergency(OVERCURRENT)
    assert bench.taken() == []
    bench.write(0x1014, 0, 0x0F0, 4)
    bench.node.emergency(OVERVOLTAGE)
    assert [can_id for can_id, _ in bench.taken()] == [0x0F0]


def test_a_simulated_error_is_told(bench):
    bench.write(0x2101, 0, FOLLOWING, 2)
    assert emergencies(bench) == [(FOLLOWING, 0x21)]
    assert bench.aborts(0x2101, 0, 0, 2) == 0x0609_0030


def test_a_lost_heartbeat_is_over_when_it_comes_back_unless_the_drive_is_in_fault(bench):
    bench.write(0x1016, 1, 127 << 16 | 100, 4)
    for statusword, ends in ((0x0640, True), (0x0618, False)):
        bench.registers[0x6041 << 8] = statusword
        at_s = 10.0 + statusword
        bench.node.ticked(at_s)
        bench.node.heard(0x77F, b"\x05")
        bench.node.ticked(at_s + 0.2)
        bench.node.heard(0x77F, b"\x05")
        assert emergencies(bench) == [(0x8130, 0x11)] + [(0, 0)] * ends


def test_canopens_own_consumer_follows_errors_and_their_end(bench):
    bench.node.emergency(FOLLOWING)
    assert [error.code for error in bench.remote.emcy.active] == [FOLLOWING]
    bench.node.emergency(0)
    assert bench.remote.emcy.active == []


# The mock drive on a bus of python-can, with what `canopen` itself brings for such drives.


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
