"""The thread of the core, with drives that are always on time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from hil.core.errors import CommandRefused, RobotConnectionError, RobotFault, RobotTimeout
from hil_drivers.cia402.bus import Emergency, News, Outputs
from hil_drivers.cia402.core import Core
from hil_drivers.cia402.gains import Gains
from hil_drivers.cia402.mapping import ALL_MODES
from hil_drivers.cia402.player import Player
from hil_drivers.cia402.rows import INCOMPLETE, STALLED
from hil_drivers.cia402.supervisor import Phase, Supervisor
from hil_drivers.cia402.timing import Schedule
from hil_drivers.cia402.track import Track
from tests.support.cia402_parts import CSP, CST, ENABLED, FAULT, OFF, PERIOD_S, READY, FakeDrives

N = 3
RAD = 1e-6
GAINS = Gains(kp=(0.0,) * N, kd=(0.0,) * N, limit=(1000.0,) * N, kv=(0.0,) * N)
QUICK_STOP = [0x02] * N


class Station:
    """A core without deadlines, and its drives."""

    def __init__(self, kept_s: float = 60.0, wall_period_s: float = 0.0) -> None:
        self.drives, self.outputs = FakeDrives(N), Outputs.idle(N)
        self.drives.slow_s = 1e-4
        self.supervisor = Supervisor(tuple(range(1, N + 1)), PERIOD_S, self.outputs)
        self.player = Player(PERIOD_S, [RAD] * N, gains=GAINS)
        self.core = Core(
            self.drives,
            self.supervisor,
            self.player,
            self.outputs,
            Schedule(wall_period_s),
            ALL_MODES,
            period_s=PERIOD_S,
            wall_period_s=wall_period_s,
            kept_s=kept_s,
        )

    def ready(self, mode: int = CSP) -> Station:
        """With all axes enabled."""
        self.core.open()
        self.core.run()
        self.core.enable(mode)
        return self

    def wait_until(self, true: Callable[[], bool], lacking: str, within_s: float = 5.0) -> None:
        until = time.monotonic() + within_s
        while not true():
            assert time.monotonic() < until, lacking
            time.sleep(0.001)

    def wait_for(self, phase: Phase) -> None:
        self.wait_until(lambda: self.core.phase is phase, f"it never is {phase}")

    def pass_cycles(self, n: int = 5) -> None:
        """So many whole ones, however long they take on a busy computer."""
        over = self.drives.cycle + n + 1
        self.wait_until(lambda: self.drives.cycle >= over, "there are no cycles any more")

    def problem(self) -> str:
        said = [""]

        def told() -> bool:
            said[0] = self.core.take_problem()
            return bool(said[0])

        self.wait_until(told, "no problem is told")
        return said[0]

    def move(self, rows: int = 500, step: int = 100) -> None:
        """Begin a motion of so many rows from where the arm is held."""
        position = np.array(self.player.position) + step * np.arange(rows)[:, None]
        zeros = np.zeros_like(position)
        self.core.prepare(Track(4, position, zeros, zeros, zeros))
        self.core.start()

    def come_to_rest(self) -> None:
        self.wait_until(lambda: not self.player.moving, "it moves on", within_s=10.0)


@pytest.fixture
def station() -> Iterator[Station]:
    station = Station()
    yield station
    station.core.close()


def test_enable_returns_when_all_axes_are_enabled(station: Station) -> None:
    station.ready()
    assert [drive.status for drive in station.drives.drives] == [ENABLED] * N
    assert station.drives.watching


def test_run_names_the_axis_that_does_not_answer(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil_drivers.cia402.core.FIRST_ANSWER_S", 0.1)
    station.drives.drives[1].silent = True
    station.core.open()
    with pytest.raises(RobotTimeout, match="no process data from axis 2"):
        station.core.run()


@pytest.mark.thorough
def test_enabling_that_takes_too_long_is_a_time_out_with_axis_and_state(station: Station) -> None:
    station.drives.drives[2].stuck_at = READY
    station.core.open()
    station.core.run()
    with pytest.raises(RobotTimeout, match=r"axis 3 \(node 3\): enabling took longer.*ready to"):
        station.core.enable(CSP)


def test_enabling_an_axis_in_fault_is_a_fault(station: Station) -> None:
    station.drives.drives[0].status = FAULT
    station.core.open()
    station.core.run()
    with pytest.raises(RobotFault, match=r"axis 1 \(node 1\): fault"):
        station.core.enable(CSP)


def test_faults_can_be_reset_and_the_axes_enabled(station: Station) -> None:
    station.drives.drives[0].status = FAULT
    station.core.open()
    station.core.run()
    station.core.reset_faults()
    station.core.enable(CSP)
    assert station.core.phase is Phase.ENABLED


def test_stop_while_enabling_leaves_off(station: Station) -> None:
    station.drives.drives[2].stuck_at = READY
    station.drives.slow_s = PERIOD_S  # in 5 s of the drives' time enabling is given up
    station.core.open()
    station.core.run()
    threading.Timer(0.1, lambda: station.core.stop(1.0)).start()
    with pytest.raises(CommandRefused, match="stopped meanwhile"):
        station.core.enable(CSP)
    station.drives.drives[2].stuck_at = 0
    station.wait_for(Phase.OFF)
    assert station.core.take_problem() == ""


def test_every_cycle_is_taken_once_and_in_order(station: Station) -> None:
    station.ready()
    blocks = [station.core.take(1.0) for _ in range(20)]
    cycles = np.concatenate(blocks)["cycle"]
    assert cycles.tolist() == list(range(len(cycles)))


def test_records_hold_what_went_over_the_wire(station: Station) -> None:
    station.ready()
    station.core.temperature[:] = [30.0, 31.0, 32.0]
    station.pass_cycles()
    rows = np.concatenate([station.core.take(1.0), station.core.take(1.0)])
    stamps = rows["rpdo"][:, 0, 0, :4].copy().view("<i4")[:, 0]
    assert (stamps == rows["cycle"]).all()
    assert rows["temperature"][-1].tolist() == [30.0, 31.0, 32.0]
    assert abs(rows["host_time"][-1] - time.time()) < 5.0


def test_records_say_which_axis_did_not_answer(station: Station) -> None:
    station.ready()
    station.drives.drives[1].silent = True
    station.pass_cycles()
    station.drives.drives[1].silent = False
    station.pass_cycles()
    rows = station.core.take(1.0)
    assert set((rows["flags"] & INCOMPLETE).tolist()) == {0, 0b010}


def test_segment_goes_into_the_record_of_the_cycle_that_announced_it(station: Station) -> None:
    station.ready()
    station.move(rows=50)
    station.come_to_rest()
    station.pass_cycles()
    rows = station.core.take(1.0)
    moving = rows[(rows["segment"] == 4) & (rows["status"] == 1)]
    assert len(moving) == 49
    assert (np.diff(moving["cycle"]) == 1).all()


def test_motion_ends_where_it_was_planned_to(station: Station) -> None:
    station.ready()
    station.move(rows=200)
    station.come_to_rest()
    assert station.outputs.target_position == [1000 + 19_900, 2000 + 19_900, 3000 + 19_900]


@pytest.mark.thorough
def test_stop_brakes_with_the_next_cycle(station: Station) -> None:
    station.ready()
    station.move(rows=100_000)
    station.pass_cycles()
    station.core.stop(0.1)
    at = station.drives.cycle
    station.come_to_rest()
    station.pass_cycles()
    steps = np.diff([position[0] for _, position, _ in station.drives.sent_outputs])
    slower = np.flatnonzero((steps > 0) & (steps < 100))
    assert slower[0] <= at + 2
    assert len(slower) * PERIOD_S == pytest.approx(100 * RAD / PERIOD_S / 0.1, rel=0.1)
    assert (np.diff(slower) == 1).all()
    assert not steps[slower[-1] + 1 :].any()
    assert station.core.phase is Phase.ENABLED


def test_quick_stop_is_in_the_next_cycle(station: Station) -> None:
    station.ready()
    station.core.quick_stop()
    at = station.drives.cycle
    station.wait_for(Phase.OFF)
    first = [words for words, _, _ in station.drives.sent_outputs].index(QUICK_STOP)
    assert first <= at + 2


@pytest.mark.thorough
def test_fault_ends_the_motion_and_is_told_once(station: Station) -> None:
    station.ready()
    station.move(rows=100_000)
    station.drives.heard = News(emergencies=[Emergency(1, 0x8611, 0, bytes(5))])
    station.drives.drives[1].status = FAULT
    problem = station.problem()
    assert "axis 2 (node 2): following error (8611h)" in problem
    assert station.core.take_problem() == ""
    assert not station.player.moving
    assert station.outputs.segment == -1


def test_start_after_a_fault_is_refused(station: Station) -> None:
    station.ready()
    station.drives.drives[1].status = FAULT
    station.problem()
    with pytest.raises(CommandRefused, match="not enabled"):
        station.move()


def test_mode_is_switched_at_rest_with_the_measured_torque(station: Station) -> None:
    station.ready()
    station.drives.drives[0].torque = 55
    station.pass_cycles()
    station.core.switch(CST)
    assert station.player.mode == CST
    assert [drive.mode for drive in station.drives.drives] == [CST] * N
    station.pass_cycles()
    assert station.drives.sent_outputs[-1][2] == [55, 0, 0]


def test_mode_switch_while_moving_is_refused(station: Station) -> None:
    station.ready()
    station.move(rows=100_000)
    with pytest.raises(CommandRefused, match="the arm moves"):
        station.core.switch(CST)


def test_mode_switch_of_an_arm_that_something_moves_is_refused(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil_drivers.cia402.core.REST_WITHIN_S", 0.3)
    station.ready()
    exchange = station.drives.exchange

    def drifting(outputs: Outputs, give_up_s: float) -> object:
        station.drives.drives[1].position += 400
        return exchange(outputs, give_up_s)

    monkeypatch.setattr(station.drives, "exchange", drifting)
    with pytest.raises(
        CommandRefused, match=r"axis 2 does not come to a standstill, it moves at 0\.[01]"
    ):
        station.core.switch(CST)


def test_rest_switches_all_axes_off_step_by_step_and_ends_the_cycles(station: Station) -> None:
    station.ready()
    station.drives.drives[0].written.clear()
    station.core.rest()
    assert station.drives.drives[0].written[-4:] == [0x0F, 0x07, 0x06, 0x00]
    time.sleep(0.05)
    at = station.drives.cycle
    time.sleep(0.05)
    assert station.drives.cycle == at


@pytest.mark.thorough
def test_rest_of_an_arm_that_moves_brakes_it(station: Station) -> None:
    station.ready()
    station.move(rows=100_000)
    station.core.rest()
    assert QUICK_STOP in [words for words, _, _ in station.drives.sent_outputs]
    assert [drive.status for drive in station.drives.drives] == [OFF] * N


def test_cycles_can_begin_again_after_a_rest(station: Station) -> None:
    station.ready()
    station.core.rest()
    station.core.run()
    station.core.enable(CSP)
    assert station.core.phase is Phase.ENABLED


def test_lost_bus_is_told_after_the_records_are_taken(station: Station) -> None:
    station.ready()
    station.drives.error = RobotConnectionError("the bus is gone")
    station.wait_until(lambda: station.core._gone is not None, "it was not noticed")
    assert len(station.core.take(1.0))
    with pytest.raises(RobotConnectionError, match="the bus is gone"):
        station.core.take(1.0)
    with pytest.raises(RobotConnectionError):
        station.core.enable(CSP)


def test_error_of_the_program_stops_the_axes_and_is_told(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.ready()

    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(station.player, "step", broken)
    station.wait_until(lambda: station.core._gone is not None, "it was not noticed")
    assert station.drives.sent_outputs[-1][0] == QUICK_STOP
    with pytest.raises(RobotConnectionError, match="ZeroDivisionError"):
        station.core.start()


def test_close_brakes_enabled_axes(station: Station) -> None:
    station.ready()
    station.core.close()
    assert [drive.status for drive in station.drives.drives] == [OFF] * N
    station.core.close()


def test_commands_before_open_say_what_to_do(station: Station) -> None:
    with pytest.raises(RobotConnectionError, match="connect first"):
        station.core.run()


def test_records_of_an_arm_at_rest_may_be_forgotten() -> None:
    station = Station(kept_s=0.3)
    station.core._free = False  # does not wait for the reader
    try:
        station.ready()
        station.wait_until(lambda: station.core.ring.forgotten > 0, "all are kept")
        assert station.core.phase is Phase.ENABLED
    finally:
        station.core.close()


@pytest.mark.thorough
def test_records_of_a_motion_that_nobody_takes_end_it() -> None:
    station = Station(kept_s=0.3)
    try:
        station.ready()
        station.core._free = False
        station.move(rows=100_000)
        assert "were not read in time" in station.problem()
    finally:
        station.core.close()


@pytest.mark.thorough
@pytest.mark.parametrize("end", ["rest", "close"])
def test_axes_that_stay_in_quick_stop_are_off_when_we_leave(station: Station, end: str) -> None:
    station.ready()
    station.drives.drives[1].braking = 1_000_000
    station.move(rows=100_000)
    getattr(station.core, end)()
    assert [drive.status for drive in station.drives.drives] == [OFF] * N


@pytest.fixture
def real_time() -> Iterator[Station]:
    station = Station(wall_period_s=PERIOD_S)
    yield station
    station.core.close()


def test_motion_is_braked_and_told_when_there_was_no_sync_for_long(real_time: Station) -> None:
    real_time.ready()
    real_time.move(rows=100_000)
    real_time.drives.held_up_s = 50 * PERIOD_S
    assert "no SYNC for 204 ms, 51 periods" in real_time.problem()
    real_time.come_to_rest()
    assert real_time.core.phase is Phase.ENABLED
    assert QUICK_STOP not in [words for words, _, _ in real_time.drives.sent_outputs]


def test_sync_that_is_later_than_a_period_and_a_half_is_flagged_and_ends_nothing(
    real_time: Station,
) -> None:
    real_time.ready()
    real_time.move(rows=100_000)
    real_time.drives.held_up_s = 3 * PERIOD_S
    real_time.pass_cycles(30)
    rows = real_time.core.take(1.0)
    assert (rows["flags"] & STALLED).any()
    assert real_time.player.moving


@pytest.mark.thorough
def test_without_deadlines_no_sync_is_late(station: Station) -> None:
    station.ready()
    station.move(rows=100_000)
    station.drives.held_up_s = 1.0
    station.pass_cycles()
    rows = station.core.take(1.0)
    assert not (rows["flags"] & STALLED).any()
    assert station.player.moving
