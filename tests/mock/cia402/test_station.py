"""The station of the mock drives: SYNC and clock, a network that is taken away, edges, siblings."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from hil_mock_robot.cia402.axis import hermite
from hil_mock_robot.cia402.station import DeviceClock
from tests.support.can_station_parts import (
    PERIOD_S,
    PP,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Desk,
)


def per_sync(desk: Desk) -> int:
    """Steps [ms] that one SYNC brings."""
    before = desk.station.clock.steps
    desk.sync()
    return desk.station.clock.steps - before


def test_a_sync_is_4_ms_until_somebody_says_otherwise() -> None:
    assert per_sync(Desk()) == 4


def test_any_one_drive_may_be_told_the_period() -> None:
    desk = Desk()
    desk.write(3, 0x60C2, 1, "B", 10)
    assert per_sync(desk) == 10


def test_a_drive_that_is_operational_is_believed_first() -> None:
    desk = Desk()
    desk.write(1, 0x60C2, 1, "B", 10)
    desk.write(2, 0x60C2, 1, "B", 8)
    assert per_sync(desk) == 10
    desk.command(START, 2)
    assert per_sync(desk) == 8


def test_after_a_reset_the_period_is_the_default_again() -> None:
    desk = Desk()
    desk.write(1, 0x60C2, 1, "B", 1)
    assert per_sync(desk) == 1
    desk.command(RESET_NODE)
    assert per_sync(desk) == 4


def test_1006h_counts_where_60c2h_was_never_written() -> None:
    desk = Desk()
    desk.write(1, 0x1006, 0, "I", 10_000)
    assert per_sync(desk) == 10
    assert desk.unit(1).drive._axis.period_steps == 10
    desk.write(1, 0x60C2, 1, "B", 2)
    assert per_sync(desk) == 2
    assert desk.unit(1).drive._axis.period_steps == 2


@pytest.mark.thorough
def test_each_axis_interpolates_over_its_own_period() -> None:
    desk = Desk()
    desk.write(1, 0x60C2, 1, "B", 4)
    desk.write(2, 0x60C2, 1, "B", 8)
    assert [desk.unit(n).drive._axis.period_steps for n in (1, 2, 3)] == [4, 8, 4]


def test_what_is_kept_of_periods_is_bounded() -> None:
    for steps in range(1, 60):
        hermite(steps)
    assert hermite.cache_info().currsize < 30


def demands(desk: Desk, lost: int, back: int = 3) -> list[float]:
    """Demanded speeds [rad/s] after each SYNC of a motion at 1 rad/s that misses some RPDOs."""
    target = float(desk.turning(1, 1.0))
    axis, speeds = desk.unit(1).drive._axis, []
    for k in range(lost + back):
        target += axis.counts * PERIOD_S
        if k >= lost:
            desk.rpdo(1, 0x0F, round(target))
        desk.sync()
        speeds.append(axis.demand_qd)
    return speeds


@pytest.fixture
def moving() -> Desk:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    return desk


@pytest.mark.parametrize("lost", [1, 2])
def test_an_axis_goes_on_at_its_speed_where_a_set_point_or_two_are_missing(
    moving: Desk, lost: int
) -> None:
    assert demands(moving, lost) == pytest.approx([1.0] * (lost + 3), abs=0.02)


def test_it_comes_to_rest_where_more_are_missing() -> None:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    speeds = np.array(demands(desk, 60, back=0))
    assert speeds[:2] == pytest.approx(1.0, abs=0.02)
    assert (np.diff(speeds[1:]) <= 1e-9).all()
    assert speeds[-1] == 0.0
    assert desk.state(1) == "OPERATION_ENABLED"


def test_it_does_not_leave_the_position_limits_on_its_own(moving: Desk) -> None:
    target = moving.turning(1, 1.0)
    registers = moving.unit(1).registers
    registers[0x607D << 8 | 2] = target
    moving.sync(2)
    axis = moving.unit(1).drive._axis
    assert axis.raw_position(axis.demand_q) <= target + 1


def test_targets_by_sdo_are_followed_without_rpdos(moving: Desk) -> None:
    moving.sync(20)
    target = moving.position(1) + round(0.01 * moving.unit(1).drive._axis.counts)
    moving.write(1, 0x607A, 0, "i", target)
    moving.sync(100)
    axis = moving.unit(1).drive._axis
    assert axis.raw_position(axis.demand_q) == pytest.approx(target, abs=1)


def test_an_rpdo_that_waits_for_timeouts_makes_silence_an_error() -> None:
    desk = Desk()
    assert desk.write(1, 0x1400, 5, "H", 50) == 0
    desk.map(1)
    desk.enable(1)
    desk.turning(1)
    desk.sent.clear()
    desk.sync(30)
    assert 0x8250 in desk.emergencies(1)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"


# What drives do when the network is taken from them: NMT commands, resets, bus off (6007h).


COMMUNICATION, BUS_OFF = 0x8100, 0x8140
FAULT_REACTION, DISABLE_VOLTAGE, QUICK_STOP = 1, 2, 3
LEAVING = [PRE_OPERATIONAL, STOP, RESET_COMMUNICATION, RESET_NODE]


def turning(option: int, node: int = 1) -> Desk:
    desk = Desk()
    desk.map(node)
    assert desk.write(node, 0x6007, 0, "h", option) == 0
    desk.enable(node)
    desk.turning(node)
    assert desk.speed[node - 1] > 0.8
    desk.sent.clear()
    return desk


@pytest.mark.parametrize("command", LEAVING)
def test_a_drive_that_is_taken_off_stops_quickly_along_its_ramp(command: int) -> None:
    desk = turning(QUICK_STOP)
    before = desk.speed[0]
    desk.command(command, 1)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"
    desk.sync(3)
    ramp = desk.read(1, 0x6085) if command != STOP else desk.unit(1).registers[0x6085 << 8]
    slower = before - ramp / desk.unit(1).drive._axis.counts * 3 * 0.004
    assert desk.speed[0] == pytest.approx(slower, abs=0.1)
    desk.sync(150)
    assert desk.state(1) == "SWITCH_ON_DISABLED"
    assert desk.speed[0] == pytest.approx(0.0, abs=1e-3)
    assert desk.emergencies(1) == []


@pytest.mark.parametrize("command", LEAVING)
def test_6007h_1_makes_it_a_fault_of_communication(command: int) -> None:
    desk = turning(FAULT_REACTION)
    desk.command(command, 1)
    assert desk.state(1) == "FAULT_REACTION_ACTIVE"
    assert desk.emergencies(1) == ([] if command == STOP else [COMMUNICATION])
    if command != RESET_NODE:
        desk.command(PRE_OPERATIONAL, 1)
        assert desk.read(1, 0x1003, 1) == desk.read(1, 0x603F) == COMMUNICATION
        assert desk.read(1, 0x1001) == 0x11
    desk.sync(150)
    assert desk.state(1) == ("SWITCH_ON_DISABLED" if command == RESET_NODE else "FAULT")


def test_6007h_0_lets_a_drive_that_is_taken_off_go_on() -> None:
    desk = turning(0)
    desk.command(PRE_OPERATIONAL, 1)
    desk.sync(10)
    assert desk.state(1) == "OPERATION_ENABLED"


def test_a_drive_that_never_was_operational_does_not_mind_to_be_preoperational() -> None:
    desk = Desk()
    for word in (0x06, 0x07, 0x0F):
        desk.write(1, 0x6040, 0, "H", word)
    desk.command(PRE_OPERATIONAL, 1)
    desk.wait(0.1)
    assert desk.state(1) == "OPERATION_ENABLED"
    desk.command(STOP, 1)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"


def test_a_drive_without_power_obeys_the_controlword_it_was_left_with() -> None:
    desk = Desk()
    desk.map(1)
    desk.rpdo(1, 0x06)
    desk.sync(3)
    desk.command(PRE_OPERATIONAL, 1)
    assert desk.state(1) == "READY_TO_SWITCH_ON"


def test_a_node_that_is_reset_in_motion_forgets_all_but_stops_first() -> None:
    desk = turning(QUICK_STOP)
    desk.command(RESET_NODE, 1)
    assert (0x701, b"\x00") in desk.sent
    assert desk.read(1, 0x6040) == 0
    desk.write(1, 0x6040, 0, "H", 0x06)
    desk.sync(2)
    assert desk.state(1) == "QUICK_STOP_ACTIVE"
    desk.sync(150)
    assert desk.state(1) == "READY_TO_SWITCH_ON"


def test_a_node_that_is_reset_at_rest_has_started_anew_at_once() -> None:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    desk.sync(50)
    desk.command(RESET_NODE, 1)
    assert desk.state(1) == "NOT_READY_TO_SWITCH_ON"


@pytest.mark.parametrize("option", [FAULT_REACTION, QUICK_STOP])
def test_bus_off_is_told_when_the_drive_is_back(option: int) -> None:
    desk = turning(option)
    desk.mock.requests.answer({"do": "fault", "kind": "bus_off", "axis": 1})
    desk.sync(20)
    assert desk.emergencies(1) == []
    desk.mock.requests.answer({"do": "clear"})
    assert desk.emergencies(1)[0] == BUS_OFF
    assert desk.unit(1).node.nmt.state == "PRE-OPERATIONAL"  # 1029h:1 = 0
    assert desk.read(1, 0x1003) == 1
    assert desk.read(1, 0x1003, 1) == BUS_OFF
    in_fault = option == FAULT_REACTION
    assert desk.read(1, 0x1001) == (0x11 if in_fault else 0)
    desk.sync(150)
    assert desk.state(1) == ("FAULT" if in_fault else "SWITCH_ON_DISABLED")


def test_1029h_1_keeps_a_drive_operational_through_bus_off() -> None:
    desk = Desk()
    desk.write(1, 0x1029, 1, "B", 1)
    desk.command(START)
    desk.mock.requests.answer({"do": "fault", "kind": "bus_off", "axis": 1})
    assert desk.unit(1).node.nmt.state == "OPERATIONAL"


def test_an_injected_following_error_shows_where_it_is_looked_for() -> None:
    desk = Desk()
    desk.map(1)
    desk.enable(1)
    desk.mock.requests.answer({"do": "fault", "kind": "following_error", "axis": 1})
    desk.sync(2)
    assert desk.read(1, 0x6041) & 0x2000
    assert abs(desk.unit(1).registers[0x60F4 << 8]) > desk.read(1, 0x6065)


# Controlwords that stand for less than a step of the drives: edges are seen all the same.


EVENT_DRIVEN = 255
FAULT_RESET, NEW_TARGET = 0x80, 0x1F


def test_a_fault_reset_by_an_event_driven_rpdo_counts_however_short_it_is() -> None:
    desk = Desk()
    desk.map(1, type_=EVENT_DRIVEN)
    desk.unit(1).drive.fault(0x7305)
    desk.wait(0.05)
    assert desk.state(1) == "FAULT"
    desk.rpdo(1, FAULT_RESET)
    desk.rpdo(1, 0x06)
    desk.wait(0.05)
    assert desk.state(1) == "READY_TO_SWITCH_ON"


def test_a_new_target_by_an_event_driven_rpdo_counts_however_short_it_is() -> None:
    desk = Desk()
    desk.map(1, type_=EVENT_DRIVEN)
    for word in (0x06, 0x07, 0x0F):
        desk.rpdo(1, word, mode=PP)
        desk.wait(0.05)
    target = desk.position(1) + round(0.2 * desk.unit(1).drive._axis.counts)
    desk.rpdo(1, NEW_TARGET, target, PP)
    desk.rpdo(1, 0x0F, target, PP)
    desk.wait(4.0)
    assert desk.position(1) == pytest.approx(target, abs=2e-3 * desk.unit(1).drive._axis.counts)


def test_a_controlword_that_stands_for_one_sync_without_a_step_counts() -> None:
    desk = Desk()
    desk.map(1)
    desk.sync(3)
    desk.unit(1).drive.fault(0x7305)
    desk.sync(3)
    desk.rpdo(1, FAULT_RESET)
    desk.unit(1).node.synced()  # a SYNC in which no step of the drives begins
    desk.rpdo(1, 0x06)
    desk.sync(2)
    assert desk.state(1) == "READY_TO_SWITCH_ON"


def test_what_becomes_of_a_controlword_is_told_with_the_next_sync() -> None:
    desk = Desk()
    desk.map(1)
    desk.sync(3)
    desk.rpdo(1, 0x06)
    desk.sent.clear()
    desk.sync(2)
    told = [data[0] & 0x6F for can_id, data in desk.sent if can_id == 0x181]
    assert told == [0x40, 0x21]


# Drives of one mock hear each other on the bus, as nodes on a wire do.


HEARTBEAT_LOST = 0x8130


def test_a_drive_watches_the_heartbeat_of_another_one() -> None:
    desk = Desk()
    desk.write(2, 0x1017, 0, "H", 50)
    desk.write(1, 0x1016, 1, "I", 2 << 16 | 250)
    desk.sync(200)
    assert desk.emergencies(1) == []
    desk.mock.requests.answer({"do": "fault", "kind": "heartbeat_loss", "axis": 2})
    desk.sync(100)
    assert desk.emergencies(1) == [HEARTBEAT_LOST]


def test_a_tpdo_of_one_drive_may_be_an_rpdo_of_another() -> None:
    desk = Desk()
    target, position = 0x607A_0020, 0x6064_0020
    for node, index, cob_id, entry in ((2, 0x1802, 0x382, position), (5, 0x1402, 0x382, target)):
        for step in (
            (index, 1, "I", cob_id | 1 << 31), (index + 0x200, 0, "B", 0),
            (index + 0x200, 1, "I", entry), (index + 0x200, 0, "B", 1), (index, 2, "B", 1),
            (index, 1, "I", cob_id),
        ):  # fmt: skip
            assert desk.write(node, *step) == 0
    desk.command(START)
    desk.sync(2)
    sent = [data for can_id, data in desk.sent if can_id == 0x382]
    assert desk.unit(5).registers[0x607A << 8] == struct.unpack("<i", sent[0])[0] != 0


def test_a_drive_does_not_hear_itself() -> None:
    desk = Desk()
    desk.write(1, 0x1017, 0, "H", 50)
    desk.write(1, 0x1016, 1, "I", 1 << 16 | 250)
    desk.sync(100)
    desk.write(1, 0x1017, 0, "H", 0)
    desk.sync(100)
    assert desk.emergencies(1) == []


def test_a_drive_that_is_off_the_bus_hears_nobody() -> None:
    desk = Desk()
    desk.write(2, 0x1017, 0, "H", 50)
    desk.write(1, 0x1016, 1, "I", 2 << 16 | 250)
    desk.sync(50)
    desk.mock.requests.answer({"do": "fault", "kind": "bus_off", "axis": 1})
    desk.sync(100)
    assert desk.read_registers(1, 0x1003, 1) == HEARTBEAT_LOST


# Device time of the mock drives: by SYNC while there is one, by the drives' own timer else.


def test_every_sync_is_a_period_however_long_it_took_on_the_wall() -> None:
    clock = DeviceClock(0.0)
    assert [clock.sync(now, 0.004) for now in (0.0, 0.0001, 0.019, 0.0192)] == [4, 4, 4, 4]
    assert clock.device_s == pytest.approx(0.016)


def test_periods_of_no_whole_millisecond_add_up() -> None:
    clock = DeviceClock(0.0)
    steps = [clock.sync(0.002 * k, 0.0025) for k in range(1, 9)]
    assert sum(steps) == 20
    assert max(steps) == 3
    assert sum(clock.sync(1.0, 0.0001) for _ in range(100)) == 10


def test_the_own_timer_waits_for_two_periods_and_its_patience() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    assert clock.own(1.1999) == 0
    assert clock.synced
    assert clock.own(1.2051) == 5
    assert not clock.synced
    slow = DeviceClock(0.0)
    slow.sync(1.0, 0.2)
    assert slow.own(1.399) == 0
    assert slow.own(1.4031) == 3


def test_time_in_which_nobody_looked_for_sync_does_not_count() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    clock.slept(0.5)
    assert clock.own(1.6999) == 0
    assert clock.own(1.7021) == 2


def test_the_own_timer_takes_over_soon_when_no_drive_is_operational() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    clock.idle()
    assert clock.own(1.0199) == 0
    assert clock.own(1.0251) == 5


def test_a_clock_that_never_saw_a_sync_goes_as_the_wall() -> None:
    clock = DeviceClock(5.0)
    assert sum(clock.own(5.0 + 0.0007 * k) for k in range(1, 101)) == 70
    assert clock.device_s == pytest.approx(0.07)


def test_sync_takes_over_again_and_the_silence_is_not_made_up_for() -> None:
    clock = DeviceClock(0.0)
    clock.sync(1.0, 0.004)
    clock.own(1.2101)
    assert clock.steps == 4 + 10
    assert clock.sync(1.211, 0.004) == 4
    assert clock.synced
    assert clock.own(1.4) == 0


def test_a_computer_that_slept_does_not_let_time_race() -> None:
    clock = DeviceClock(0.0)
    assert clock.own(100.0) == 100
    assert clock.own(100.0) == 0
    assert clock.own(100.003) == 3


def test_the_wait_is_until_the_own_timer_has_work() -> None:
    clock = DeviceClock(0.0)
    assert clock.wait_s(0.001, 4) == pytest.approx(0.003)
    clock.sync(1.0, 0.004)
    assert clock.wait_s(1.0, 1) == pytest.approx(0.201)
    assert clock.wait_s(3.0, 1) == 0.0
