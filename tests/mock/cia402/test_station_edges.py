"""Controlwords that stand for less than a step of the drives: edges are seen all the same."""

from __future__ import annotations

import pytest

from tests.support.can_station_parts import PP, Desk

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
