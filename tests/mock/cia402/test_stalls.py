"""A master that a busy computer holds up in mid-motion: the arm goes on, or stops, never jumps."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
import pytest

from hil.arms import load_arm
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.power import State
from tests.support.can_drive_parts import CSP, CST, CSV, OneDrive
from tests.support.can_master import Master
from tests.support.mock_servers import MockCan, mock_can

ARM = load_arm("lab6")
COUNTS = ARM.gear_ratio * 2**20 / (2 * math.pi)
ENABLE = 0x0F
PERIOD_S, CYCLES, STALLED_AT = 0.004, 250, 125
WAY_RAD = 0.3
FREE, REAL_TIME = 0.0, PERIOD_S
FASTEST = WAY_RAD * math.pi / 2 / (CYCLES * PERIOD_S)


@pytest.fixture(scope="module")
def drives() -> Iterator[MockCan]:
    with mock_can("--profile", "ideal") as mock:
        yield mock


@pytest.fixture
def master(drives: MockCan) -> Iterator[Master]:
    with drives.bus() as bus:
        master = Master(bus)
        master.reset()
        drives.wait_until(lambda state: set(state["states"]) == {"SWITCH_ON_DISABLED"})
        master.map()
        yield master
        master.reset()


def targets(held: list[int], k: int) -> list[int]:
    way = way_from(held) * (1 - math.cos(math.pi * min(k, CYCLES) / CYCLES)) / 2
    return [at + round(way * counts) for at, counts in zip(held, COUNTS, strict=True)]


def way_from(held: list[int]) -> float:
    """To and fro: all axes stay far from their limits [rad]."""
    return -WAY_RAD if held[0] > 0.1 * COUNTS[0] else WAY_RAD


def swing(master: Master, period_s: float, stalled_s: float) -> np.ndarray:
    """(N, 6) position of all axes at each SYNC [rad]; the master stalls half-way."""
    held, seen = master.enable(), []
    due = then = time.monotonic()
    for k in range(1, CYCLES + 20):
        if k == STALLED_AT:
            time.sleep(stalled_s)
            due = time.monotonic()
        if (now := time.monotonic()) - then > max(1.25 * stalled_s, 0.06):
            pytest.skip(f"this computer held the test itself up for {now - then:.2f} s")
        then = now
        assert master.cycle(ENABLE, targets(held, k))
        seen.append(np.abs(np.array(master.position) - held) / COUNTS)
        due += period_s
        time.sleep(max(0.0, due - time.monotonic()))
    return np.array(seen)


def largest_jumps(q: np.ndarray) -> tuple[float, float]:
    """Of the velocity [rad/s], and of its change within a period [rad/s], of any axis."""
    qd = np.diff(q, axis=0) / PERIOD_S
    return float(np.abs(qd).max()), float(np.abs(np.diff(qd, axis=0)).max())


@pytest.mark.wire
@pytest.mark.parametrize("period_s", [FREE, REAL_TIME], ids=["free", "real time"])
@pytest.mark.parametrize("stalled_s", [0.05, 0.15])
def test_a_master_that_stalls_for_a_while_goes_on_where_it_was(
    master: Master, drives: MockCan, period_s: float, stalled_s: float
) -> None:
    seen = swing(master, period_s, stalled_s)
    fastest, change = largest_jumps(seen)
    assert fastest < 1.05 * FASTEST
    assert change < 0.1  # noise of the encoders makes up to 0.055
    assert seen[-1] == pytest.approx(np.full(6, WAY_RAD), abs=2e-3)
    assert drives.state()["states"] == ["OPERATION_ENABLED"] * 6
    assert master.emergencies == []


@pytest.mark.wire
def test_one_that_stalls_for_longer_finds_the_arm_stopping_and_nothing_jumps(
    master: Master, drives: MockCan
) -> None:
    fastest, change = largest_jumps(swing(master, REAL_TIME, 0.25)[STALLED_AT:])
    assert fastest < 1.05 * FASTEST
    assert change < 0.1
    assert set(master.emergencies) == {(node, 0x8700) for node in range(1, 7)}
    drives.wait_until(lambda state: state["states"] == ["FAULT"] * 6)


@pytest.mark.wire
def test_one_that_stalls_for_ever_leaves_an_arm_that_has_stopped(
    master: Master, drives: MockCan
) -> None:
    held = master.enable()
    for k in range(1, STALLED_AT):
        master.cycle(ENABLE, targets(held, k))
    drives.wait_until(lambda state: state["states"] == ["FAULT"] * 6)
    while master.hear(0.05) is not None:
        pass
    assert set(master.emergencies) == {(node, 0x8700) for node in range(1, 7)}


def moving(mode: int) -> OneDrive:
    """At 0.5 rad/s."""
    one = OneDrive().enabled(mode)
    one.set(keys.TARGET_VELOCITY, round(0.5 * one.counts))
    if mode == CST:
        one.qd = 0.5
        one.cycles(1)
        return one
    for _ in range(20):
        one.registers[keys.TARGET_POSITION] += round(0.5 * PERIOD_S * one.counts)
        one.cycles(1)
    return one


def own_timer(one: OneDrive) -> None:
    one.cycles(1, synced=False, steps=10)


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_sync_that_is_back_after_the_set_point_left_its_path_is_an_error(mode: int) -> None:
    one = moving(mode)
    own_timer(one)
    assert one.state is State.OPERATION_ENABLED
    one.cycles(1)
    assert [code for code, _ in one.emergencies] == [0x8700]
    one.until(State.FAULT)


@pytest.mark.parametrize("mode", [CSP, CSV])
def test_it_comes_to_rest_along_a_ramp(mode: int) -> None:
    one = moving(mode)
    one.demands.clear()
    own_timer(one)
    one.registers[keys.TARGET_POSITION] += round(0.1 * one.counts)
    one.until(State.FAULT)
    rows = np.concatenate([demand.setpoints for demand in one.demands if not demand.braked])
    assert np.abs(np.diff(rows[:, 1])).max() <= 1.01e-3 * ARM.qdd_max[1] + 1e-9
    assert np.abs(np.diff(rows[:, 0])).max() <= 0.501e-3


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_sync_that_is_back_while_the_axis_stands_goes_on(mode: int) -> None:
    one = OneDrive().enabled(mode)
    own_timer(one)
    one.cycles(5)
    assert one.state is State.OPERATION_ENABLED
    assert one.emergencies == []


@pytest.mark.parametrize("mode", [CSP, CSV])
def test_one_missed_sync_is_put_up_with(mode: int) -> None:
    one = moving(mode)
    one.cycles(1, synced=False)
    one.cycles(1)
    assert one.state is State.OPERATION_ENABLED
