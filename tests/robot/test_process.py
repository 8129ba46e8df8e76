"""A robot whose driver lives in a process of its own behaves as if it did not."""

from __future__ import annotations

import datetime
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.arms.payload import Payload
from hil.core.errors import (
    CommandRefused,
    PluginError,
    RobotConnectionError,
    RobotError,
    RobotFault,
    SpecError,
)
from hil.planning.robots import connected, open_robot, opened
from hil.robot import HasChecks, HasResource, HasSpeedScaling, HasTopics, Robot
from hil.robot.subprocess_robot import RobotProcess
from hil.spec.station import StationRobot
from hil.testing.moves import move
from hil.workflow.checks import check_driver
from hil_mock_robot.embedded.robot import MockRobot
from tests.support.paths import EXPERIMENTS, ROOT
from tests.support.process_drivers import WithTopics
from tests.support.process_inspected import Inspected

Make = Callable[..., RobotProcess]


@pytest.fixture
def make() -> Iterator[Make]:
    """Makes robots of this folder's drivers, and closes them."""
    made = []

    def one(driver: str = "Kinematic", **options: Any) -> RobotProcess:
        made.append(
            RobotProcess(f"tests.support.process_drivers:{driver}", "bench", "ur5", options)
        )
        return made[-1]

    yield one
    for robot in made:
        robot.close()


def program(robot: Robot) -> list[bytes]:
    """What a robot says while it is moved, loaded and stopped."""
    robot.connect()
    told = [robot.read()]
    robot.set_payload(Payload(1.0, (0.0, 0.01, 0.05)))
    segment = move(robot, 0.2)
    robot.prepare(segment)
    robot.start()
    told += [robot.read() for _ in range(4)]
    robot.stop()
    told += [robot.read() for _ in range(10)]
    robot.close()
    for block in told:
        block["segment"] = np.sign(block["segment"])
    return [block.tobytes() for block in told]


@pytest.mark.thorough
def test_the_mock_says_the_same_bytes_from_its_own_process() -> None:
    here = MockRobot("bench", "ur5", seed=4)
    there = RobotProcess("mock", "bench", "ur5", {"seed": 4})
    assert program(here) == program(there)


@pytest.mark.thorough
def test_names_limits_and_payload_cross_unchanged() -> None:
    station = {"driver": "mock", "model": "ur10e", "gravity_m_s2": (0.0, 0.0, 9.81)}
    with (
        connected("a", StationRobot(**station)) as here,
        connected("a", StationRobot(**station, own_process=True)) as there,
    ):
        assert isinstance(there, RobotProcess)
        assert there.capabilities == here.capabilities
        assert there.identity == here.identity
        assert there.identity.details["gravity_m_s2"] == "0 0 9.81"
        for name in ("q_min", "q_max", "qd_max", "qdd_max", "effort_max", "payload_max_kg"):
            assert np.array_equal(getattr(there.limits, name), getattr(here.limits, name))
        load = Payload(0.7, (0.0, 0.01, 0.1), (2e-3, 2e-3, 3e-3, 0.0, 1e-5, 0.0))
        assert there.set_payload(load) == load


def test_a_driver_has_no_process_of_its_own_unless_the_station_says_so() -> None:
    assert isinstance(open_robot("a", StationRobot(driver="mock", model="ur5")), MockRobot)


def test_what_a_driver_opts_into_its_process_has_too(make: Make) -> None:
    plain, rich = make(), make("WithTopics")
    assert not isinstance(plain, HasTopics | HasResource | HasChecks)
    assert isinstance(rich, HasTopics)
    assert isinstance(rich, HasResource)
    assert list(rich.topics) == list(WithTopics("bench", "ur5").topics)
    assert rich.resource == "bench://7"
    rich.connect()
    rich.read()
    drained = rich.drain()
    assert {name: rows["ticks"].tolist() for name, rows in drained.items()} == {
        "/raw": [[1, 2], [3, 8]]
    }


def test_what_a_robot_finds_about_itself_its_process_tells() -> None:
    robot = RobotProcess("tests.support.process_inspected:Inspected", "bench", "ur5")
    try:
        robot.connect()
        assert isinstance(robot, HasChecks)
        assert list(robot.checks()) == list(Inspected("bench", "ur5").checks())
    finally:
        robot.close()


def test_errors_arrive_as_what_they_are(make: Make) -> None:
    robot = make()
    robot.connect()
    with pytest.raises(CommandRefused, match="nothing is prepared"):
        robot.start()
    fault = make(answer="fault")
    fault.connect()
    with pytest.raises(RobotFault, match="joint 3 burns") as caught:
        fault.set_payload(Payload())
    assert caught.value.hint == "extinguish it"


@pytest.mark.parametrize(("answer", "said"), [("bug", "ZeroDivisionError"), ("exit", "SystemExit")])
def test_a_bug_in_a_driver_is_told_and_survived(make: Make, answer: str, said: str) -> None:
    robot = make(answer=answer)
    robot.connect()
    with pytest.raises(RobotError, match=f"unexpected {said}") as caught:
        robot.set_payload(Payload())
    assert "process_drivers.py" in caught.value.message
    assert len(robot.read())


def test_what_a_driver_prints_stays_out_of_the_terminal(
    make: Make, capfd: pytest.CaptureFixture[str]
) -> None:
    robot = make(answer="print")
    robot.connect()
    for _ in range(3):
        robot.set_payload(Payload())
    assert robot.process
    robot.process.stop()
    until = time.monotonic() + 2.0
    while not (printed := robot.process.printed) and time.monotonic() < until:
        time.sleep(0.01)  # it is being cut short just now: empty for a moment
    assert "complains at length\n" in printed
    assert len(printed) < 10_000
    assert capfd.readouterr() == ("", "")


def test_an_option_the_driver_does_not_have_is_a_mistake_in_the_station() -> None:
    experiment = hil.load(EXPERIMENTS / "ci_dwell_12.yaml")
    for options, said in (({"sede": 1}, "no option sede"), ({"rate_hz": -1}, "rate_hz")):
        robot = StationRobot(driver="mock", model="ur5", options=options, own_process=True)
        object.__setattr__(experiment, "robot", robot)
        with pytest.raises(SpecError, match=rf"robots\.ur5: .*{said}"):
            check_driver(experiment)
    robot = StationRobot(
        driver="tests.support.process_drivers:Kinematic",
        model="ur5",
        options={"fast": 1},
        own_process=True,
    )
    object.__setattr__(experiment, "robot", robot)
    with pytest.raises(SpecError, match=r"does not accept its options \(fast\)"):
        check_driver(experiment)


def test_an_option_that_cannot_be_sent_is_refused_before_there_is_a_process() -> None:
    with pytest.raises(SpecError, match="option since"):
        RobotProcess("mock", "a", "ur5", {"since": datetime.date(2026, 1, 1)})


def test_gravity_that_contradicts_the_mount_is_refused() -> None:
    described = StationRobot(
        driver="mock", model="ur5", options={"mount": "ceiling"}, own_process=True
    )
    with pytest.raises(SpecError, match="mount"), opened("a", described):
        pass


@pytest.mark.parametrize(
    ("driver", "said"),
    [
        ("mok", "did you mean 'mock'"),
        ("tests.support.process_drivers:Nobody", "does not load: AttributeError"),
        ("no_such_module:Arm", "No module named .no_such_module"),
    ],
)
def test_a_driver_that_is_not_there_is_a_plugin_error(driver: str, said: str) -> None:
    with pytest.raises(PluginError, match=said):
        RobotProcess(driver, "a", "ur5")


def test_a_robot_that_was_closed_can_be_connected_again(make: Make) -> None:
    robot = make()
    robot.connect()
    first = robot.process
    robot.close()
    with pytest.raises(RobotConnectionError, match="not connected"):
        robot.identity  # noqa: B018
    robot.connect()
    assert len(robot.read())
    assert first
    assert robot.process
    assert robot.process.pid != first.pid


def open_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_closing_leaves_neither_process_nor_descriptors(make: Make) -> None:
    make().close()
    before = open_descriptors()
    for connects in (False, True):
        robot = make()
        assert robot.process
        pid = robot.process.pid
        if connects:
            robot.connect()
        robot.close()
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    assert open_descriptors() == before


def test_a_robot_that_is_forgotten_ends_its_process() -> None:
    robot = RobotProcess("tests.support.process_drivers:Kinematic", "bench", "ur5")
    assert robot.process
    pid = robot.process.pid
    del robot
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_process_made_by_fork_neither_keeps_nor_ends_the_driver(make: Make) -> None:
    robot = make()
    robot.connect()
    fork = os.fork()
    if fork == 0:
        robot.stop()
        del robot
        signal.pause()
    try:
        assert len(robot.read())
        assert robot.process
        pid = robot.process.pid
        robot.close()
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
    finally:
        os.kill(fork, signal.SIGKILL)
        os.waitpid(fork, 0)


def test_a_driver_that_is_refused_leaves_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    from hil.robot import subprocess_robot

    begun = []
    spawn = subprocess_robot.spawn
    monkeypatch.setattr(subprocess_robot, "spawn", lambda o: begun.append(spawn(o)) or begun[-1])
    with pytest.raises(SpecError):
        RobotProcess("mock", "a", "ur5", {"sede": 1})
    assert [process.returncode for process in begun] == [0]


def test_the_environment_of_the_driver_is_the_one_hil_was_started_with(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/nowhere")
    robot = make("Environment")
    robot.connect()
    assert robot.identity.details["PYTHONPATH"] == "/nowhere"


def test_a_drivers_process_starts_light() -> None:
    code = "import sys, hil.robot.subprocess_server; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert loaded.isdisjoint({"mcap", "pydantic", "scipy", "pinocchio", "mujoco", "yaml", "typer"})


@pytest.mark.thorough
def test_a_whole_run_goes_through_a_driver_in_its_own_process(tmp_path: Path) -> None:
    station = tmp_path / "station.yaml"
    station.write_text(
        "hil_station: 1\nrobots: {ur5: {driver: mock, model: ur5, own_process: true}}\n", "utf-8"
    )
    report = hil.run(hil.load(ROOT / "experiments/ci_dwell_12.yaml", station), runs=tmp_path)
    assert report.error is None
    assert (report.outcome, report.verdict, report.gaps) == ("completed", "passed", 0)


@pytest.mark.thorough
@pytest.mark.parametrize("member", ["_open", "_ask"])
def test_a_stop_while_connecting_refuses_and_closes(
    make: Make, monkeypatch: pytest.MonkeyPatch, member: str
) -> None:
    robot = make()
    robot.close()
    do, when = getattr(robot, member), []

    def stopped(*what: Any) -> Any:
        if not when:
            when.append(robot.stop())
        return do(*what)

    monkeypatch.setattr(robot, member, stopped)
    with pytest.raises(CommandRefused, match="stopped while connecting"):
        robot.connect()
    assert robot.process is None
    robot.connect()
    assert len(robot.read())


def test_the_speed_scaling_of_its_controller_comes_with_the_rows(make: Make) -> None:
    robot = make("WithSlider")
    assert isinstance(robot, HasSpeedScaling)
    assert not isinstance(make(), HasSpeedScaling)
    robot.connect()
    assert math.isnan(robot.speed_scaling)
    robot.read()
    assert robot.speed_scaling == 0.7
