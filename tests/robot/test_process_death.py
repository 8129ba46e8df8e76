"""Whatever dies or hangs on either side of the line to a driver's process: the arm is stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from hil.arms.payload import Payload
from hil.core.errors import RobotConnectionError, RobotTimeout
from hil.robot import Segment, Status, subprocess_robot
from hil.robot.ipc import pack
from hil.robot.subprocess_robot import READ_GRACE_S, STOP_WITHIN_S, RobotProcess
from tests.support.in_time import InTime, measured_again
from tests.support.process_drivers import events

pytestmark = pytest.mark.wire

WITHIN_S = 0.1
"""From the cause to the driver's `stop`, in wall time [s]."""

Make = Callable[..., RobotProcess]


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    return tmp_path / "journal"


@pytest.fixture
def make(journal: Path) -> Iterator[Make]:
    """Makes connected arms in wall time that keep the journal; closes them."""
    made = []

    def one(**options: Any) -> RobotProcess:
        journal.unlink(missing_ok=True)  # a measurement may be made again
        robot = RobotProcess(
            "tests.support.process_drivers:WallArm",
            "bench",
            "ur5",
            {"journal": str(journal), **options},
        )
        made.append(robot)
        robot.connect()
        return robot

    yield one
    for robot in made:
        robot.close()


def long_way(seconds: float = 60.0, rate_hz: float = 100.0) -> Segment:
    q = np.linspace(0, 1, int(seconds * rate_hz))[:, None] * np.ones(3)
    return Segment(3, "move", q, np.zeros_like(q), np.zeros_like(q), 0.1, 1.0)


def set_off(robot: RobotProcess) -> None:
    robot.prepare(long_way())
    robot.start()
    assert robot.read()[-1]["status"] & Status.MOVING


def pid_of(robot: RobotProcess) -> int:
    assert robot.process is not None
    return robot.process.pid


def wait_for(journal: Path, event: str, within_s: float = 5.0) -> float:
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        if event in (noted := events(journal)):
            return noted[event]
        time.sleep(0.01)
    raise AssertionError(f"no {event!r} within {within_s:g} s: {events(journal)}")


def wait_for_end(pid: int, within_s: float = 5.0) -> None:
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        # A process whose parent is dead may stay as a zombie where nobody collects it.
        status = Path(f"/proc/{pid}/stat")
        if not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.01)
    raise AssertionError(f"process {pid} still lives")


def impatient(ours: tuple[int, ...]) -> subprocess.Popen[bytes]:
    """A driver's process as it is, but for the times it allows."""
    code = (
        "import sys, hil.robot.subprocess_server as child;"
        "child.HELD_S = 0.6; child.REST_S = 0.3; child.LAST_WORD_S = 0.3; child.UNREAD_S = 0.4;"
        "child.main(sys.argv[1:])"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, ours)],
        stdin=subprocess.DEVNULL,
        stdout=ours[-1],
        stderr=ours[-1],
        pass_fds=ours,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


PARENT = """
import sys
from tests.robot.test_process_death import set_off
from hil.robot.subprocess_robot import RobotProcess
arm = "tests.support.process_drivers:WallArm"
robot = RobotProcess(arm, "bench", "ur5", {"journal": sys.argv[1]})
robot.connect()
set_off(robot)
sys.stdout.write(f"{robot.process.pid}\\n")
sys.stdout.flush()
while True:
    robot.read()
"""


MOVES_THE_MOCK = """
import json
from hil.testing.moves import begin, move
robot = RobotProcess("mock", "bench", "ur5", {"clock": "wall", "journal": sys.argv[1]})
robot.connect()
begin(robot, move(robot, 2.0))
with open(sys.argv[1], "a") as journal:
    journal.write(json.dumps({"event": "under way", "t": 0, "monotonic_s": 0}) + "\\n")
while True:
    robot.read()
"""


def a_parent(journal: Path) -> tuple[subprocess.Popen[str], int]:
    """A process that moves an arm, and the process of the arm's driver."""
    journal.unlink(missing_ok=True)
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(journal)],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    return parent, int(parent.stdout.readline())


def killed(process: subprocess.Popen[Any]) -> float:
    """When it was dead: a busy computer takes its time to kill."""
    process.kill()
    process.wait()
    dead = time.monotonic()
    process.communicate()
    return dead


def child_of(pid: int) -> int:
    """The process that a process has started; it has one."""
    told = [path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")]
    (child,) = " ".join(told).split()
    return int(child)


@measured_again
def test_the_arm_is_stopped_followed_and_released_when_hil_is_killed(journal: Path) -> None:
    parent, driver = a_parent(journal)
    late = InTime(driver, ours=False)
    dead = killed(parent)
    wait_for(journal, "stop")
    took = late.taken()
    wait_for(journal, "close")
    noted = events(journal)
    assert noted["client_gone"] < noted["stop"] < noted["close"]
    wait_for_end(driver)
    took.require(WITHIN_S, noted["stop"] - dead)


@measured_again
def test_the_mock_is_witness_that_the_arm_rests_before_it_is_released(journal: Path) -> None:
    journal.unlink(missing_ok=True)
    code = PARENT.partition("robot = ")[0] + MOVES_THE_MOCK
    parent = subprocess.Popen([sys.executable, "-c", code, str(journal)])
    wait_for(journal, "under way", 60.0)
    late = InTime(child_of(parent.pid), ours=False)
    dead = killed(parent)
    wait_for(journal, "stop")
    took = late.taken()
    wait_for(journal, "close")
    wait_for(journal, "rest")
    noted = {line["event"]: line for line in map(json.loads, journal.read_text().splitlines())}
    order = ("client_gone", "stop", "rest", "close")
    assert sorted(order, key=lambda event: noted[event]["monotonic_s"]) == list(order)
    assert noted["stop"]["moving"]
    assert noted["rest"]["wall_s"] < 1.0
    took.require(WITHIN_S, noted["stop"]["monotonic_s"] - dead)


@measured_again
def test_an_arm_that_moves_while_hil_is_suspended_is_stopped_and_the_next_call_says_so(
    journal: Path,
) -> None:
    parent, driver = a_parent(journal)
    try:
        os.kill(parent.pid, signal.SIGSTOP)
        suspended = InTime(driver, ours=False)
        stopped = wait_for(journal, "stop") - suspended.at
        assert stopped > 1.5
        took = suspended.taken()
        os.kill(parent.pid, signal.SIGCONT)
        assert parent.wait(5) == 1
    finally:
        parent.kill()
        parent.communicate()
    wait_for_end(driver)
    took.require(2.0 + 0.5, stopped)


def test_a_driver_whose_process_is_suspended_is_named_as_such(make: Make) -> None:
    robot = make()
    set_off(robot)
    assert robot.process is not None
    os.kill(robot.process.pid, signal.SIGSTOP)
    with pytest.raises(RobotTimeout, match=rf"process {robot.process.pid} is suspended"):
        robot.read(timeout_s=0.1)
    os.kill(robot.process.pid, signal.SIGCONT)


def test_after_it_was_stopped_for_want_of_readers_a_robot_can_be_read_again(
    make: Make, monkeypatch: pytest.MonkeyPatch, journal: Path
) -> None:
    monkeypatch.setattr(subprocess_robot, "spawn", impatient)
    robot = make()
    set_off(robot)
    wait_for(journal, "stop")
    with pytest.raises(RobotConnectionError, match=r"no samples were read for 0\.\d s"):
        robot.read()
    assert not robot.read()[-1]["status"] & Status.MOVING


def test_a_robot_at_rest_need_not_be_read(
    make: Make, monkeypatch: pytest.MonkeyPatch, journal: Path
) -> None:
    monkeypatch.setattr(subprocess_robot, "spawn", impatient)
    robot = make()
    robot.read()
    time.sleep(1.0)
    assert "stop" not in events(journal)
    robot.read()


@measured_again
def test_a_driver_asked_to_terminate_stops_the_arm_first(make: Make, journal: Path) -> None:
    robot = make()
    set_off(robot)
    asked = InTime(pid_of(robot), ours=False)
    os.kill(pid_of(robot), signal.SIGTERM)
    stopped = wait_for(journal, "stop") - asked.at
    took = asked.taken()
    wait_for(journal, "close")
    assert "client_gone" not in events(journal)
    with pytest.raises(RobotConnectionError, match=r"exit code 143"):
        robot.read()
    took.require(WITHIN_S, stopped)


def test_the_terminals_signals_do_not_reach_the_driver(make: Make, journal: Path) -> None:
    robot = make()
    assert os.getsid(pid_of(robot)) != os.getsid(0)
    for number in (signal.SIGINT, signal.SIGHUP):
        os.kill(pid_of(robot), number)
    time.sleep(0.1)
    assert len(robot.read())
    assert "stop" not in events(journal)


def test_the_death_of_the_driver_is_told_by_whatever_comes_next(make: Make) -> None:
    robot = make()
    os.kill(pid_of(robot), signal.SIGKILL)
    for call in (robot.read, robot.stop, robot.start):
        with pytest.raises(RobotConnectionError, match=r"died \(signal 9: Killed\)"):
            call()
    robot.close()
    robot.connect()
    assert len(robot.read())


def test_a_crash_in_a_vendors_library_is_told_with_where_it_was(make: Make) -> None:
    robot = make(crashes="set_payload")
    with pytest.raises(RobotConnectionError, match="signal 11") as caught:
        robot.set_payload(Payload())
    assert "process_drivers.py" in caught.value.message


def test_a_driver_that_crashes_in_close_is_told(make: Make) -> None:
    robot = make(crashes="close")
    with pytest.raises(RobotConnectionError, match="signal 11"):
        robot.close()
    robot.close()


@measured_again
def test_what_the_driver_has_started_does_not_hide_its_death(make: Make) -> None:
    robot = make(spawns=True)
    os.kill(pid_of(robot), signal.SIGKILL)
    asked = InTime()
    with pytest.raises(RobotConnectionError, match="signal 9"):
        robot.read()
    asked.require(0.5)


@measured_again
def test_stop_does_not_wait_for_a_read(make: Make, journal: Path) -> None:
    robot = make(rate_hz=1.0)
    reader = threading.Thread(target=robot.read, args=(2.0,))
    reader.start()
    took = []
    for _ in range(50):
        asked = InTime(pid_of(robot))
        robot.stop()
        took.append(asked.taken())
    assert reader.is_alive()
    reader.join()
    assert "stop" in events(journal)
    for one in took:
        one.require(WITHIN_S)


def test_stop_works_from_a_signal_handler_whatever_it_interrupts(make: Make) -> None:
    robot = make()
    stops = []

    def handle(number: int, frame: FrameType | None) -> None:
        robot.stop()
        stops.append(time.monotonic())

    before = signal.signal(signal.SIGALRM, handle)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.003, 0.003)
        until = time.monotonic() + 1.0
        while time.monotonic() < until:
            robot.stop()
            robot.read()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert len(stops) > 20
    assert len(robot.read())


def test_stop_from_many_threads_at_once_is_answered_to_each(make: Make) -> None:
    robot = make()
    problems: list[Exception] = []

    def stop_often() -> None:
        try:
            for _ in range(20):
                robot.stop()
        except Exception as error:
            problems.append(error)

    threads = [threading.Thread(target=stop_often) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not problems


@measured_again
def test_a_read_that_hangs_times_out_and_stop_still_works(
    make: Make, monkeypatch: pytest.MonkeyPatch, journal: Path
) -> None:
    monkeypatch.setattr(subprocess_robot, "CLOSE_S", 0.3)
    monkeypatch.setattr(subprocess_robot, "TERMINATE_AFTER_S", 0.3)
    monkeypatch.setattr(subprocess_robot, "KILL_AFTER_S", 0.3)
    robot = make(hang=["read"])
    asked = InTime()
    with pytest.raises(RobotTimeout, match="has not answered read"):
        robot.read(0.2)
    asked.require(0.2 + READ_GRACE_S["wall"] + 0.3)
    robot.stop()
    assert "stop" in events(journal)
    asked, pid = InTime(), pid_of(robot)
    with pytest.raises(RobotTimeout, match="has not answered close"):
        robot.close()
    asked.require(3 * 0.3 + 0.5)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_rows_that_came_too_late_for_their_read_come_with_the_next(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(READ_GRACE_S, "wall", 0.1)
    robot = make(late_s=0.5)
    with pytest.raises(RobotTimeout):
        robot.read(0.1)
    time.sleep(0.5)
    ticks = np.rint(np.concatenate([robot.read(), robot.read()])["device_time"] * 100)
    assert ticks[0] <= 60
    assert (np.diff(ticks) == 1).all()


@pytest.mark.parametrize("how", [{"hold": ["read"]}, {"hang": ["stop"]}])
@measured_again
def test_a_driver_that_does_not_answer_a_stop_is_killed(
    make: Make, monkeypatch: pytest.MonkeyPatch, how: dict[str, Any]
) -> None:
    monkeypatch.setitem(READ_GRACE_S, "wall", 0.05)
    robot = make(**how)
    if "hold" in how:
        with pytest.raises(RobotTimeout):
            robot.read(0.05)
    asked = InTime()
    with pytest.raises(RobotTimeout, match="was killed"):
        robot.stop()
    asked.require(STOP_WITHIN_S + 0.3)
    wait_for_end(pid_of(robot), 1.0)


@pytest.mark.parametrize(
    "how", [{"hang": ["read"]}, {"hold": ["read"]}, {"hang": ["close"]}, {"hang": ["stop"]}]
)
def test_a_driver_that_hangs_when_hil_goes_ends_all_the_same(
    make: Make, monkeypatch: pytest.MonkeyPatch, how: dict[str, Any]
) -> None:
    monkeypatch.setattr(subprocess_robot, "spawn", impatient)
    monkeypatch.setitem(READ_GRACE_S, "wall", 0.05)
    robot = make(**how)
    if "read" in str(how):
        with pytest.raises((RobotTimeout, RobotConnectionError)):
            robot.read(0.05)
    driver = robot.process
    assert driver is not None
    # What the kernel does when hil dies.
    driver._calls.cut()
    driver._stops.close()
    wait_for_end(driver.pid, 3.0)


@pytest.mark.parametrize("repeat", range(4))
def test_a_motion_commanded_with_the_last_breath_is_stopped_too(
    make: Make, journal: Path, repeat: int
) -> None:
    robot = make()
    robot.prepare(long_way())
    driver = robot.process
    assert driver is not None
    driver._calls.send(pack({"id": 99, "call": "start"}))
    driver._calls.cut()
    driver._stops.close()
    wait_for_end(driver.pid)
    noted = events(journal)
    assert noted.get("start", 0.0) < noted["stop"] < noted["close"]


def test_garbage_on_the_line_stops_the_arm(make: Make, journal: Path) -> None:
    robot = make()
    set_off(robot)
    assert robot.process is not None
    robot.process._calls.send(b"GET / HTTP/1.1\r\n\r\n")
    wait_for(journal, "close")
    assert events(journal)["stop"]
    with pytest.raises(RobotConnectionError, match="invalid message of the driver process"):
        robot.read()


def test_garbage_from_the_driver_is_an_error_and_stop_still_works(
    make: Make, journal: Path
) -> None:
    robot = make(babbles=True)
    with pytest.raises(RobotConnectionError, match="invalid message of the driver process"):
        robot.read()
    robot.stop()
    assert "stop" in events(journal)
    with pytest.raises(RobotConnectionError, match="out of step"):
        robot.read()
    robot.close()
    assert events(journal)["close"]
