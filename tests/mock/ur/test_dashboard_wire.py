"""Real clients on the mock's dashboard, primary, secondary and real-time ports."""

import contextlib
import json
import socket
import struct
import subprocess
import sys
import time

import pytest

from tests.support.mock_servers import mock_ur
from tests.support.paths import FILES
from tests.support.waiting import until

dashboard_client = pytest.importorskip(
    "dashboard_client", reason="ur-rtde has no wheel for this Python"
)
pytestmark = pytest.mark.wire

OVERFLOW_S = 60.0
"""Device time whose real-time packets, 8 MB, are more than the kernel keeps for a connection."""


@contextlib.contextmanager
def desk(where):
    client = dashboard_client.DashboardClient(where)
    client.connect(5000)
    try:
        yield client
    finally:
        client.disconnect()


def unlocked(client):
    """Whether the dashboard lets a protective stop end now."""
    with contextlib.suppress(RuntimeError):
        client.unlockProtectiveStop()
        return True
    return False


@pytest.fixture(scope="module")
def e_series():
    with mock_ur("--model", "ur5e", "--speed", "2", "--serial", "20225500042") as mock:
        yield mock.address


@pytest.fixture(scope="module")
def cb3():
    with mock_ur("--model", "ur5", "--speed", "5") as mock:
        yield mock.address


@pytest.mark.journey
def test_the_dashboard_client_learns_what_it_talks_to(e_series):
    with desk(e_series) as client:
        assert client.isConnected()
        assert client.polyscopeVersion() == "5.12.2.1101534"
        assert client.getSerialNumber() == "20225500042"
        assert client.getRobotModel() == "UR5"
        assert client.isInRemoteControl()


def test_the_dashboard_client_learns_how_things_stand(e_series):
    with desk(e_series) as client:
        assert client.robotmode() == "Robotmode: RUNNING"
        assert client.safetymode() == "Safetymode: NORMAL"
        assert client.safetystatus() == "Safetystatus: NORMAL"


@pytest.mark.parametrize("model", ["cb3", "e_series"])
def test_the_dashboard_client_loads_plays_pauses_and_stops(model, request):
    with desk(request.getfixturevalue(model)) as client:
        client.loadURP("weigh.urp")
        assert client.getLoadedProgram() == "Loaded program: /programs/weigh.urp"
        assert client.programState() == "STOPPED weigh.urp"
        assert not client.running()
        client.play()
        assert client.running()
        client.pause()
        assert client.programState() == "PAUSED weigh.urp"
        client.play()
        assert client.programState() == "PLAYING weigh.urp"
        client.stop()
        assert not client.running()


def test_the_dashboard_client_hears_of_failures(cb3):
    with desk(cb3) as client:
        with pytest.raises(RuntimeError, match="File not found: nothing"):
            client.loadURP("nothing")
        with pytest.raises(RuntimeError, match="Failed to execute: pause"):
            client.pause()


@pytest.mark.parametrize("model", ["cb3", "e_series"])
def test_the_dashboard_client_switches_the_arm_off_and_on(model, request):
    with desk(request.getfixturevalue(model)) as client:
        client.powerOff()
        assert client.robotmode() == "Robotmode: POWER_OFF"
        with pytest.raises(RuntimeError, match="Failed to execute: play"):
            client.play()
        client.powerOn()
        assert until(lambda: client.robotmode() == "Robotmode: IDLE")
        client.brakeRelease()
        assert until(lambda: client.robotmode() == "Robotmode: RUNNING")


def test_the_dashboard_client_restarts_the_safety_system(cb3):
    with desk(cb3) as client:
        client.restartSafety()
        assert until(lambda: client.robotmode() == "Robotmode: POWER_OFF")
        client.brakeRelease()
        assert until(lambda: client.robotmode() == "Robotmode: RUNNING")


def test_the_dashboard_client_unlocks_a_protective_stop(e_series):
    with desk(e_series) as client, socket.create_connection((e_series, 30002), 5) as script:
        script.sendall(b"protective_stop()\n")
        assert until(lambda: client.safetymode() == "Safetymode: PROTECTIVE_STOP")
        with pytest.raises(RuntimeError, match="Cannot unlock protective stop until 5s"):
            client.unlockProtectiveStop()
        assert until(lambda: unlocked(client))
        assert client.safetymode() == "Safetymode: NORMAL"


def test_the_dashboard_client_shows_and_notes(e_series):
    with desk(e_series) as client:
        client.popup("Put 2 kg on")
        client.closePopup()
        client.closeSafetyPopup()
        client.addToLog("weighing")
        assert client.isProgramSaved() in (True, False)
        client.send("robotmode\n")
        assert client.receive() == "Robotmode: RUNNING"


def test_quitting_hangs_up(cb3):
    client = dashboard_client.DashboardClient(cb3)
    client.connect(5000)
    client.quit()
    with desk(cb3) as again:
        assert again.robotmode() == "Robotmode: RUNNING"


def test_local_control_is_told_to_the_dashboard_client():
    with mock_ur("--model", "ur5e", "--local") as mock, desk(mock.address) as client:
        assert not client.isInRemoteControl()
        with pytest.raises(RuntimeError, match="switch robot to Remote Control mode"):
            client.play()
        client.powerOff()
        assert client.robotmode() == "Robotmode: RUNNING"


CONTROL = """
import sys
from rtde_control import RTDEControlInterface
control = RTDEControlInterface(sys.argv[1])
print(control.isProgramRunning())
control.stopScript()
"""


def control(where):
    """`ur-rtde`'s control interface in a process of its own: its constructor may hang."""
    command = [sys.executable, "-c", CONTROL, where]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_the_control_interface_asks_the_dashboard_for_remote_control(e_series):
    ran = control(e_series)
    assert ran.stdout.split() == ["True"], ran.stderr


def test_the_control_interface_is_refused_in_local_control():
    with mock_ur("--model", "ur5e", "--local") as mock:
        ran = control(mock.address)
    assert ran.returncode != 0
    assert "Please enable remote control on the robot!" in ran.stderr


@pytest.mark.parametrize("model", ["cb3", "e_series"])
def test_python_urx_connects_reads_and_moves(model, request):
    pytest.importorskip("urx", reason="python-urx is a test tool (LGPL): pip install urx")
    script = FILES / "ur_urx.py"
    command = [sys.executable, "-W", "ignore", str(script), request.getfixturevalue(model)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stderr
    seen = json.loads(ran.stdout)
    known = {"CartesianInfo", "JointData", "MasterBoardData", "RobotModeData", "ToolData"}
    assert known <= set(seen["parts"])
    assert seen["mode"] == 7
    assert seen["ran"]
    assert not seen["running"]
    assert seen["off"] < 0.002
    assert seen["rt"] == pytest.approx(seen["target"], abs=0.002)


def test_a_primary_client_hears_what_the_dashboard_does(cb3):
    with socket.create_connection((cb3, 30001), 5) as primary, desk(cb3) as client:
        client.loadURP("told.urp")
        client.play()
        client.stop()
        data, deadline = b"", time.monotonic() + 5
        while b"PROGRAM_XXX_STOPPEDtold" not in data and time.monotonic() < deadline:
            data += primary.recv(65536)
    size, kind = struct.unpack_from(">iB", data)
    assert (kind, data[15:25]) == (20, b"\tURControl"[:10])
    assert size < 100
    assert data.index(b"PROGRAM_XXX_STARTEDtold") < data.index(b"PROGRAM_XXX_STOPPEDtold")


def device_time_s(where):
    """Of the state that a secondary client is sent at once, after the 79 bytes of the greeting."""
    with socket.create_connection((where, 30002), 5) as states, states.makefile("rb") as stream:
        stream.read(79)
        head = stream.read(18)
        assert head[4] == 16
        return struct.unpack_from(">Q", head, 10)[0] / 1e6


def test_who_reads_real_time_data_too_late_gets_whole_packets_with_gaps():
    with mock_ur("--model", "ur5", "--speed", "free") as mock, socket.socket() as late:
        where = mock.address
        late.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        late.settimeout(5)
        late.connect((where, 30003))
        # Time goes on without it.
        assert until(lambda: device_time_s(where) > OVERFLOW_S, within_s=100.0, every_s=0.3)
        last, gap, data = None, 0.0, b""
        while gap < 0.1:
            data += late.recv(65536)
            assert data
            while len(data) >= 1116:
                size, now = struct.unpack_from(">id", data)
                assert size == 1116
                gap = max(gap, now - (last or now))
                assert last is None or now > last
                last, data = now, data[1116:]
            assert last is None or last < 10 * OVERFLOW_S, "nothing was dropped"
