"""Listening to the mock UR controller over its sockets: nothing lost, everything told, all faults.

The mock shares no code with the driver; `ur-rtde` beside it is the witness.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hil
from hil.cli.bench import measure
from hil.core.errors import RobotConnectionError, SpecError
from hil.core.typing import StructArray
from hil.importers.sources import load_source
from hil.robot import Listens, Status
from hil_drivers.ur.robot import UrRobot
from hil_drivers.ur.rtde import Receiver
from tests.support.mock_servers import MockUr, mock_ur

pytestmark = [pytest.mark.wire, pytest.mark.timeout(180)]

SCRIPTS = 30002
SPREAD = np.array([0.5, 0.4, 0.6, 0.7, 0.7, 0.9])
HOME = np.array([0.0, -1.57, 0.0, -1.57, 0.0, 0.0])


@pytest.fixture(scope="module")
def mock():
    with mock_ur() as running:
        yield running


@pytest.mark.parametrize(("model", "rate"), [("ur5", 125.0), ("ur5e", 500.0)])
def test_in_free_run_no_state_is_lost(model, rate):
    with (
        mock_ur("--model", model, "--speed", "free") as mock,
        Receiver(mock.address, capacity_s=10.0) as receiver,
    ):
        assert receiver.frequency_hz == rate
        rows = [receiver.take(5.0)]
        while sum(map(len, rows)) < 4000:
            rows.append(receiver.take(5.0))
            time.sleep(0.02)
        ticks = np.concatenate(rows)["timestamp"] * rate
        assert np.allclose(np.diff(ticks), 1.0, atol=1e-6)
        assert (receiver.counts.missing, receiver.counts.duplicates) == (0, 0)


def test_two_receivers_at_different_rates_do_not_disturb_each_other():
    with (
        mock_ur("--speed", "5") as mock,
        Receiver(mock.address) as all_of_them,
        Receiver(mock.address, 25.0) as some,
    ):
        assert steps(all_of_them, 200) == [0.008]
        assert steps(some, 40) == [0.04]


def test_every_value_is_the_one_that_ur_rtde_reads():
    rtde_receive = pytest.importorskip("rtde_receive")
    with mock_ur("--speed", "lock-step") as mock:
        code = (
            "import sys, json, rtde_receive\n"
            "r = rtde_receive.RTDEReceiveInterface(sys.argv[1])\n"
            "print('on', flush=True); sys.stdin.readline()\n"
            "print(json.dumps([r.getTimestamp(), r.getActualQ(), r.getActualQd(), "
            "r.getActualCurrent(), r.getTargetQ(), r.getTargetMoment(), r.getJointTemperatures(), "
            "r.getActualTCPPose(), [r.getRobotMode(), r.getSafetyMode(), r.getRuntimeState()], "
            "r.getPayload(), r.getSpeedScaling()]), flush=True)\n"
        )
        assert rtde_receive
        child = subprocess.Popen(
            [sys.executable, "-c", code, mock.address],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        with child, Receiver(mock.address, silence_s=60.0) as receiver:
            assert child.stdin is not None
            assert child.stdout is not None
            while not select.select([child.stdout], [], [], 0.05)[0]:
                mock.step(1)  # its constructor waits for a state, and never longer than 2.5 s
            assert child.stdout.readline().strip() == "on"
            mock.step(5)
            time.sleep(0.3)
            child.stdin.write("\n")
            child.stdin.flush()
            theirs = json.loads(child.stdout.readline())
            ours = receiver.newest
            assert ours is not None
            row = ours[0]
            names = (
                "timestamp", "actual_q", "actual_qd", "actual_current", "target_q",
                "target_moment", "joint_temperatures", "actual_TCP_pose",
            )  # fmt: skip
            for name, value in zip(names, theirs, strict=False):
                assert np.array_equal(row[name], value), name
            modes = [row["robot_mode"], row["safety_mode"], row["runtime_state"]]
            assert modes == theirs[8]
            assert [row["payload"], row["speed_scaling"]] == theirs[9:]


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ({"kind": "cut"}, "closed the connection|broke the connection"),
        ({"kind": "silence"}, "been silent|no state for"),
        ({"kind": "garbage"}, "not an RTDE package|instead of|recipe|silent|clock|order"),
        ({"kind": "wrong_length", "by_bytes": -8}, "instead of"),
        ({"kind": "wrong_length", "by_bytes": 8}, "instead of"),
        ({"kind": "reboot"}, "closed the connection|broke the connection|restarted"),
    ],
)
def test_what_goes_wrong_on_the_line_is_told_after_the_last_good_state(mock, fault, says):
    with reached(mock) as receiver:
        first = receiver.take(5.0)
        mock.side("fault", **fault)
        rows, error = until_it_ends(receiver, first)
        assert re.search(says, str(error)), str(error)
        assert np.all(np.diff(rows["timestamp"]) > 0)
        assert np.abs(rows["actual_q"] - HOME).max() < 0.01


@pytest.mark.parametrize(("kind", "counted"), [("drop", "missing"), ("duplicate", "duplicates")])
def test_what_is_lost_or_comes_twice_is_counted(mock, kind, counted):
    with reached(mock) as receiver:
        receiver.take(5.0)
        mock.side("fault", kind=kind, packages=3)
        until = time.monotonic() + 10
        while getattr(receiver.counts, counted) < 3 and time.monotonic() < until:
            receiver.take(5.0)
        assert getattr(receiver.counts, counted) == 3


def test_the_driver_listens_and_commands_nothing(tmp_path):
    with mock_ur(journal=tmp_path / "journal.jsonl") as mock:
        robot = UrRobot("arm", "ur5", address=mock.address)
        assert isinstance(robot, Listens)
        robot.listen()
        robot.listen()
        assert robot.identity.firmware.startswith("3.15")
        assert len(robot.read()) > 0
        assert not robot.program_running
        play(mock, ["sleep(1.0)"])
        until = time.monotonic() + 10
        while not robot.program_running and time.monotonic() < until:
            robot.read()
        assert robot.program_running
        robot.close()
        told = {line["event"] for line in mock.journal()}
        assert not told & {"movej", "stopj", "stop_script", "control"}
        assert [line for line in mock.journal() if line["event"] == "program_stopped"] == []
        with pytest.raises(RobotConnectionError):
            robot.read()


def test_listening_shows_a_protective_stop_and_goes_on():
    with mock_ur() as mock:
        robot = UrRobot("arm", "ur5", address=mock.address)
        robot.listen()
        mock.side("fault", kind="protective_stop")
        until = time.monotonic() + 10
        while not (status := robot.read()["status"][-1]) & Status.FAULT:
            assert time.monotonic() < until
        assert status & Status.MASKED
        assert len(robot.read()) > 0
        robot.close()


def test_another_arm_and_a_torque_source_it_lacks_are_refused():
    with mock_ur() as mock, pytest.raises(RobotConnectionError, match="CB3"):
        UrRobot("arm", "ur5e", address=mock.address).listen()
    with mock_ur("--model", "ur5e") as mock:
        robot = UrRobot("arm", "ur5e", address=mock.address, torque_source="current-as-torque")
        with pytest.raises(SpecError, match="does not send"):
            robot.listen()


def test_a_program_of_somebody_else_is_recorded_and_fitted_to(tmp_path):
    """`hil record --until program-stops` beside a program that hil knows nothing of."""
    poses = HOME + np.random.default_rng(3).uniform(-1, 1, (20, 6)) * SPREAD
    with mock_ur("--speed", "10") as mock:
        recording = start_recording(tmp_path, mock.address, "--until", "program-stops")
        # Long enough that a late slip of an axis leaves most of the dwell.
        lines = [line for q in poses for line in (f"movej({bracketed(q)}, a=4, v=2)", "sleep(0.8)")]
        play(mock, ["sleep(1.0)", *lines])
        document = finished(recording)
    assert document["reason"] == "the program has stopped"
    assert (document["gaps"], document["missing"], document["duplicates"]) == (0, 0, 0)
    run = Path(document["run"])
    dwells = load_source(run, kinds=("dwell",))
    stood = np.array([dwells["q"][rows].mean(axis=0) for _, rows in dwells.slices()])
    assert np.abs(stood[0] - HOME).max() < 2e-3  # where it stood before
    missed = [n for n, q in enumerate(poses) if np.abs(stood - q).max(axis=1).min() > 2e-3]
    assert not missed, (document["found"], stood)
    assert len(stood) >= 21  # one more where an axis slipped in the middle of a dwell
    assert {c.payload.mass for c in dwells.conditions} == {0.0}
    fitted = hil.fit([run], estimator="static-wls", out=tmp_path / "models")
    assert fitted.fitted.model.training_ is not None
    assert fitted.fitted.model.training_.samples == 10 * len(stood)
    moves = hil.fit([run], estimator="rigid-wls", out=tmp_path / "models")
    assert moves.fitted.seconds > 0


def test_ctrl_c_ends_a_recording_in_order(tmp_path):
    with mock_ur() as mock:
        recording = start_recording(tmp_path, mock.address)
        time.sleep(1.0)
        recording.send_signal(signal.SIGINT)
        document = finished(recording)
    assert document["reason"] == "stopped by SIGINT"
    assert document["samples"] > 60
    assert document["found"] == {"dwell": 1}


def test_a_controller_that_is_switched_off_leaves_what_was_recorded(tmp_path):
    with mock_ur() as mock:
        recording = start_recording(tmp_path, mock.address)
        time.sleep(0.5)
    document = finished(recording, code=4)
    assert document["samples"] > 30
    assert document["error"]["kind"] == "RobotConnectionError"
    assert load_source(document["run"], kinds=("dwell",)).n_joints == 6


@pytest.mark.proof
def test_the_benchmark_loses_nothing_and_names_its_peer():
    document = measure("rtde", quick=True)
    figures, ratios = document["figures"], document["ratios"]
    assert (figures["real_missing"], figures["free_missing"]) == (0, 0)
    assert figures["real_states_per_s"] == pytest.approx(500, rel=0.2)
    assert ratios["free_run_factor"] > 2  # 30 with a core to itself; whatever else is running
    assert 0 <= figures["ur_rtde_real_lost_share"] < 1


# --- helpers ---


def steps(receiver: Receiver, count: int) -> list[float]:
    """The steps between time stamps of so many rows, all of one size."""
    rows = receiver.take(5.0)
    while len(rows) < count:
        rows = np.concatenate((rows, receiver.take(5.0)))
    found = np.unique(np.diff(rows["timestamp"]).round(6))
    return found.tolist()


@contextlib.contextmanager
def reached(mock: MockUr) -> Iterator[Receiver]:
    """A receiver of a mock that may have been cut off or rebooted a moment ago."""
    mock.side("clear")
    receiver, until = Receiver(mock.address, silence_s=0.5), time.monotonic() + 20
    while not receiver.alive:
        try:
            receiver.open()
        except RobotConnectionError:
            assert time.monotonic() < until
            time.sleep(0.1)
    with receiver:
        yield receiver


def until_it_ends(
    receiver: Receiver, first: StructArray
) -> tuple[StructArray, RobotConnectionError]:
    """All rows from the first ones on, and why there are no more."""
    rows = [first]
    while True:
        try:
            rows.append(receiver.take(5.0))
        except RobotConnectionError as error:
            return np.concatenate(rows), error


def bracketed(q) -> str:
    return "[" + ",".join(f"{value:.6f}" for value in q) + "]"


def play(mock: MockUr, lines: list[str]) -> None:
    """Send a program as anybody may."""
    text = "".join(["def work():\n", *(f"  {line}\n" for line in lines), "end\n"])
    with mock.connect(SCRIPTS) as line:
        line.sendall(text.encode())
        time.sleep(0.2)


def start_recording(tmp_path: Path, address: str, *more: str) -> subprocess.Popen[str]:
    """`hil record` as a process, once it records."""
    station = tmp_path / "station.yaml"
    station.write_text(
        "hil_station: 1\nrobots:\n  ur5:\n    driver: ur\n    model: ur5\n"
        f"    own_process: true\n    options: {{address: {address}}}\n"
    )
    command = [sys.executable, "-m", "hil", "record", "--robot", "ur5", "--station", str(station)]
    process = subprocess.Popen(
        [*command, "--runs", str(tmp_path / "runs"), "--json", "--payload", "0", *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert process.stderr is not None
    told = process.stderr.readline()
    assert told.startswith("recording"), told + process.stderr.read()
    return process


def finished(process: subprocess.Popen[str], code: int = 0) -> dict:
    out, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    return json.loads(out)
