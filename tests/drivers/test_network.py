"""`hil mock ur &` and at once a run: a mock that is still starting is waited for, nobody else."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time

import pytest

from hil.core.errors import RobotConnectionError
from hil_drivers import network
from hil_drivers.network import once_listening
from hil_drivers.ur.dashboard import Dashboard
from hil_drivers.ur.robot import UrRobot
from tests.support.in_time import InTime, measured_again
from tests.support.mock_servers import loopback


def refusing(tries):
    """Refuses as often as is said, then connects."""
    left = iter(range(tries))

    def connect():
        if next(left, None) is None:
            return "connected"
        raise RobotConnectionError("refused") from ConnectionRefusedError(111, "refused")

    return connect


def test_a_port_of_this_computer_that_is_about_to_open_is_waited_for():
    assert once_listening("127.0.0.1", refusing(3)) == "connected"


def test_a_controller_that_refuses_is_not_asked_again():
    with pytest.raises(RobotConnectionError):
        once_listening("192.0.2.5", refusing(1))


@measured_again
def test_a_mock_that_starts_is_waited_for_as_long_as_asked_and_no_longer():
    asked = InTime()
    with pytest.raises(RobotConnectionError):
        once_listening("127.0.0.1", refusing(1000), within_s=0.3)
    assert time.monotonic() - asked.at >= 0.3
    asked.require(3.0)


def test_other_problems_than_refusals_are_told_at_once():
    asked = []

    def hung_up():
        asked.append(1)
        raise RobotConnectionError("has hung up")

    with pytest.raises(RobotConnectionError, match="hung up"):
        once_listening("127.0.0.1", hung_up)
    assert len(asked) == 1


def test_a_dashboard_that_opens_late_is_reached():
    address = loopback()
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)

    def serve():
        time.sleep(0.4)
        server.bind((address, 29999))
        server.listen()
        line, _ = server.accept()
        line.sendall(b"Connected: Universal Robots Dashboard Server\n")
        line.close()

    with server:
        thread = threading.Thread(target=serve)
        thread.start()
        with once_listening(address, lambda: Dashboard(address)):
            thread.join()


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_a_mock_started_a_moment_ago_is_connected_to(monkeypatch):
    monkeypatch.setattr(network, "STARTING_S", 60.0)  # however busy this machine is
    address = loopback()
    command = [sys.executable, "-m", "hil_mock_robot", "ur", "--address", address]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as mock:
        robot = UrRobot("arm", "ur5", address=address, late_s=2.0, lag_s=1.0, watchdog_hz=0.5)
        try:
            robot.connect()
            assert robot.identity.model == "ur5"
            assert robot.limits.qd_max.shape == (6,)
        finally:
            robot.close()
            mock.terminate()
