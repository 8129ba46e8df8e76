"""The robot layer on mock drives in another process: faults, deaths, whole experiments.

`robot` has a process of its own, as in every station; `axes` is what lives in there.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
import yaml

from hil.arms.payload import Payload
from hil.core.errors import HilError, RobotConnectionError, RobotFault
from hil.core.typing import StructArray
from hil.recording.mcap_reader import read_topic
from hil.robot import Robot, Status
from hil.testing.moves import begin, follow, move, settle
from hil_drivers.cia402.__main__ import main
from hil_drivers.cia402.axes_robot import AxesRobot
from hil_drivers.cia402.can_cycle import stop_directly
from hil_drivers.cia402.options import options_of
from hil_drivers.cia402.robot import Cia402Robot
from hil_drivers.cia402.rows import TOPIC
from tests.support.cia402_robot import options
from tests.support.in_time import InTime, Took, measured_again
from tests.support.mock_servers import MockCan, mock_can
from tests.support.paths import EXPERIMENTS

pytestmark = [pytest.mark.wire, pytest.mark.timeout(120)]

STOP_S = 0.1
ALL = set(range(1, 7))
PATIENT = ("--sync-patience-s", "0.5")
PACE = 0.5
"""A computer that is busy with other tests is no master that has died, and no bus that is too slow;
what is asked of a stop is asked in wall time all the same."""


@pytest.fixture(scope="module")
def mock(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MockCan]:
    with mock_can(*PATIENT, journal=tmp_path_factory.mktemp("can") / "journal") as running:
        yield running


@pytest.fixture
def robot(mock: MockCan) -> Iterator[Cia402Robot]:
    mock.tell("clear")
    made = Cia402Robot("arm", "lab6", **options(mock, pace=PACE))
    yield made
    made.close()


@pytest.fixture
def axes(mock: MockCan) -> Iterator[AxesRobot]:
    yield from connected(mock, PACE)


@pytest.fixture
def free_axes(mock: MockCan) -> Iterator[AxesRobot]:
    """For what has to do with the drives' time alone."""
    yield from connected(mock, "free")


def connected(mock: MockCan, pace: object) -> Iterator[AxesRobot]:
    mock.tell("clear")
    with closing(AxesRobot("arm", "lab6", **options(mock, pace=pace))) as made:
        made.connect()
        yield made


def at_rest(mock: MockCan) -> dict[str, Any]:
    return mock.wait_until(lambda state: max(map(abs, state["qd"])) < 0.01, within_s=5.0)


def off_and_at_rest(mock: MockCan) -> None:
    mock.wait_until(lambda state: "OPERATION_ENABLED" not in state["states"], within_s=5.0)
    at_rest(mock)


def all_told_to_stop(mock: MockCan, after: float) -> float:
    """When the last axis has left operation enabled, all of them for a quick stop [s]."""
    until, axes, last = time.monotonic() + 5.0, set[int](), after
    while axes < ALL:
        assert time.monotonic() < until, f"only axes {sorted(axes)} were told to stop"
        lines = [line for line in mock.journal() if line["monotonic_s"] >= after]
        stops = [line for line in lines if line["event"] == "stop"]
        assert {line["by"] for line in stops} <= {"quick stop"}, stops
        axes = {axis for line in stops for axis in line["axes"]}
        last = max((line["monotonic_s"] for line in stops), default=after)
        time.sleep(0.01)
    return last


def under_way(mock: MockCan, robot: Cia402Robot) -> int:
    """The pid of the process that moves the arm, now."""
    mock.tell("clear")
    robot.connect()
    begin(robot, move(robot, 0.8))
    assert robot.process is not None
    return robot.process.pid


def stopped(mock: MockCan, robot: Cia402Robot) -> tuple[Took, float]:
    """What `stop` took, and how long it was until all drives had been told to."""
    asked = InTime(mock.process.pid)
    robot.stop()
    took = asked.taken()
    return took, all_told_to_stop(mock, asked.at) - asked.at


def until_it_raises(robot: Robot, within_s: float = 3.0) -> HilError:
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        try:
            robot.read()
        except HilError as error:
            return error
    raise AssertionError("nothing was raised")


def until_masked(robot: Robot) -> StructArray:
    for _ in range(200):
        rows = robot.read()
        if (rows["status"] & int(Status.MASKED)).any():
            return rows
    raise AssertionError("no row was masked")


def until_in_fault(robot: AxesRobot) -> np.void:
    """The error may have been told by the EMCY, which a drive sends before its statusword."""
    for _ in range(200):
        row = robot.read()[-1]
        if row["status"] & int(Status.FAULT) and row["fault_code"]:
            return row
    raise AssertionError("no row tells of a fault")


def station_for(mock: MockCan, folder: Path, **more: Any) -> Path:
    more = {"pace": PACE} | more
    station = yaml.safe_load((EXPERIMENTS / "stations" / "lab6_can_mock.yaml").read_text())
    station["robots"]["lab6_can"]["options"] |= options(mock) | more
    path = folder / "station.yaml"
    path.write_text(yaml.safe_dump(station), "utf-8")
    return path


# -- the driver's process


@measured_again
def test_killed_in_a_motion_its_arm_is_stopped_by_this_process(mock, robot) -> None:
    os.kill(under_way(mock, robot), signal.SIGKILL)
    took, told_s = stopped(mock, robot)
    at_rest(mock)
    with pytest.raises(RobotConnectionError):
        robot.read()
    took.require(STOP_S)
    took.require(STOP_S, told_s)


def test_killed_with_nobody_there_the_drives_stop_by_themselves(mock, robot) -> None:
    os.kill(under_way(mock, robot), signal.SIGKILL)
    off_and_at_rest(mock)
    assert mock.state()["states"] == ["FAULT"] * 6


@measured_again
def test_a_process_that_hangs_does_not_keep_the_arm_from_being_stopped(mock, robot) -> None:
    pid = under_way(mock, robot)
    os.kill(pid, signal.SIGSTOP)
    try:
        took, told_s = stopped(mock, robot)
        off_and_at_rest(mock)
    finally:
        os.kill(pid, signal.SIGCONT)
    robot.close()
    took.require(STOP_S)
    took.require(STOP_S, told_s)


def test_a_direct_stop_stops_a_master_that_goes_on_commanding(mock, axes) -> None:
    begin(axes, move(axes, 0.8))
    assert stop_directly(options_of(options(mock), "lab6"))
    error = until_it_raises(axes)
    assert isinstance(error, RobotFault)
    assert "has left operation enabled" in error.message
    off_and_at_rest(mock)


# -- faults


def test_one_axis_that_fails_stops_all_and_the_message_says_who_and_why(
    mock, axes, monkeypatch
) -> None:
    monkeypatch.setattr("hil_drivers.cia402.session.ASKED_S", 5.0)  # however busy this computer is
    begin(axes, move(axes, 0.8))
    mock.tell("fault", kind="following_error", axis=3)
    error = until_it_raises(axes)
    assert isinstance(error, RobotFault)
    for said in ("joint_3", "node 3", "following error", "8611h", "603Fh", "All axes were stopped"):
        assert said in error.message
    row = until_in_fault(axes)
    assert row["fault_code"] == 0x8611
    with pytest.raises(RobotFault, match=r"accepts no commands since a fault: joint_3"):
        axes.prepare(move(axes, 0.1))
    off_and_at_rest(mock)
    axes.connect()
    assert "8611h" in axes.identity.details["faults_reset"]
    follow(axes, move(axes, 0.05))


def test_a_fault_of_the_hardware_is_for_a_person_to_reset(mock, axes, tmp_path, capsys) -> None:
    mock.tell("fault", kind="emergency", axis=2, code=0x2310)
    assert "2310h" in until_it_raises(axes).message
    with pytest.raises(RobotFault, match=r"joint_2.*continuous over-current.*2310h") as caught:
        axes.connect()
    assert "python -m hil_drivers.cia402 reset" in str(caught.value.hint)
    station = station_for(mock, tmp_path)
    assert main(["reset", str(station), "lab6_can"]) == 0
    assert "joint_2 (node 2) is in fault: continuous over-current" in capsys.readouterr().out
    axes.connect()
    follow(axes, move(axes, 0.05))


def test_an_axis_that_falls_silent_stops_the_others(mock, axes) -> None:
    begin(axes, move(axes, 0.8))
    mock.tell("fault", kind="sync_ignored", axis=5, for_s=1.0)
    error = until_it_raises(axes)
    assert isinstance(error, RobotFault)
    assert "joint_5" in error.message
    off_and_at_rest(mock)


def test_rows_in_which_an_axis_ignores_set_points_are_masked(mock, axes) -> None:
    begin(axes, move(axes, 0.8))
    mock.tell("fault", kind="bit12_low", axis=4, for_s=1.0)
    rows = until_masked(axes)
    assert (rows["status"] & int(Status.MASKED)).any()
    assert "joint_4" in until_it_raises(axes).message


def test_an_arm_led_by_torque_moves_is_stopped_and_moves_again(mock) -> None:
    mock.tell("clear")
    more = {"trajectory_mode": "cst", "rate_hz": 200, "pace": "free"}
    with closing(AxesRobot("arm", "lab6", **options(mock, **more))) as led:
        led.connect()
        segment = move(led, 0.4)
        begin(led, segment)
        led.stop()
        settle(led)
        rows = follow(led, move(led, 0.05))
    assert (rows["mode"] == 10).all()
    assert np.abs(rows["q"] - rows["q_target"]).max() < 0.06
    assert np.abs(rows["effort_target"] - rows["effort"]).max(axis=0)[1] < 10.0


# -- loads, temperatures, raw integers


def test_a_declared_load_is_felt_by_the_drives(free_axes) -> None:
    axes = free_axes
    settle(axes)
    before = np.mean([axes.read()[-1]["effort"] for _ in range(20)], axis=0)
    assert axes.set_payload(Payload(5.0, (0.0, 0.0, 0.05))).mass == pytest.approx(5.0)
    settle(axes)
    sagged = axes.read()["device_time"][-1] + 0.3
    while axes.read()["device_time"][-1] < sagged:
        pass
    after = np.mean([axes.read()[-1]["effort"] for _ in range(20)], axis=0)
    axes.set_payload(Payload())
    assert np.abs(after - before)[1:3].max() > 10.0


def test_rows_have_temperatures_and_every_integer_is_recorded(free_axes) -> None:
    axes = free_axes
    rows = follow(axes, move(axes, 0.1))
    raw = axes.drain()[TOPIC]
    assert np.isfinite(rows["temperature"]).all()
    assert np.isin(rows["device_time"], raw["device_time"]).all()
    assert (np.diff(raw["cycle"]) == 1).all()
    last = raw[raw["device_time"] == rows["device_time"][-1]][0]
    resolution = axes.identity.details["position_resolution_rad"].split()
    q = last["position"] * np.array([float(each) for each in resolution])
    assert q == pytest.approx(rows["q"][-1], rel=1e-4, abs=1e-6)


def test_what_was_looked_at_before_a_motion_is_told_with_its_figures(mock, axes) -> None:
    with mock.bus() as bus:
        bus.send(can.Message(arbitration_id=0x1FE, data=[1], is_extended_id=False))
    mock.wait_until(
        lambda _: "foreign nodes" in {f.name: f for f in axes.checks()}["cycle"].message
    )
    found = {finding.name: finding for finding in axes.checks()}
    assert set(found) >= {
        "drives", "drives-enabled", "bus-load", "scaling", "joint-limits", "torque-limits",
        "drives-watch", "temperatures", "cycle",
    }  # fmt: skip
    assert all(finding.passed for name, finding in found.items() if name != "cycle")
    assert "49% to 59%" in found["bus-load"].message
    assert "real-time" in found["cycle"].message


# -- whole experiments


SHORT = {
    "hil": 1,
    "name": "can-short",
    "robot": "lab6_can",
    "excitation": {
        "kind": "fourier", "trajectories": 2, "harmonics": 3, "fundamental_hz": 0.4, "seed": 7,
        "max_velocity_deg_s": 60, "max_acceleration_deg_s2": 300,
    },
    "warm_up": {"duration_s": 0},
    "reference": {"every": 0},
    "fit": [{"estimator": "rigid-wls"}],
    "validate": {"hold_out": {"trajectories": 1}},
    "accept": {"gaps_percent": {"max": 0.1}},
}  # fmt: skip


def run(mock: MockCan, folder: Path, **more: Any) -> subprocess.Popen[str]:
    (folder / "spec.yaml").write_text(yaml.safe_dump(SHORT), "utf-8")
    station_for(mock, folder, **more)
    asked = ["spec.yaml", "--station", "station.yaml", "--runs", "runs", "--json"]
    command = [sys.executable, "-m", "hil", "run", *asked]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, start_new_session=True, **pipes)


@pytest.mark.journey
def test_an_experiment_runs_over_can_frames_without_a_gap(mock, tmp_path) -> None:
    with run(mock, tmp_path, pace="free") as process:
        out, err = process.communicate(timeout=100)
    assert process.returncode == 0, err[-3000:]
    said = json.loads(out)
    assert said["outcome"] == "completed"
    assert (said["gaps"], said["duplicates"]) == (0, 0)
    folder = tmp_path / said["run"]
    start = json.loads((folder / "start.json").read_text())
    assert start["robot"]["effort_kind"] == "torque"
    assert "rated_torque" in start["robot"]["identity"]["details"]
    rows = read_topic(folder / "recording" / "00.mcap")
    raw = read_topic(folder / "recording" / "00.mcap", TOPIC)
    assert np.diff(rows["device_time"]) == pytest.approx(0.004)
    assert len(raw) == len(rows)
    moving = (rows["status"] & int(Status.MOVING)) > 0
    assert np.abs(rows["q"] - rows["q_target"])[moving].max() < 0.01
    assert not (rows["status"] & int(Status.MASKED))[moving].any()


def test_an_interrupt_in_a_trajectory_brings_the_arm_to_rest(mock, tmp_path) -> None:
    with run(mock, tmp_path, pace="free") as process:
        mock.wait_until(lambda state: max(map(abs, state["qd"])) > 0.3, within_s=90.0)
        process.send_signal(signal.SIGINT)
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err[-3000:]
    off_and_at_rest(mock)


def test_a_fault_for_a_person_stays_one_however_often_somebody_connects(mock, tmp_path) -> None:
    mock.tell("clear")
    mock.tell("fault", kind="emergency", axis=3, code=0x2310)
    mock.wait_until(lambda state: state["states"][2] == "FAULT")
    for _ in range(2):
        with pytest.raises(RobotFault, match=r"joint_3.*over-current.*2310h"):
            AxesRobot("arm", "lab6", **options(mock, pace=PACE)).connect()
        time.sleep(0.4)  # longer than a drive waits for our heartbeat
    assert mock.state()["errors"][2] == 0x2310
    assert main(["reset", str(station_for(mock, tmp_path)), "lab6_can"]) == 0
    with closing(AxesRobot("arm", "lab6", **options(mock, pace=PACE))) as axes:
        axes.connect()


# The same arm on SocketCAN: a virtual interface of the kernel, where it has one.


INTERFACE = "vcan0"


def missing() -> str:
    """Why SocketCAN cannot be tried here; empty when it can."""
    if not hasattr(socket, "AF_CAN"):
        return "this Python knows no AF_CAN"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return f"this kernel has no CAN: {error.strerror}"
    up = INTERFACE in [name for _, name in socket.if_nameindex()]
    return (
        "" if up else f"no interface: ip link add {INTERFACE} type vcan; ip link set {INTERFACE} up"
    )


@pytest.mark.wire
@pytest.mark.skipif(bool(missing()), reason=missing())
def test_an_arm_on_socketcan_follows(tmp_path: Path) -> None:
    side = str(tmp_path / "side")
    bus = {"interface": "socketcan", "channel": INTERFACE}
    with (
        mock_can("--interface", "socketcan", "--side", side, channel=INTERFACE),
        closing(Cia402Robot("arm", "lab6", bus=bus, late_cycles=50)) as robot,
    ):
        robot.connect()
        rows = follow(robot, move(robot, 0.1))
    assert np.abs(rows["q"] - rows["q_target"]).max() < 0.01
