"""Heartbeats of the mock drive by the device's clock, and its watch over the master's."""

from __future__ import annotations

import pytest

from hil_mock_robot.cia402.node import NmtState
from tests.support.can_node_parts import (
    HEARTBEAT,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    START,
    STOP,
    Bench,
)

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
