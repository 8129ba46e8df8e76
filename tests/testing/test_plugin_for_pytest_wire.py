"""Mock controllers that are processes, as fixtures of other people's tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import can
import canopen
import pytest

from hil.core.errors import CommandRefused, RobotConnectionError, RobotTimeout
from hil.testing.mocks import CanBus, UrController, free_address, ur_controller

pytestmark = pytest.mark.wire


@pytest.mark.ur_controller("ur10e", speed=10, start_q_deg=[0, -90, 90, -90, -90, 0])
def test_a_controller_is_asked_and_made_to_stop(ur_controller: UrController) -> None:
    assert ur_controller.dashboard("robotmode") == "Robotmode: RUNNING"
    assert ur_controller.state()["q"][2] == pytest.approx(1.571, abs=0.01)
    ur_controller.fault("protective_stop")
    assert "PROTECTIVE_STOP" in ur_controller.dashboard("safetymode")
    with pytest.raises(CommandRefused):
        ur_controller.press("unlock")  # it wants five seconds
    stopped = ur_controller.state()["device_time"]
    ur_controller.wait_until(lambda now: now["device_time"] > stopped + 5)
    assert ur_controller.press("unlock")["safety_mode"] == "NORMAL"
    assert [line["kind"] for line in ur_controller.journal("fault")] == ["protective_stop"]


def test_faults_of_the_line_end_with_the_with(ur_controller: UrController) -> None:
    with ur_controller.fault("silence"):
        assert ur_controller.state()["faults"] == ["silence"]
    assert ur_controller.state()["faults"] == []
    with pytest.raises(RobotTimeout, match=r"within 0\.1 s"):
        ur_controller.wait_until(lambda now: bool(now["faults"]), within_s=0.1)


@pytest.mark.ur_controller(faults=[{"kind": "remote_off", "at_s": 0.1, "for_s": 1e9}])
def test_faults_may_be_planned(ur_controller: UrController) -> None:
    ur_controller.wait_until(lambda now: now["faults"] == ["remote_off"])


def test_two_controllers_do_not_meet(ur_controller_factory: Callable[..., UrController]) -> None:
    first, second = ur_controller_factory("ur3"), ur_controller_factory("ur5")
    assert first.host != second.host
    assert first.end() == 0
    assert second.dashboard("robotmode") == "Robotmode: RUNNING"
    with pytest.raises(RobotConnectionError):
        first.state()


def test_what_a_mock_says_against_its_options_is_told(
    ur_controller_factory: Callable[..., UrController],
) -> None:
    with pytest.raises(pytest.fail.Exception, match=r"does not start: .*--sped=3"):
        ur_controller_factory(sped=3)


DIES = """
import time
from hil.testing.mocks import ur_controller
with ur_controller() as running:
    print(running.process.pid, flush=True)
    time.sleep(60)
"""


def test_tests_that_are_killed_leave_no_mock_behind() -> None:
    with subprocess.Popen([sys.executable, "-c", DIES], stdout=subprocess.PIPE, text=True) as dies:
        assert dies.stdout is not None
        mock = int(dies.stdout.readline())
        os.kill(mock, 0)
        dies.send_signal(signal.SIGKILL)
    until = time.monotonic() + 10
    while running(mock):
        assert time.monotonic() < until, "it is still there"
        time.sleep(0.02)


def running(pid: int) -> bool:
    """Whether there is such a process, and not just what is left of it."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as stat:
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_an_address_that_is_taken_is_not_given() -> None:
    address = free_address()
    with ur_controller(address=address) as first:
        assert first.host == address
        with pytest.raises(Exception, match="does not start"), ur_controller(address=address):
            pass


@pytest.mark.can_bus(nodes=[11, 12, 13, 14, 15, 16])
def test_canopen_talks_to_the_drives(can_bus: CanBus) -> None:
    network = canopen.Network()
    network.connect(**can_bus.config)
    try:
        drive = network.add_node(12, upload_eds=True)
        drive.sdo.RESPONSE_TIMEOUT = 10.0
        assert drive.sdo["Statusword"].raw & 0x4F == 0x40
        can_bus.fault("emergency", axis=2, code=0x7305)
        can_bus.wait_until(lambda now: now["states"][1] == "FAULT")
        assert drive.sdo[0x603F].raw == 0x7305
        drive.sdo["Controlword"].raw = 0x80
        can_bus.wait_until(lambda now: now["states"][1] == "SWITCH_ON_DISABLED")
    finally:
        network.disconnect()
    assert can_bus.journal("fault")[0]["axis"] == 2


def test_any_participant_hears_the_drives(can_bus: CanBus) -> None:
    bus = can_bus.bus()
    bus.send(can.Message(arbitration_id=0, data=[0x81, 3], is_extended_id=False))
    seen = {message.arbitration_id for message in iter(lambda: bus.recv(1.0), None)}
    assert 0x703 in seen
