"""The mock's journal: an independent witness of what a robot was told and what it did."""

import subprocess
import sys
import time

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import CommandRefused, DataError, RobotConnectionError, RobotFault
from hil_mock_robot.embedded.robot import MockRobot
from hil_mock_robot.plant.simulation import Simulation
from hil_mock_robot.server.journal import read_journal
from tests.support.mock_motions import ASIDE, UPRIGHT, move, play


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal.jsonl"


def robot_at(path, **options):
    mock = MockRobot("bench", seed=3, journal=str(path), **options)
    mock.connect()
    return mock


def read_on(mock):
    while True:
        mock.read()


def events(path, *kinds):
    return [line for line in read_journal(path) if not kinds or line["event"] in kinds]


def test_every_command_is_a_line_in_the_order_it_came(path):
    mock = robot_at(path)
    mock.set_payload(Payload(1.0))
    play(mock, move(index=7))
    mock.read()
    mock.stop()
    mock.client_gone()
    mock.close()
    lines = read_journal(path)
    told = ["connect", "set_payload", "prepare", "start", "stop", "client_gone", "close", "closed"]
    assert [line["event"] for line in lines] == told
    assert lines[1]["mass_kg"] == 1.0
    assert (lines[2]["segment"], lines[2]["kind"]) == (7, "move")
    assert lines[3]["segment"] == 7
    assert {line["robot"] for line in lines} == {"bench"}


def test_lines_say_when_by_every_clock_and_how_fast_the_arm_was(path):
    mock = robot_at(path)
    before = (time.monotonic(), time.time())
    mock.prepare(move())
    mock.start()
    row = np.concatenate([mock.read() for _ in range(6)])[-1]
    mock.stop()
    start, stop = events(path, "start", "stop")
    assert before[0] <= start["monotonic_s"] + 1e-6 <= stop["monotonic_s"] <= time.monotonic()
    assert start["t"] - before[1] == pytest.approx(start["monotonic_s"] - before[0], abs=0.02)
    assert (start["device_time"], stop["device_time"]) == (0.0, row["device_time"])
    assert start["speed_rad_s"] < 1e-3
    assert stop["speed_rad_s"] == pytest.approx(np.abs(row["qd"]).max(), rel=0.02)
    assert stop["moving"] is True


def test_a_refused_command_says_why(path):
    mock = robot_at(path)
    with pytest.raises(CommandRefused):
        mock.prepare(move(UPRIGHT + 0.1, ASIDE))
    with pytest.raises(CommandRefused):
        mock.start()
    prepare, start = events(path, "prepare", "start")
    assert "away from its present position" in prepare["refused"]
    assert "without a prepared segment" in start["refused"]


def true_speeds(monkeypatch):
    """(device time, fastest joint) of every sample from here on, taken from the simulation."""
    seen, advance = [], Simulation.advance

    def watched(simulation, setpoints):
        first = simulation.samples
        samples = advance(simulation, setpoints)
        fastest = np.abs(samples["qd"]).max(axis=1)
        seen.extend(zip((first + 1 + np.arange(len(samples))) / 125, fastest, strict=True))
        return samples

    monkeypatch.setattr(Simulation, "advance", watched)
    return seen


def test_rest_is_the_first_moment_from_which_all_joints_stay_slow(path, monkeypatch):
    mock = robot_at(path)
    seen = true_speeds(monkeypatch)
    mock.prepare(move())
    mock.start()
    for _ in range(6):
        mock.read()
    mock.stop()
    mock.stop()
    for _ in range(6):
        mock.read()
    stop, _, rest = events(path, "stop", "rest")
    last_fast = max(t for t, speed in seen if speed >= 0.01)
    assert rest["device_time"] == pytest.approx(last_fast + 1 / 125)
    assert rest["device_s"] == pytest.approx(rest["device_time"] - stop["device_time"])
    assert 0.05 < rest["device_s"] < 0.5
    assert rest["after"] == "stop"


def test_an_arm_stopped_at_rest_is_at_rest_at_once_and_told_once(path):
    mock = robot_at(path)
    for _ in range(3):
        mock.stop()
        mock.read()
    assert [rest["device_s"] for rest in events(path, "rest")] == [pytest.approx(1 / 125)]


def test_a_new_motion_makes_for_a_new_rest(path):
    mock = robot_at(path)
    for start, end, index in ((UPRIGHT, ASIDE, 0), (ASIDE, UPRIGHT, 1)):
        play(mock, move(start, end, index))
        mock.stop()
        mock.read()
        mock.read()
    assert [line["event"] for line in events(path, "start", "rest")] == ["start", "rest"] * 2


def test_an_injected_fault_and_the_rest_after_it_are_told(path):
    mock = robot_at(path, faults=[{"kind": "protective_stop", "segment": 0, "after_s": 0.8}])
    mock.prepare(move())
    mock.start()
    with pytest.raises(RobotFault):
        read_on(mock)
    fault, rest = events(path, "fault", "rest")
    assert (fault["kind"], fault["code"]) == ("protective_stop", 4)
    assert fault["device_time"] == pytest.approx(0.8 - 1 / 125)
    assert rest["after"] == "protective_stop"
    assert 0.05 < rest["device_s"] < 0.5


def test_the_simulations_own_protective_stop_locks_the_arm(path):
    mock = robot_at(path)
    mock.push([-200.0, 0, 0, 0, 0, 0])
    with pytest.raises(RobotFault):
        read_on(mock)
    fault, rest = events(path, "fault", "rest")
    assert (fault["kind"], fault["code"]) == ("tracking", 1)
    assert rest["after"] == "tracking"
    assert rest["device_s"] == 0.0


def test_beginning_and_end_of_a_lasting_fault_are_told(path):
    mock = robot_at(path, faults=[{"kind": "nan", "at_s": 0.2, "for_s": 0.2}])
    for _ in range(8):
        mock.read()
    begun, over = events(path, "fault", "fault_over")
    assert over["device_time"] - begun["device_time"] == pytest.approx(0.2)


def test_a_journal_changes_nothing_of_the_rows(path):
    mock, bare = robot_at(path), MockRobot("bench", seed=3)
    bare.connect()
    assert play(mock, move()).tobytes() == play(bare, move()).tobytes()


def test_a_journal_is_continued_by_the_next_connection_and_the_next_process(path):
    for _ in range(2):
        mock = robot_at(path)
        mock.close()
    assert [line["event"] for line in read_journal(path)] == ["connect", "close", "closed"] * 2


@pytest.mark.thorough
def test_lines_survive_a_killed_process(path):
    code = (
        "import os, signal; from hil_mock_robot.embedded.robot import MockRobot\n"
        f"mock = MockRobot('bench', journal={str(path)!r}); mock.connect(); mock.stop()\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -9
    assert [line["event"] for line in read_journal(path)] == ["connect", "stop"]


def test_a_journal_that_cannot_be_written_keeps_the_robot_off(tmp_path):
    mock = MockRobot("bench", journal=str(tmp_path / "nowhere" / "journal.jsonl"))
    with pytest.raises(RobotConnectionError, match="cannot write the journal"):
        mock.connect()
    with pytest.raises(RobotConnectionError):
        mock.read()


def test_what_is_no_journal_is_a_data_error(path):
    path.write_text("[1]\n")
    with pytest.raises(DataError, match="not a JSON object"):
        read_journal(path)
    path.write_text("{")
    with pytest.raises(DataError, match="not a readable journal"):
        read_journal(path)
