"""The mock UR controller as a process: side channel, lock-step, faults and journal over sockets."""

import contextlib
import struct
import subprocess
import sys
import time

import numpy as np
import pytest
import rtde_control

from hil.core.errors import CommandRefused
from hil_mock_robot.ur.mock import TELL
from tests.support.mock_servers import SIDE_PORT, mock_ur
from tests.support.ur_raw import Raw
from tests.support.waiting import until

pytestmark = pytest.mark.wire

STATE = ["timestamp", "actual_q", "actual_qd", "actual_current", "joint_temperatures"]
BENT = ("0", "-90", "30", "-90", "0", "0")
LEANING = ("0", "-45", "45", "-90", "0", "0")
HIL_STOP = b"def hil_stop():\n  stopj(4.000)\nend\n"


@contextlib.contextmanager
def started(where, names=STATE, rate_hz=125.0):
    with Raw(where) as raw:
        assert raw.negotiate()
        assert raw.outputs(names, rate_hz)[0] == 1
        assert raw.start()
        yield raw


@contextlib.contextmanager
def controlled(where):
    control = rtde_control.RTDEControlInterface(where)
    try:
        yield control
    finally:
        control.disconnect()


def read_on(raw):
    while True:
        raw.read()


def events(mock, *kinds):
    return [line for line in mock.journal() if not kinds or line["event"] in kinds]


# The side channel


def test_the_side_channel_tells_the_truth_and_answers_mistakes_in_words():
    with mock_ur("--start-q-deg", *BENT) as mock:
        state = mock.side("state")
        assert np.degrees(state["q"]) == pytest.approx([0, -90, 30, -90, 0, 0], abs=0.05)
        assert (state["robot_mode"], state["safety_mode"]) == ("RUNNING", "NORMAL")
        for request in ({"do": "speed", "factor": 0}, {"do": "step"}):
            with pytest.raises(CommandRefused) as refused:
                TELL.ask((mock.address, SIDE_PORT), request)
            assert refused.value.hint


def test_what_hangs_at_the_flange_and_what_pushes_it_change_the_currents():
    with mock_ur("--start-q-deg", *LEANING, "--speed", "lock-step") as mock:
        with started(mock.address) as raw:

            def shoulder():
                mock.step(60)
                return np.mean([raw.read()["actual_current"][1] for _ in range(60)][30:])

            empty = shoulder()
            mock.side("mount", mass_kg=3.0, com_m=[0.0, 0.0, 0.05])
            loaded = shoulder()
            mock.side("mount", mass_kg=None)
            mock.side("push", torque=[0, -20, 0, 0, 0, 0])
            pushed = shoulder()
        assert abs(loaded - empty) > 0.2
        assert abs(pushed - empty) > 0.2


def test_the_speed_of_time_can_be_changed():
    with mock_ur("--speed", "0.1") as mock:
        before, began = mock.side("state")["device_time"], time.monotonic()
        time.sleep(0.5)
        took = time.monotonic() - began
        assert mock.side("state")["device_time"] - before < 0.3 * took
        mock.side("speed", factor=10)
        before, began = mock.side("state")["device_time"], time.monotonic()
        time.sleep(0.5)
        took = time.monotonic() - began
        assert mock.side("state")["device_time"] - before > 1.5 * took


# Lock-step


def told(mock, seed_bytes):
    """The RTDE bytes of 200 ticks in which somebody sends set-points at fixed ticks."""
    received = b""
    with started(mock.address, [*STATE, "input_double_register_3"]) as raw:
        assert raw.inputs(["input_double_register_3"])[0] == 1
        for k in range(20):
            raw.write(1, "d", k * seed_bytes)
            if k == 8:
                mock.side("fault", kind="jitter", by_s=0.05, for_s=0.4)
            if k == 12:
                mock.side("push", torque=[5.0, 0, 0, 0, 0, 0])
            mock.step(10)
        for _ in range(200):
            head = raw._exactly(3)
            received += head + raw._exactly(struct.unpack(">HB", head)[0] - 3)
    return received


def test_the_same_seed_steps_and_packages_give_the_same_bytes_whatever_else_the_computer_does():
    options = ("--speed", "lock-step", "--seed", "5")
    runs = []
    for busy in (False, True):
        with mock_ur(*options) as mock:
            load = subprocess.Popen([sys.executable, "-c", "while True: pass"]) if busy else None
            try:
                runs.append(told(mock, 0.5))
            finally:
                if load is not None:
                    load.kill()
                    load.wait()
    assert runs[0] == runs[1]
    with mock_ur("--speed", "lock-step", "--seed", "6") as mock:
        assert told(mock, 0.5) != runs[0]


def test_without_a_permit_no_time_passes():
    with mock_ur("--speed", "lock-step") as mock:
        time.sleep(0.3)
        assert mock.side("state")["ticks"] == 0
        assert mock.side("step", ticks=25)["device_time"] == pytest.approx(0.2)
        assert mock.side("state")["ticks"] == 25


def test_permits_of_a_tester_that_hangs_up_are_void():
    with mock_ur("--speed", "lock-step") as mock:
        other = mock.connect(30100)
        other.sendall(b'{"do": "step", "ticks": 10000000}\n')
        until(lambda: mock.side("state")["ticks"] > 0)
        other.close()
        before = until(lambda: _still(mock))
        mock.step(5)
        assert mock.side("state")["ticks"] == before + 5


def _still(mock):
    before = mock.side("state")["ticks"]
    time.sleep(0.1)
    return before if mock.side("state")["ticks"] == before else 0


# Faults over sockets


def test_cut_connections_can_be_made_again():
    with mock_ur() as mock, started(mock.address) as raw:
        raw.read()
        mock.side("fault", kind="cut")
        with pytest.raises(ConnectionError):
            read_on(raw)
        with started(mock.address) as again:
            assert again.read()["timestamp"] > 0


def test_silence_is_silence_and_ends():
    with mock_ur("--speed", "lock-step") as mock, started(mock.address) as raw:
        mock.side("fault", kind="silence", for_s=0.4)
        mock.step(60)
        stamps = [raw.read()["timestamp"] for _ in range(10)]
        assert stamps == pytest.approx(0.008 * np.arange(51, 61))


RECEIVING = """
import sys, time, rtde_receive
receive = rtde_receive.RTDEReceiveInterface(sys.argv[1])
print("there", flush=True)
sys.stdin.readline()
receive.disconnect()
"""


@pytest.mark.parametrize("kind", ["garbage", "wrong_length"])
def test_spoilt_packages_end_ur_rtde_or_leave_it_alive_but_never_hang_it_or_the_mock(kind):
    """Garbage aborts the whole process of ur-rtde 1.6.5: a reason to give it one of its own."""
    with mock_ur() as mock:
        command = [sys.executable, "-c", RECEIVING, mock.address]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        receiving = subprocess.Popen(command, text=True, **pipes)
        assert receiving.stdout.readline() == "there\n"
        mock.side("fault", kind=kind, packages=3)
        time.sleep(0.5)
        receiving.communicate("\n", timeout=20)
        with started(mock.address) as raw:
            raw.read()


def test_an_unplugged_cable_keeps_everybody_waiting_but_the_tester():
    with mock_ur() as mock, started(mock.address) as raw, mock.connect(29999) as dashboard:
        assert dashboard.recv(100).startswith(b"Connected")
        mock.side("fault", kind="unplugged", for_s=1.0)
        began = time.monotonic()
        dashboard.sendall(b"robotmode\n")
        assert dashboard.recv(100).startswith(b"Robotmode")
        assert time.monotonic() - began > 0.8
        stamps = np.array([raw.read()["timestamp"] for _ in range(150)])
        assert np.diff(stamps) == pytest.approx(0.008), "a cable loses nothing that TCP repeats"


def test_a_hanging_dashboard_leaves_rtde_alone():
    with mock_ur() as mock, started(mock.address) as raw, mock.connect(29999) as dashboard:
        dashboard.recv(100)
        mock.side("fault", kind="dashboard_hang", for_s=30)
        dashboard.sendall(b"robotmode\n")
        dashboard.settimeout(0.5)
        with pytest.raises(TimeoutError):
            dashboard.recv(100)
        raw.read()
        mock.side("clear")
        dashboard.settimeout(5.0)
        assert dashboard.recv(100).startswith(b"Robotmode")


def test_inputs_of_somebody_else_keep_ur_rtde_out():
    with mock_ur() as mock:
        mock.side("fault", kind="inputs_owned")
        with pytest.raises(RuntimeError, match="already in use"):
            rtde_control.RTDEControlInterface(mock.address)
        mock.side("clear")
        with controlled(mock.address) as control:
            assert control.isProgramRunning()


def test_local_control_keeps_ur_rtde_out_of_an_e_series():
    with mock_ur("--model", "ur5e") as mock:
        mock.side("fault", kind="remote_off")
        with pytest.raises(RuntimeError, match="remote control"):
            rtde_control.RTDEControlInterface(mock.address)


def test_a_refused_payload_is_accepted_in_words_but_not_read_back():
    with mock_ur() as mock, controlled(mock.address) as control:
        mock.side("fault", kind="payload_refused")
        assert control.setPayload(1.2, [0.0, 0.0, 0.05])
        assert mock.side("state")["declared_kg"] == 0.0
        mock.side("clear")
        assert control.setPayload(1.2, [0.0, 0.0, 0.05])
        assert mock.side("state")["declared_kg"] == pytest.approx(1.2)


def test_a_rebooting_controller_refuses_connections_and_begins_at_0():
    with mock_ur() as mock, started(mock.address) as raw:
        until(lambda: raw.read()["timestamp"] > 1.0)
        mock.side("fault", kind="reboot", for_s=1.0, powered=True)
        with pytest.raises(ConnectionError):
            read_on(raw)
        with pytest.raises(ConnectionRefusedError):
            mock.connect(30004)
        line = until(lambda: _connected(mock))
        line.close()
        with started(mock.address) as again:
            assert again.read()["timestamp"] < 1.0
        with controlled(mock.address) as control:
            q = mock.side("state")["q"]
            assert control.moveJ([q[0] + 0.1, *q[1:]], 1.0, 2.0)


def _connected(mock):
    try:
        return mock.connect(30004)
    except ConnectionRefusedError:
        return None


def test_a_file_of_faults_strikes_at_its_time_and_in_its_motion(tmp_path):
    plan = tmp_path / "faults.yaml"
    plan.write_text("- {kind: protective_stop, motion: 2, after_s: 0.2, code: 153}\n")
    journal = tmp_path / "journal.jsonl"
    with mock_ur("--faults", str(plan), journal=journal) as mock:
        with controlled(mock.address) as control:
            q = mock.side("state")["q"]
            assert control.moveJ([q[0] + 0.3, *q[1:]], 1.0, 2.0)
            assert not control.moveJ(q, 1.0, 2.0)
        assert mock.side("state")["stop_code"] == 153
        fault, stopped, rest = (events(mock, kind) for kind in ("fault", "protective_stop", "rest"))
    assert [line["kind"] for line in fault] == ["protective_stop"]
    assert stopped[0]["code"] == 153
    assert rest[0]["after"] == "protective_stop"
    assert 0 < rest[0]["device_s"] < 0.5
    assert fault[0]["speed_rad_s"] > 0.1


# The journal


def test_the_journal_holds_every_command_that_moves_or_stops(tmp_path):
    with mock_ur(journal=tmp_path / "journal.jsonl") as mock:
        with controlled(mock.address) as control:
            q = mock.side("state")["q"]
            assert control.moveJ([q[0] + 0.1, *q[1:]], 1.0, 2.0)
            for _ in range(5):
                assert control.servoJ(q, 0.0, 0.0, 0.008, 0.1, 300)
                time.sleep(0.05)
            control.servoStop(4.0)
            control.stopScript()
        lines = events(mock, "start", "stop")
        said = [(line["event"], line["by"]) for line in lines]
    assert said == [
        ("start", "movej"),
        ("start", "servoj"),
        ("stop", "servo_stop"),
        ("stop", "stop_script"),
    ]


def test_set_points_after_a_stop_from_elsewhere_are_a_new_start(tmp_path):
    with mock_ur(journal=tmp_path / "journal.jsonl") as mock:
        with controlled(mock.address) as control, mock.connect(30003) as script:
            q = mock.side("state")["q"]
            assert control.servoJ(q, 0.0, 0.0, 0.008, 0.1, 300)
            script.sendall(HIL_STOP)
            until(lambda: events(mock, "program_stopped"))
            control.servoJ(q, 0.0, 0.0, 0.008, 0.1, 300)
            with mock.connect(29999) as dashboard:
                dashboard.sendall(b"stop\n")
                until(lambda: len(events(mock, "stop")) == 2)
        said = [(n["event"], n["by"], n["via"]) for n in events(mock, "start", "stop")]
    assert said[:2] == [("start", "servoj", "rtde"), ("stop", "hil_stop", "script")]
    assert ("stop", "stop", "dashboard") in said[2:]  # ur-rtde may command once more after it


def test_clients_come_and_go_in_the_journal(tmp_path):
    with mock_ur(journal=tmp_path / "journal.jsonl") as mock:
        with started(mock.address) as raw:
            raw.read()
        until(lambda: any(n["port"] == 30004 for n in events(mock, "disconnect")))
    (came,) = [n for n in events(mock, "connect") if n["port"] == 30004]
    assert came["peer"].startswith("127.")
    assert came["device_time"] >= 0
    assert mock.journal()[-1]["event"] == "closed"


def test_a_watchdog_that_nobody_feeds_stops_the_arm(tmp_path):
    with mock_ur(journal=tmp_path / "journal.jsonl") as mock:
        with controlled(mock.address) as control:
            assert control.setWatchdog(5.0)
            assert control.speedJ([0.5, 0, 0, 0, 0, 0], 2.0, 0.0)
            until(lambda: events(mock, "rest"))
        watchdog, rest = events(mock, "watchdog", "rest")
    assert watchdog["speed_rad_s"] > 0.1
    assert rest["after"] == "watchdog"


# The process
