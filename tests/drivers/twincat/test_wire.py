"""The TwinCAT driver and the mock PLC over real ADS frames, and whole experiments."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hil.core.errors import (
    CommandRefused,
    HilError,
    PluginError,
    RobotConnectionError,
    RobotError,
    RobotFault,
    RobotTimeout,
)
from hil.recording.mcap_reader import read_topic
from hil.robot import Status
from hil.testing.moves import begin, follow, move, settle
from hil_drivers import network
from hil_drivers.twincat import controller
from hil_drivers.twincat.reading import TOPIC
from hil_drivers.twincat.robot import TwinCatRobot
from hil_drivers.twincat.variables import CONTRACT
from tests.support.in_time import InTime, measured_again
from tests.support.mock_servers import MockPlc, loopback, mock_plc
from tests.support.paths import EXPERIMENTS
from tests.support.waiting import until

pytestmark = [pytest.mark.wire]

READING_S = 2.0


@pytest.fixture(scope="module")
def plc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MockPlc]:
    with mock_plc(tmp_path_factory.mktemp("plc")) as running:
        yield running


@pytest.fixture
def robot(plc: MockPlc) -> Iterator[TwinCatRobot]:
    made = TwinCatRobot("arm", "lab6", address=plc.address)
    made.connect()
    yield made
    plc.side(clear=True)
    made.close()


@pytest.mark.journey
def test_a_second_and_a_thousand_rows_none_missing_none_twice(robot):
    """Read at odd moments, in odd portions, while the arm moves."""
    robot.prepare(move(robot, 0.4, "trajectory"))
    robot.start()
    robot.drain()
    blocks, end, random = [], time.monotonic() + READING_S, np.random.default_rng(1)
    while time.monotonic() < end:
        blocks.append(robot.read())
        time.sleep(random.uniform(0, 0.15))
    rows, told = np.concatenate(blocks), robot.drain()[TOPIC]
    assert (np.diff(told["sequence"]) == 1).all()
    assert np.diff(rows["device_time"]) == pytest.approx(0.001)
    assert (told["gaps"][-1], told["lost"][-1]) == (0, 0)
    assert len(rows) == len(told)
    assert len(rows) > 0.9 * READING_S * 1000
    assert len(rows) / len(blocks) >= 100  # each request is worth its millisecond


@pytest.mark.journey
def test_what_is_played_is_what_was_planned_to_the_last_bit(robot):
    segment = move(robot, 0.2, "trajectory")
    rows = follow(robot, segment)
    played = rows[(rows["status"] & Status.MOVING) != 0]
    for name in ("q", "qd", "qdd"):
        assert np.array_equal(played[f"{name}_target"], getattr(segment, name)), name


def test_a_second_client_gets_the_arm_only_when_the_first_lets_go(robot, plc):
    other = TwinCatRobot("other", "lab6", address=plc.address)
    with pytest.raises(CommandRefused, match="another client controls the arm"):
        other.connect()
    robot.read()
    # `pyads` has one router per process: a route that the other one has deleted is ours, too.
    robot.close()
    other.connect()
    other.close()


def test_other_ads_tools_see_symbols_and_values(plc):
    import pyads

    with pyads.Connection(f"{plc.address}.1.1", 851, plc.address) as tool:
        assert tool.read_state() == (pyads.ADSSTATE_RUN, 0)
        assert tool.read_by_name("GVL_Hil.nContract", pyads.PLCTYPE_UDINT) == CONTRACT
        assert tool.get_symbol("gvl_hil.nstop").symbol_type == "UDINT"
        told = tool.read_list_by_name(["GVL_Hil.nContract", "GVL_Hil.nStop"])
        assert told["GVL_Hil.nContract"] == CONTRACT
        with pytest.raises(pyads.ADSError, match="symbol not found"):
            tool.read_by_name("GVL_Hil.nNothing", pyads.PLCTYPE_UDINT)


def under_way(robot):
    begin(robot, move(robot, 0.4, "trajectory"))


def read_on(robot):
    for _ in range(100):
        robot.read(0.5)


def until_it_raises(robot, kind, match):
    with pytest.raises(kind, match=match):
        read_on(robot)


IN_MAKE_TEST = ("emergency_stop", "online_change")
WRONG = (
    ({"kind": "emergency_stop"}, RobotFault, "fault 5: emergency stop"),
    ({"kind": "drive_fault", "code": 34321}, RobotFault, "fault 34321: drive fault 0x8611"),
    ({"kind": "freeze", "for_s": 2}, RobotTimeout, "its task does not run"),
    ({"kind": "silence", "for_s": 3}, RobotTimeout, "has not answered within 0.5 s"),
    ({"kind": "cut"}, RobotError, "connection is lost|has not answered"),
    ({"kind": "config", "for_s": 1}, RobotConnectionError, "no PLC runtime answers"),
    ({"kind": "online_change"}, RobotFault, "changed online"),
    ({"kind": "restart"}, RobotConnectionError, "was restarted"),
)


@pytest.mark.parametrize(
    ("fault", "kind", "said"),
    [
        pytest.param(*each, marks=() if each[0]["kind"] in IN_MAKE_TEST else pytest.mark.proof)
        for each in WRONG
    ],
    ids=[str(each[0]["kind"]) for each in WRONG],
)
def test_what_goes_wrong_in_a_motion_ends_it_and_is_told(robot, plc, fault, kind, said):
    under_way(robot)
    plc.side(**fault)
    until_it_raises(robot, kind, said)
    with pytest.raises(HilError):
        robot.prepare(move(robot, 0.1))
    plc.side(clear=True)
    time.sleep(0.1)
    robot.close()
    connected_again(robot)
    settle(robot)
    follow(robot, move(robot, 0.02))


def connected_again(robot, within_s=8.0):
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        with suppress(HilError):
            return robot.connect()
        time.sleep(0.1)
    return robot.connect()


@measured_again
def test_nobody_is_waited_for_longer_than_was_asked_for(robot, plc):
    plc.side(kind="silence", for_s=0.3)
    time.sleep(0.05)
    own = InTime()
    with pytest.raises(RobotTimeout, match=r"has not answered within 0\.05 s"):
        robot.read(0.05)
    took = own.taken()
    plc.side(clear=True)
    time.sleep(0.3)
    assert len(robot.read())
    took.require(0.3)


def test_set_points_that_arrive_spoilt_are_not_played(robot, plc):
    segment = move(robot, 0.05)
    plc.side(kind="spoil")
    time.sleep(0.05)
    with pytest.raises(CommandRefused, match="the received set-points differ from those sent"):
        robot.prepare(segment)
    plc.side(clear=True)
    time.sleep(0.05)
    follow(robot, segment)


def test_a_stop_between_prepare_and_start_holds(robot):
    robot.prepare(move(robot, 0.2))
    prepared = robot._prepared
    robot.stop()
    robot._prepared = prepared  # as when the stop came in the middle of start()
    with pytest.raises(CommandRefused, match="the arm was stopped meanwhile"):
        robot.start()


CLIENT = """
import sys, time
from hil.testing.moves import begin, move
from hil_drivers.twincat.robot import TwinCatRobot
robot = TwinCatRobot("arm", "lab6", address=sys.argv[1])
robot.connect()
begin(robot, move(robot, 1.5, "trajectory"))
print("moving", flush=True)
while True:
    robot.read()
"""


def test_the_plc_stops_the_arm_when_its_client_is_killed(plc):
    client = subprocess.Popen(
        [sys.executable, "-c", CLIENT, plc.address], stdout=subprocess.PIPE, text=True
    )
    assert client.stdout is not None
    with client.stdout:
        assert client.stdout.readline() == "moving\n"
        killed = time.monotonic()
        os.kill(client.pid, signal.SIGKILL)
        client.wait(10)
    until(lambda: [each for each in plc.journal("rest") if each["monotonic_s"] > killed])
    watchdog, rest = plc.journal("watchdog")[-1], plc.journal("rest")[-1]
    assert rest["after"] == "watchdog"
    assert rest["device_time"] - watchdog["device_time"] < 3.0
    assert watchdog["speed_rad_s"] > 0.1
    assert rest["speed_rad_s"] < 0.01
    assert watchdog["monotonic_s"] - killed < 0.3 + 0.2  # its watchdog, and a busy computer
    robot = TwinCatRobot("arm", "lab6", address=plc.address)
    robot.connect()
    follow(robot, move(robot, 0.1))
    robot.close()


def pass_quickly(plc, seconds):
    """Let device time pass while nobody reads."""
    end = plc.tell("state")["device_time"] + seconds
    plc.side(speed=40)
    until(lambda: plc.tell("state")["device_time"] > end, every_s=0.02)
    plc.side(speed=1)


def test_a_slow_reader_loses_rows_and_says_how_many(robot, plc):
    follow(robot, move(robot, 0.02))
    robot.drain()
    blocks = [robot.read()]
    pass_quickly(plc, 20.0)  # the PLC's ring holds 16 s
    blocks += [robot.read(), robot.read()]
    told, finding = robot.drain()[TOPIC], robot.checks()[-1]
    steps = np.diff(np.concatenate(blocks)["device_time"])
    missing = round(steps.max() / 0.001) - 1
    assert missing > 2000
    assert (steps > 0.0015).sum() == 1
    assert (told["gaps"][-1], told["lost"][-1]) == (1, missing)
    assert not finding.passed
    assert f"{missing} rows lost in 1 gaps" in finding.message


def test_what_nobody_reads_before_anything_is_started_is_left_out_and_no_loss(robot, plc):
    pass_quickly(plc, 20.0)
    rows, told, finding = robot.read(), robot.drain()[TOPIC], robot.checks()[-1]
    assert len(rows) <= 5000
    assert told["skipped"][-1] > 2000
    assert told["lost"][-1] == 0
    assert finding.passed


@contextmanager
def bare_plc(*, without=(), contract=None, model="lab6", cycle_s=0.001):
    """The PLC's memory behind ADS, in this process: nothing runs in it."""
    from hil.arms import load_arm
    from hil_mock_robot.twincat.ads import Links, PlcHandler
    from hil_mock_robot.twincat.memory import Memory

    address, memory, arm = loopback(), Memory(without), load_arm("lab6")
    info = memory.view("stInfo")[0]
    info["fCycleS"], info["nAxes"], info["nEffort"] = cycle_s, 6, 1
    info["aQMin"], info["aQMax"], info["aQdMax"] = arm.q_min, arm.q_max, arm.qd_max
    info["nRingRows"], info["nSetPoints"] = (
        len(memory.view("aRing")),
        len(memory.view("aSetPoints")),
    )
    info["sModel"] = model.encode()
    if contract is not None:
        memory.view("nContract")[0] = contract
    links, over = Links(address, PlcHandler(memory, 851)), threading.Event()

    def serve():
        while not over.is_set():
            links.serve(0.01)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield address
    finally:
        over.set()
        thread.join()
        links.cut()


@pytest.mark.parametrize(
    ("plc_is", "kind", "said"),
    [
        (
            {"contract": 1},
            PluginError,
            "implements version 1 of the contract, this driver version 2",
        ),
        ({"without": ["aRing"]}, PluginError, "has no variable GVL_Hil.aRing"),
        ({"model": "ur5"}, RobotConnectionError, "its arm is ur5, the station has lab6"),
        ({"cycle_s": 0.002}, RobotConnectionError, "its cycle is 2 ms, rate_hz is for 1 ms"),
        ({}, RobotTimeout, "the PLC has not answered within 0.3 s: take the arm"),
    ],
    ids=["version", "symbol", "model", "cycle", "dead program"],
)
def test_a_plc_that_is_not_the_right_one_is_told_in_one_sentence(plc_is, kind, said, monkeypatch):
    monkeypatch.setattr(controller.Orders.give, "__defaults__", (0.3,))
    with bare_plc(**plc_is) as address, pytest.raises(kind, match=said) as told:
        TwinCatRobot("arm", "lab6", address=address).connect()
    assert told.value.hint
    assert "\n" not in told.value.message


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "no connection to port 48898: Connection refused"),
        ({"address": "127.0.0.1:1"}, "no connection to port 1"),
    ],
)
def test_a_plc_that_is_not_there_is_named(options, said, monkeypatch):
    monkeypatch.setattr(network, "STARTING_S", 0.2)  # a mock on this computer may be starting
    robot = TwinCatRobot("arm", "lab6", **({"address": loopback()} | options))
    with pytest.raises(RobotConnectionError, match=said):
        robot.connect()


def test_another_ams_port_is_no_runtime(plc):
    with pytest.raises(RobotConnectionError, match="no PLC runtime answers"):
        TwinCatRobot("arm", "lab6", address=plc.address, port=852).connect()


def test_the_effort_that_the_plc_tells_is_compared_with_the_station(plc):
    with pytest.raises(
        RobotConnectionError, match="it reports torque, the option effort is current"
    ):
        TwinCatRobot("arm", "lab6", address=plc.address, effort="current").connect()


# A whole experiment behind a PLC: the shipped spec and station, made short.


def shortened(folder: Path, address: str) -> tuple[Path, Path]:
    spec = yaml.safe_load((EXPERIMENTS / "twincat_fourier.yaml").read_text())
    spec["excitation"] |= {"trajectories": 3, "fundamental_hz": 0.5, "harmonics": 3}
    spec["warm_up"], spec["reference"] = {"duration_s": 1}, {"every": 0}
    spec["validate"] = {"hold_out": {"trajectories": 1}}
    spec["accept"] = {"rmse": {"max": 20, "unit": "N·m", "per": "mean"}, "gaps_percent": {"max": 0}}
    station = yaml.safe_load((EXPERIMENTS / "stations" / "lab6_twincat_mock.yaml").read_text())
    station["robots"]["lab6"]["options"]["address"] = address
    paths = folder / "spec.yaml", folder / "station.yaml"
    for path, told in zip(paths, (spec, station), strict=True):
        path.write_text(yaml.safe_dump(told))
    return paths


def run(spec: Path, station: Path, folder: Path) -> dict[str, Any]:
    asked = ("run", spec, "--station", station, "--runs", folder, "--json")
    command = [sys.executable, "-m", "hil", *map(str, asked)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


@pytest.mark.wire
@pytest.mark.timeout(240)
def test_an_experiment_behind_a_plc_is_recorded_at_1_khz_without_a_gap(tmp_path: Path) -> None:
    with mock_plc(tmp_path, "--speed", "8") as running:
        spec, station = shortened(tmp_path, running.address)
        said = run(spec, station, tmp_path / "runs")
        commands = {line["by"] for line in running.journal("command")}
    assert (said["outcome"], said["verdict"]) == ("completed", "passed")
    assert (said["gaps"], said["duplicates"]) == (0, 0)
    recording = Path(said["run"]) / "recording" / "00.mcap"
    rows, told = read_topic(recording), read_topic(recording, TOPIC)
    assert np.diff(rows["device_time"]) == pytest.approx(0.001)
    assert (np.diff(told["sequence"]) == 1).all()
    start = json.loads((Path(said["run"]) / "start.json").read_text())
    assert start["robot"]["identity"]["driver"] == "twincat"
    assert {"take", "load", "start", "payload", "release"} <= commands


@pytest.mark.wire
@pytest.mark.timeout(240)
@pytest.mark.proof
@pytest.mark.timeout(600)
def test_the_shipped_experiment_of_twelve_trajectories_passes(tmp_path: Path) -> None:
    with mock_plc(tmp_path, "--speed", "5") as running:
        _, station = shortened(tmp_path, running.address)
        said = run(EXPERIMENTS / "twincat_fourier.yaml", station, tmp_path / "runs")
    assert (said["outcome"], said["verdict"]) == ("completed", "passed")
    assert (said["gaps"], said["duplicates"]) == (0, 0)
    assert said["samples"] > 150_000
