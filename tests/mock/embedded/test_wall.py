"""The mock in wall time: it advances whether or not anybody reads it."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from hil.core.errors import RobotConnectionError, RobotError, RobotFault, RobotTimeout
from hil.robot import Robot, Status
from hil.testing.driver_conformance import robot_conformance
from hil_mock_robot.embedded.robot import MockRobot
from hil_mock_robot.server.journal import read_journal
from tests.support.in_time import InTime, measured_again
from tests.support.mock_motions import ASIDE, UPRIGHT, move, play
from tests.support.waiting import until

pytestmark = pytest.mark.wire

DT = 1 / 125


@pytest.fixture
def make(tmp_path):
    """Connected robots in wall time, closed in the end; each keeps a journal."""
    made = []

    def connected(*faults, name="bench", **options):
        path = tmp_path / f"{name}.jsonl"
        given = {"seed": 3, "clock": "wall", "journal": str(path), "faults": list(faults)}
        mock = MockRobot(name, **{**given, **options})
        mock.journal = path
        mock.connect()
        made.append(mock)
        return mock

    yield connected
    for mock in made:
        mock.close()


def rows_for(mock, seconds, timeout_s=1.0):
    end, blocks = time.monotonic() + seconds, []
    while time.monotonic() < end:
        blocks.append(mock.read(timeout_s))
    return np.concatenate(blocks)


def begin(mock, **kwargs):
    mock.prepare(move(**kwargs))
    mock.start()


def events(mock, *kinds):
    return [line for line in read_journal(mock.journal) if line["event"] in kinds]


def reading_to_the_end(mock, timeout_s):
    """A thread that reads until it gets an error, and the list that the error is put into."""
    ended = []

    def read():
        try:
            while True:
                mock.read(timeout_s)
        except RobotError as error:
            ended.append(error)

    thread = threading.Thread(target=read)
    thread.start()
    return ended, thread


def threads():
    return [t for t in threading.enumerate() if t.name.startswith("mock robot")]


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_device_time_keeps_pace_with_the_wall(make, speed):
    mock = make(speed=speed)
    assert isinstance(mock, Robot)
    first = mock.read()[-1]
    rows = rows_for(mock, 0.6)
    assert np.diff(rows["device_time"]) == pytest.approx(np.full(len(rows) - 1, DT))
    last = rows[-1]
    # A machine so busy that the clock slipped has its slips in the journal.
    slipped = sum(
        line["behind_s"] for line in events(mock, "slip") if line["t"] > first["host_time"]
    )
    passed = last["host_time"] - first["host_time"] - slipped
    assert (last["device_time"] - first["device_time"]) / speed == pytest.approx(passed, abs=0.1)
    assert abs(last["host_time"] - time.time()) < 0.2


def test_samples_faster_than_the_block_keep_their_spacing_in_host_time(make):
    mock = make(rate_hz=500)
    mock.read()
    rows = rows_for(mock, 0.2)
    assert np.diff(rows["device_time"]) == pytest.approx(np.full(len(rows) - 1, 0.002))
    assert np.median(np.diff(rows["host_time"])) == pytest.approx(0.002, abs=5e-4)


def test_a_segment_plays_to_its_end_as_on_the_virtual_clock(make):
    piece = move(duration_s=1.6)
    rows = play(make(speed=5.0), piece)
    assert np.array_equal(rows["q_target"][: len(piece.q)], piece.q)
    assert (np.flatnonzero(rows["status"] == Status.HOLDING) >= len(piece.q) - 1).all()


def test_stop_acts_within_a_block_or_two(make):
    mock = make()
    begin(mock)
    rows_for(mock, 0.6)
    took = []
    for _ in range(3):
        asked = time.monotonic()
        mock.stop()
        took.append(time.monotonic() - asked)
    assert min(took) < 0.02
    rows = rows_for(mock, 0.5)
    stop = events(mock, "stop")[0]
    after = rows[rows["device_time"] > stop["device_time"] + DT / 2]
    speeds = np.abs(after["qd_target"]).max(axis=1)
    assert speeds[1] < speeds[0] * 0.99
    assert after["status"][-1] == Status.HOLDING


@measured_again
def test_a_command_meets_the_arm_where_it_is_by_the_wall(make):
    mock = make(speed=5.0)
    watched = InTime(os.getpid(), ours=False)
    begin(mock)
    busy_until = time.monotonic() + 0.15
    while time.monotonic() < busy_until:  # holds the interpreter, which slows every thread down
        pass
    mock.stop()
    took = watched.taken()
    start, stop = events(mock, "start", "stop")[-2:]
    slips = [line for line in events(mock, "slip") if line["monotonic_s"] >= start["monotonic_s"]]
    slipped = sum(line["behind_s"] for line in slips)
    passed = (stop["monotonic_s"] - start["monotonic_s"] - slipped) * 5.0
    off = stop["device_time"] - start["device_time"] - passed
    took.require(3 * DT / 5.0, abs(off) / 5.0)


def test_the_arm_moves_on_when_nobody_reads_and_the_oldest_rows_are_lost(make):
    mock = make(queue_s=0.2)
    begin(mock, duration_s=1.6)
    first = mock.read()
    time.sleep(0.5)
    rows = np.concatenate((first, mock.read()))
    steps = np.diff(rows["device_time"])
    assert steps[len(first) - 1] > 0.2
    assert np.delete(steps, len(first) - 1) == pytest.approx(DT)
    assert len(rows) - len(first) == 25
    assert rows["device_time"][-1] - first["device_time"][-1] > 0.4
    assert events(mock, "overflow")[0]["rows"] > 20


def test_the_time_to_rest_is_measured_by_both_clocks(make):
    mock = make(speed=2.0)
    begin(mock)
    rows_for(mock, 0.4)
    mock.stop()
    until(lambda: events(mock, "rest"))
    stop, rest = events(mock, "stop", "rest")
    assert stop["speed_rad_s"] > 0.5
    assert 0.05 < rest["device_s"] < 0.5
    assert rest["wall_s"] == pytest.approx(rest["device_s"] / 2.0, abs=0.1)
    assert rest["monotonic_s"] - stop["monotonic_s"] == pytest.approx(rest["wall_s"], abs=1e-3)


def test_silence_is_a_time_out_and_the_watchdog_stops_the_arm(make):
    mock = make({"kind": "silence", "segment": 0, "after_s": 0.3}, watchdog_s=0.3)
    begin(mock)
    rows_for(mock, 0.25)
    with pytest.raises(RobotTimeout):
        rows_for(mock, 2.0, timeout_s=0.15)
    until(lambda: events(mock, "rest"))
    _, watchdog = events(mock, "fault")
    (rest,) = events(mock, "rest")
    assert watchdog["kind"] == rest["after"] == "watchdog"
    assert watchdog["speed_rad_s"] > 0.3


@measured_again
def test_a_time_out_comes_after_the_time_it_was_given(make):
    mock = make({"kind": "silence", "at_s": 0.02})
    with pytest.raises(RobotTimeout):
        rows_for(mock, 1.0, timeout_s=0.05)
    asked = InTime()
    with pytest.raises(RobotTimeout, match=r"within 0\.2 s"):
        mock.read(timeout_s=0.2)
    assert time.monotonic() - asked.at >= 0.2
    asked.require(0.4)


def test_a_moving_arm_that_nobody_reads_is_stopped_and_says_so_afterwards(make):
    mock = make(watchdog_s=0.2)
    begin(mock)
    until(lambda: events(mock, "rest"))
    assert mock.read()["fault_code"][-1] == 6
    with pytest.raises(RobotFault, match="watchdog"):
        mock.read()
    mock.connect()
    rows = mock.read()
    assert not (rows["status"] & Status.FAULT).any()


def test_a_waiting_reader_and_a_resting_arm_keep_the_watchdog_quiet(make):
    mock = make({"kind": "lag", "segment": 0, "by_s": 0.4}, watchdog_s=0.2)
    time.sleep(0.3)
    begin(mock)
    rows = mock.read()
    while rows["segment"][-1] != 0:
        rows = mock.read(timeout_s=2.0)
    assert rows["host_time"][-1] - events(mock, "start")[0]["t"] > 0.3
    assert [line["kind"] for line in events(mock, "fault")] == ["lag"]


def test_a_cut_line_leaves_the_arm_to_its_watchdog(make):
    mock = make({"kind": "cut", "segment": 0, "after_s": 0.4}, watchdog_s=0.2)
    begin(mock)
    with pytest.raises(RobotConnectionError, match="cut"):
        rows_for(mock, 2.0)
    with pytest.raises(RobotConnectionError, match="cut"):
        mock.stop()
    until(lambda: events(mock, "rest"))
    stop, rest = events(mock, "stop", "rest")
    assert "cut" in stop["refused"]
    assert rest["after"] == "watchdog"


def test_a_protective_stop_is_told_raised_and_comes_to_rest(make):
    mock = make({"kind": "protective_stop", "segment": 0, "after_s": 0.5})
    begin(mock)
    with pytest.raises(RobotFault, match="protective stop"):
        rows_for(mock, 2.0)
    until(lambda: events(mock, "rest"))
    mock.connect()
    mock.stop()
    assert rows_for(mock, 0.1)["status"][-1] == Status.HOLDING


def test_frozen_rows_come_on_while_the_arm_moves(make):
    mock = make({"kind": "freeze", "segment": 0, "after_s": 0.2})
    begin(mock)
    rows = rows_for(mock, 0.6)
    frozen = rows["device_time"] == rows["device_time"][-1]
    assert frozen.sum() > 20
    assert np.ptp(rows["host_time"][frozen]) > 0.2
    mock.stop()
    assert events(mock, "stop")[0]["device_time"] > rows["device_time"][-1] + 0.2


@measured_again
def test_stop_gets_through_while_another_thread_waits_for_rows(make):
    mock = make({"kind": "silence", "at_s": 0.05})
    ended, waiting = reading_to_the_end(mock, 0.6)
    time.sleep(0.3)
    assert waiting.is_alive()
    asked = InTime()
    mock.stop()
    took = asked.taken()
    waiting.join()
    assert isinstance(ended[0], RobotTimeout)
    took.require(0.05)


class Enough(Exception):
    """Raised by a signal handler, to get out of a read that does not return."""


def test_a_signal_handler_may_stop_the_robot_its_own_thread_is_reading(make):
    mock = make({"kind": "hang", "segment": 0, "after_s": 0.3})

    def handle(number, frame):
        mock.stop()
        raise Enough

    before = signal.signal(signal.SIGUSR1, handle)
    sending = threading.Timer(0.6, os.kill, (os.getpid(), signal.SIGUSR1))
    try:
        begin(mock)
        sending.start()
        with pytest.raises(Enough):
            rows_for(mock, 10.0)
    finally:
        sending.join()
        signal.signal(signal.SIGUSR1, before)
    assert events(mock, "stop")[0]["speed_rad_s"] > 0.5
    until(lambda: events(mock, "rest"))


def test_keeps_the_contract_of_the_robot_protocol():
    no_address = "a_robot_in_wall_time_says_which_one_it_is"  # it lives in this process alone
    assert robot_conformance(
        lambda: MockRobot("bench", clock="wall", speed=5.0), leave_out=[no_address]
    )


def test_two_robots_live_side_by_side(make):
    both = [make(name="left"), make(name="right", seed=4, speed=2.0)]
    for mock in both:
        begin(mock)
    rows = [np.concatenate([mock.read() for _ in range(20)]) for mock in both]
    for each in rows:
        steps = np.diff(each["device_time"])
        assert steps == pytest.approx(np.full(len(steps), DT))
    assert not np.array_equal(rows[0]["q"][-1], rows[1]["q"][-1])
    both[0].stop()
    assert events(both[0], "stop")
    assert not events(both[1], "stop")


def test_close_brings_the_arm_to_rest_and_ends_the_thread(make):
    mock = make()
    begin(mock)
    rows_for(mock, 0.6)
    mock.close()
    assert threads() == []
    close, rest = events(mock, "close", "rest")
    assert close["speed_rad_s"] > 0.5
    assert rest["after"] == "close"
    mock.close()
    with pytest.raises(RobotConnectionError, match="not connected"):
        mock.read()
    mock.connect()
    assert mock.read()["status"][-1] == Status.HOLDING


def test_whoever_waits_for_rows_learns_that_the_robot_was_closed(make):
    mock = make({"kind": "silence", "at_s": 0.02})
    ended, waiting = reading_to_the_end(mock, 5.0)
    time.sleep(0.2)
    mock.close()
    waiting.join(1.0)
    assert not waiting.is_alive()
    assert isinstance(ended[0], RobotConnectionError)


def test_a_forgotten_robot_ends_its_thread(make):
    mock = MockRobot("bench", clock="wall")
    mock.connect()
    assert len(threads()) == 1
    del mock
    until(lambda: not threads())


def test_a_forgotten_robot_does_not_keep_the_interpreter_alive():
    code = (
        "from hil_mock_robot.embedded.robot import MockRobot\n"
        "mock = MockRobot('bench', clock='wall'); mock.connect(); mock.read(); print('read')"
    )
    done = subprocess.run(
        [sys.executable, "-X", "dev", "-c", code], capture_output=True, text=True, timeout=20,
        check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "read\n"), done.stderr


def test_moves_follow_one_another_in_wall_time(make):
    mock = make(speed=10.0)
    play(mock, move())
    rows = play(mock, move(ASIDE, UPRIGHT, 1))
    assert np.abs(rows["q"][-1] - UPRIGHT).max() < 2e-3
