"""The process that moves a UR arm: what it commands, and what becomes of the arm when it breaks."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from hil.core.errors import (
    CommandRefused,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
)
from hil.robot import Segment, Status
from hil_drivers.ur import motion
from hil_drivers.ur.motion import MotionProcess
from tests.support.in_time import InTime, measured_again
from tests.support.mock_servers import loopback
from tests.support.waiting import until

pytestmark = pytest.mark.wire


class Desk:
    """Listens where a controller takes programs, and keeps what it was sent."""

    def __init__(self, address, ports=(30003, 29999)):
        self.said = dict.fromkeys(ports, b"")
        self._open = True
        self._lines = [socket.create_server((address, port)) for port in ports]
        for line, port in zip(self._lines, ports, strict=True):
            threading.Thread(target=self._serve, args=(line, port), daemon=True).start()

    def _serve(self, line, port):
        with contextlib.suppress(OSError):
            while True:
                client, _ = line.accept()
                with client:
                    if port == 29999:
                        client.sendall(b"Connected: Universal Robots Dashboard Server\n")
                    while got := client.recv(4096):
                        self.said[port] += got
                        if port == 29999:
                            client.sendall(b"Stopped\n")

    def wait(self, port, text):
        return until(lambda: text in self.said[port])

    def close(self):
        for line in self._lines:
            with contextlib.suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)
            line.close()


@pytest.fixture
def fake(monkeypatch, tmp_path):
    """Makes a motion process on a fake controller; gives it and what was commanded."""
    made = []
    log = tmp_path / "commands"
    log.touch()
    address = loopback()
    desk = Desk(address)

    def make(how="", **options):
        log.write_text("")  # a measurement may be made again
        monkeypatch.setenv("UR_FAKE", how)
        monkeypatch.setenv("UR_FAKE_LOG", str(log))
        given = {
            "address": address,
            "library": "tests.support.ur_fake",
            "receiver": "tests.support.ur_fake:Receiver",
        }
        made.append(MotionProcess("arm", "ur5", given | options))
        return made[-1]

    make.commands = lambda: [line.split(" ", 1)[1] for line in log.read_text().splitlines()]
    make.desk, make.address = desk, address
    yield make
    for each in made:
        each.close()
    desk.close()


def move(way=0.2, index=3):
    q = np.linspace(np.zeros(6), np.array([0, 0, 0, 0, 0, way]), 20)
    return Segment(index, "move", q, np.zeros_like(q), np.zeros_like(q), 0.5, 2.0)


def led(way=0.2, rows=80, index=4):
    s = (1 - np.cos(np.linspace(0, np.pi, rows))) / 2
    q = np.outer(s, [0, 0, 0, 0, 0, way])
    return Segment(index, "trajectory", q, np.zeros_like(q), np.zeros_like(q), 0.5, 2.0)


def wait_until_over(process):
    until(lambda: not process.look()[0]["status"] & Status.MOVING, every_s=0.01)


def wait_until_said(fake, command):
    until(lambda: any(line.startswith(command) for line in fake.commands()))


def move_to_the_end(process, segment):
    begin(process, segment)
    wait_until_over(process)


def begin(process, segment):
    process.prepare(segment)
    return process.start()


def test_it_uploads_the_program_with_the_watchdog_armed(fake):
    process = fake("")
    process.connect()
    assert fake.commands()[:2] == [f"connect {fake.address} 125 65", "watchdog 2"]


def test_a_move_is_an_asynchronous_move_of_the_controller_with_the_watchdog_kicked(fake):
    process = fake()
    process.connect()
    begun = begin(process, move())
    wait_until_over(process)
    said = fake.commands()
    at = said.index("moveJ 0.2000 0.500 2.000 True")
    assert said[at:].count("kick") >= 3
    assert process.look()[0]["device_time"] - begun == pytest.approx(0.4, abs=0.3)


@measured_again
def test_a_trajectory_is_led_along_set_point_by_set_point_and_let_go_at_its_end(fake):
    process = fake()
    process.connect()
    leading = InTime(process.pid, ours=False)
    begin(process, led(rows=80))
    wait_until_over(process)
    took = leading.taken()
    said = fake.commands()
    places = [float(line.split()[1]) for line in said if line.startswith("servoJ")]
    assert len(places) >= 60
    assert places == sorted(places)
    fastest = 0.2 / 80 * np.pi / 2  # per set-point; one that comes late is farther away
    took.require(2 * 0.008, 0.008 * max(np.diff([0.0, *places])) / fastest)
    assert said[-1] in ("servoStop", "kick")
    assert "servoStop" in said
    assert all(line.endswith(" 0.0080") for line in said if line.startswith("servoJ"))


def test_moves_may_be_led_too(fake):
    process = fake(moves="servoj")
    process.connect()
    begin(process, move())
    wait_until_over(process)
    assert not any(line.startswith("moveJ") for line in fake.commands())


@measured_again
def test_a_stop_ends_a_move_and_the_next_one_starts_again(fake):
    process = fake()
    process.connect()
    begin(process, move(1.0))
    time.sleep(0.2)
    asked = InTime(process.pid)
    process.stop()
    asked.require(0.1)
    wait_until_over(process)
    assert "stopJ" in fake.commands()
    process.prepare(move(1.0))
    process.start()
    wait_until_over(process)
    assert "reupload" not in fake.commands()


def test_a_stop_ends_leading_and_nothing_is_commanded_after_it(fake):
    process = fake()
    process.connect()
    begin(process, led(rows=500))
    wait_until_said(fake, "servoJ")
    process.stop()
    wait_until_over(process)
    said = fake.commands()
    assert not any(line.startswith("servoJ") for line in said[said.index("servoStop") :])


def test_what_was_stopped_before_it_was_started_does_not_start(fake):
    process = fake()
    process.connect()
    process.prepare(move())
    process.stop()
    with pytest.raises(CommandRefused, match="stopped before"):
        process.start()
    assert not any(line.startswith("moveJ") for line in fake.commands())


def test_false_is_an_error_that_says_which_command(fake):
    process = fake("refuse_move")
    process.connect()
    process.prepare(move())
    with pytest.raises(CommandRefused, match="not accepted moveJ"):
        process.start()


def test_a_refused_set_point_ends_the_motion_and_is_told(fake):
    process = fake("refuse_servo")
    process.connect()
    with pytest.raises(HilError, match="servoJ"):
        move_to_the_end(process, led())
    assert fake.desk.wait(30003, b"stopj")


def test_an_arm_that_does_not_follow_is_stopped(fake):
    process = fake("no_follow", lag_s=0.1, lag_rad=0.02)
    process.connect()
    begin(process, led(0.5))
    with pytest.raises(RobotFault, match=r"joint 6 is \d\.\d+ rad off the path"):
        wait_until_over(process)
    assert "servoStop" in fake.commands()


def test_a_program_that_ends_during_a_move_is_a_fault(fake):
    process = fake("program_ends")
    process.connect()
    with pytest.raises(HilError, match="robot program ended"):
        move_to_the_end(process, move())


def test_a_constructor_that_crashes_is_a_lost_connection(fake):
    process = fake("crash_connect")
    with pytest.raises(RobotConnectionError, match="signal 6"):
        process.connect()


def test_a_constructor_that_holds_the_interpreter_is_given_up(fake, monkeypatch):
    monkeypatch.setattr(motion, "CONNECT_S", 1.0)
    process = fake("hold_gil")
    asked = time.monotonic()
    with pytest.raises(RobotTimeout, match="connect"):
        process.connect()
    assert time.monotonic() - asked < 50.0  # it would hold it for a minute
    assert not process.alive


def test_inputs_that_somebody_else_owns_are_waited_for(fake):
    process = fake("in_use")
    process.connect()
    assert sum(line.startswith("connect") for line in fake.commands()) == 3


def test_local_control_is_told_in_words(fake):
    with pytest.raises(RobotConnectionError, match="remote control") as caught:
        fake("local").connect()
    assert "remote control" in caught.value.hint


@measured_again
def test_a_crash_in_a_move_is_a_lost_connection_and_connecting_again_works(fake, monkeypatch):
    process = fake("crash_move")
    process.connect()
    process.prepare(move())
    with pytest.raises(RobotConnectionError, match="signal 6"):
        process.start()
    asked = InTime()
    with pytest.raises(RobotConnectionError):
        process.stop()
    asked.require(0.1)
    monkeypatch.setenv("UR_FAKE", "")
    process.connect()
    begin(process, move())
    wait_until_over(process)


@measured_again
def test_a_call_that_hangs_does_not_answer_a_stop_in_time(fake):
    """Whoever asks has another way to stop the arm, and time left for it."""
    process = fake("hang_move")
    process.connect()
    process.prepare(move())
    threading.Thread(target=_quietly(process.start), daemon=True).start()
    wait_until_said(fake, "moveJ")
    asked = InTime(process.pid)
    with pytest.raises(RobotTimeout):
        process.stop()
    asked.require(0.08)


def _quietly(call):
    def called():
        with contextlib.suppress(Exception):
            call()

    return called


def test_a_stop_that_does_not_work_is_made_again_directly(fake):
    """Nothing tells that a move obeys but the arm: the answer comes in any case."""
    process = fake("deaf_stop")
    process.connect()
    begin(process, move(2.0))
    time.sleep(0.1)
    with pytest.raises(RobotTimeout):
        process.stop()
    assert fake.desk.wait(30003, b"stopj(8.000)")


@measured_again
def test_a_stop_that_hangs_is_not_said_to_be_made_and_is_made_again_directly(fake):
    process = fake("hang_stop")
    process.connect()
    begin(process, move(2.0))
    time.sleep(0.1)
    asked = InTime(process.pid)
    with pytest.raises(RobotTimeout):
        process.stop()
    asked.require(0.1)
    assert fake.desk.wait(30003, b"stopj(8.000)")


def test_a_refused_end_of_leading_is_made_directly(fake):
    process = fake("refuse_stop")
    process.connect()
    begin(process, led(2.0, rows=500))
    wait_until_said(fake, "servoJ")
    with contextlib.suppress(RobotConnectionError):
        process.stop()
    assert fake.desk.wait(30003, b"stopj(8.000)")


@pytest.mark.parametrize(("how", "segment"), [("throw_kick", move(2.0)), ("throw_servo", led())])
def test_whatever_the_library_throws_ends_the_motion_and_is_told(fake, how, segment):
    process = fake(how)
    process.connect()
    with pytest.raises(HilError, match="ur-rtde"):
        move_to_the_end(process, segment)
    assert fake.desk.wait(30003, b"stopj")


def test_a_stop_that_throws_is_made_directly(fake):
    process = fake("throw_stop")
    process.connect()
    begin(process, move(2.0))
    time.sleep(0.1)
    with contextlib.suppress(HilError):  # the process dies, or a busy computer is late
        process.stop()
    assert fake.desk.wait(30003, b"stopj(8.000)")


def test_a_process_that_had_to_stop_the_arm_directly_ends_and_connecting_again_works(
    fake, monkeypatch
):
    process = fake("deaf_stop")
    process.connect()
    begin(process, move(1.0))
    time.sleep(0.1)
    with pytest.raises(RobotTimeout):
        process.stop()
    with pytest.raises(RobotConnectionError, match="not reach standstill"):
        wait_until_over(process)
    monkeypatch.setenv("UR_FAKE", "")
    process.connect()
    begin(process, move())
    wait_until_over(process)


@pytest.mark.parametrize("how", ["blink_move", "pause_move"])
def test_a_program_that_does_not_play_for_one_tick_ends_the_session(fake, how):
    """`ur-rtde` may have connected again by itself: what it commands then is not ours."""
    process = fake(how)
    process.connect()
    with pytest.raises(HilError, match=r"robot program ended|its program does not run"):
        move_to_the_end(process, move(2.0))
    until(lambda: not process.alive)
    assert fake.desk.wait(30003, b"stopj")
    assert how == "blink_move" or fake.desk.wait(29999, b"stop\n")


def test_rows_from_before_the_upload_that_are_late_end_nothing(fake):
    """`ur-rtde` holds the interpreter while it uploads: what came meanwhile is heard later."""
    process = fake("late_rows")
    process.connect()
    move_to_the_end(process, move())
    assert fake.desk.said[30003] == b""


def test_a_program_that_is_held_paused_is_ended_with_the_process(fake):
    """It would go on with its old move as soon as a protective stop is unlocked."""
    process = fake("pause_at_end")
    process.connect()
    begin(process, move(2.0))
    process.close()
    assert fake.desk.wait(29999, b"stop\n")


def test_a_watchdog_that_cannot_be_armed_leaves_no_program_behind(fake):
    process = fake("refuse_watchdog")
    with pytest.raises(CommandRefused, match="setWatchdog"):
        process.connect()
    assert fake.commands()[-2:] == ["stopScript", "disconnect"]


def test_a_move_without_speed_is_refused(fake):
    process = fake()
    process.connect()
    slow = move()
    process.prepare(dataclasses.replace(slow, speed=0.0))
    with pytest.raises(CommandRefused, match="zero speed"):
        process.start()


def test_silence_during_a_move_stops_it_directly_and_then_ends_the_process(fake):
    process = fake("silence_move")
    process.connect()
    with pytest.raises(StaleState, match="has sent nothing") as caught:
        move_to_the_end(process, move(2.0))
    assert "network" in caught.value.hint
    assert fake.desk.wait(30003, b"stopj")
    assert not process.alive


def test_a_clock_that_stands_still_gets_no_set_point_more_and_then_a_stop(fake):
    process = fake("freeze_servo")
    process.connect()
    with pytest.raises(StaleState, match="has sent nothing"):
        move_to_the_end(process, led(2.0))
    assert fake.desk.wait(30003, b"stopj")
    # The first freezes the controller from its next state on, which is answered by one more.
    assert sum(line.startswith("servoJ") for line in fake.commands()) <= 2


def test_a_computer_that_holds_its_breath_does_not_make_the_controller_silent(fake):
    process = fake()
    process.connect()
    begin(process, move(1.0))
    for _ in range(3):
        time.sleep(0.2)
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(0.25)
        os.kill(process.pid, signal.SIGCONT)
    wait_until_over(process)
    assert fake.desk.said[30003] == b""


def test_a_cut_connection_during_a_move_stops_it_directly_and_ends_the_process(fake):
    process = fake("cut_move")
    process.connect()
    with pytest.raises(RobotConnectionError, match="hung up"):
        move_to_the_end(process, move(2.0))
    assert fake.desk.wait(30003, b"stopj")


def test_an_arm_is_stopped_and_released_when_its_parent_is_killed(fake, tmp_path):
    code = (
        "import time\n"
        "from tests.drivers.ur.test_motion import MotionProcess, begin, move\n"
        f"p = MotionProcess('arm', 'ur5', dict(address={fake.address!r}, "
        "library='tests.support.ur_fake', receiver='tests.support.ur_fake:Receiver'))\n"
        "p.connect(); begin(p, move(3.0)); print('moving', flush=True); time.sleep(60)\n"
    )
    fake()  # sets the environment
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout.readline().strip() == "moving"
    time.sleep(0.2)
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    until(lambda: "disconnect" in fake.commands(), every_s=0.02)
    said = [line for line in fake.commands() if line != "kick"]
    assert said[-3:] == ["stopJ", "stopScript", "disconnect"]


def test_closing_stops_the_arm_ends_the_program_and_lets_go(fake):
    process = fake()
    process.connect()
    begin(process, move(3.0))
    process.close()
    said = [line for line in fake.commands() if line != "kick"]
    assert said[-3:] == ["stopJ", "stopScript", "disconnect"]
    process.close()
