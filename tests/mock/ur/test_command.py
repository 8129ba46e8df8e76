"""`hil mock ur` as somebody meets it: its help, its refusals, and how its stops are released."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time

import pytest

from hil.core.errors import CommandRefused, PluginError, SpecError
from hil_mock_robot.server.options import loopback_of
from hil_mock_robot.ur.connections import listen
from hil_mock_robot.ur.dashboard import PRESSES, pressed
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.mock import TELL, main, serial_of
from hil_mock_robot.ur.modes import RobotMode, SafetyMode
from hil_mock_robot.ur.pacing import LockStep
from hil_mock_robot.ur.side import SideService
from tests.support.mock_servers import loopback, mock_ur
from tests.support.ur_machine import Wire, machine_of

EMERGENCY_WAY = ("release_emergency_stop", "power_on", "brake_release")
FAULT_WAY = ("restart_safety", "power_on", "brake_release")


def hil(*arguments, **env):
    return subprocess.run(
        [sys.executable, "-m", "hil", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, **env},
        timeout=100,
    )


def let(machine, seconds):
    for _ in range(round(seconds / machine.tick_s)):
        machine.tick()


def press(machine, what):
    return pressed(machine, {"do": "pendant", "press": what})


@pytest.mark.thorough
def test_its_help_shows_its_own_options_with_their_defaults():
    done = hil("mock", "ur", "--help", COLUMNS="60")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage: hil mock ur ")
    told = " ".join(done.stdout.split())
    for option in ("--address", "--speed", "--faults", "--side-port", "--local", "tell"):
        assert option in told
    for default in ("(default: 127.0.0.1)", "(default: ur5)", "(default: 0)", "(default: 30100)"):
        assert default in told
    assert "None" not in told
    assert "False" not in told
    assert "a second mock takes another one, such as 127.0.0.2" in told


@pytest.mark.thorough
def test_the_help_of_the_command_is_still_there():
    for asked in (("mock", "--help"), ("mock", "-h"), ("mock", "embedded", "--help")):
        done = hil(*asked)
        assert done.returncode == 0
        assert "Usage: hil mock" in done.stdout


def test_started_by_itself_it_says_how(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert capsys.readouterr().out.startswith("usage: python -m hil_mock_robot ur ")


def test_a_serial_number_is_digits(capsys):
    assert serial_of("2022050001") == "2022050001"
    assert main(["--serial", "abc"]) == 2
    said = capsys.readouterr().err
    assert "digits" in said
    assert "\n  next: " in said
    assert "→" not in said
    with pytest.raises(SpecError):
        serial_of("²")


def test_an_address_in_use_leads_to_one_that_is_free():
    port = 29000 + os.getpid() % 900
    with listen("127.0.0.2", port), pytest.raises(PluginError, match="in use") as caught:
        listen("127.0.0.2", port)
    (free,) = [word.strip(",") for word in caught.value.hint.split() if word.startswith("127.")]
    assert free != "127.0.0.2"
    listen(loopback_of(free), port).close()


@pytest.mark.parametrize(
    ("words", "request_"),
    [
        (["state"], {"do": "state"}),
        (["fault", "protective_stop"], {"do": "fault", "kind": "protective_stop"}),
        (["fault", "kind=late", "by_s=0.2"], {"do": "fault", "kind": "late", "by_s": 0.2}),
        (["pendant", "unlock"], {"do": "pendant", "press": "unlock"}),
        (["speed", "10"], {"do": "speed", "factor": 10}),
        (["push", "torque=[0, 20, 0, 0, 0, 0]"], {"do": "push", "torque": [0, 20, 0, 0, 0, 0]}),
        (["mount", "mass_kg=null"], {"do": "mount", "mass_kg": None}),
    ],
)
def test_words_of_a_shell_are_a_request(words, request_):
    assert TELL.request(words[0], words[1:]) == request_


@pytest.mark.parametrize("words", [["state", "now"], ["fault", "a", "b"], ["clear", "=1"]])
def test_words_that_are_none_are_refused(words):
    with pytest.raises(SpecError, match="no KEY=VALUE"):
        TELL.request(words[0], words[1:])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("stop", "safety", "way"),
    [
        ("emergency_stop", SafetyMode.ROBOT_EMERGENCY_STOP, EMERGENCY_WAY),
        ("emergency_stop", SafetyMode.ROBOT_EMERGENCY_STOP, EMERGENCY_WAY[::2]),
        ("fault", SafetyMode.FAULT, FAULT_WAY),
        ("fault", SafetyMode.FAULT, FAULT_WAY[::2]),
    ],
)
def test_after_stops_that_cut_the_power_buttons_bring_the_arm_back(stop, safety, way):
    machine = machine_of()
    getattr(machine, stop)()
    let(machine, 1.0)
    assert machine.modes.safety is safety
    for what in way:
        press(machine, what)
        let(machine, 2.5)
    assert (machine.modes.robot, machine.modes.safety) == (RobotMode.RUNNING, SafetyMode.NORMAL)


def test_a_protective_stop_is_unlocked_after_5_s():
    machine = machine_of()
    machine.protective_stop(158)
    let(machine, 1.0)
    with pytest.raises(CommandRefused, match="PROTECTIVE_STOP") as caught:
        press(machine, "unlock")
    assert "5 s of device time" in caught.value.hint
    let(machine, 4.5)
    assert press(machine, "unlock") == {"robot_mode": "RUNNING", "safety_mode": "NORMAL"}


def test_the_pendant_is_at_hand_in_local_control():
    machine = machine_of()
    press(machine, "local")
    assert not machine.modes.remote
    press(machine, "power_off")
    let(machine, 1.0)
    for what in ("power_on", "brake_release"):
        press(machine, what)
        let(machine, 2.0)
    press(machine, "remote")
    assert machine.modes.remote
    assert machine.modes.robot is RobotMode.RUNNING


@pytest.mark.parametrize("asked", [{}, {"press": "hard"}, {"press": ["unlock"]}])
def test_buttons_that_are_not_there_are_refused_with_those_that_are(asked):
    with pytest.raises(SpecError) as caught:
        pressed(machine_of(), asked)
    assert all(what in caught.value.hint for what in PRESSES)


def test_nothing_can_be_pressed_while_the_controller_boots():
    machine = machine_of()
    faults = UrFaults(machine)
    wire = Wire()
    session = SideService(1, machine, faults, LockStep()).accept(wire)
    session.received(b'{"do": "fault", "kind": "reboot"}\n{"do": "pendant", "press": "stop"}\n')
    assert b"booting" in bytes(wire.sent)


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_a_stop_is_caused_and_released_from_a_shell():
    with mock_ur("--speed", "10") as mock:

        def ask(*words):
            return hil("mock", "ur", "tell", "--address", mock.address, *words)

        assert json.loads(ask("fault", "emergency_stop").stdout) == {"fault": "emergency_stop"}
        early = ask("pendant", "unlock")
        assert early.returncode == 4
        assert "next: press release_emergency_stop" in early.stderr
        for what in ("release_emergency_stop", "brake_release"):
            done = ask("pendant", what)
            assert done.returncode == 0, done.stderr
        until = time.monotonic() + 30
        while (state := mock.side("state"))["robot_mode"] != "RUNNING":
            assert time.monotonic() < until, state
        assert (state["safety_mode"], state["faults"]) == ("NORMAL", [])
        assert TELL.ask((mock.address, 30100), {"do": "state"})["safety_mode"] == "NORMAL"


@pytest.mark.thorough
def test_where_no_mock_runs_that_is_said():
    done = hil("mock", "ur", "tell", "--address", loopback(), "state")
    assert done.returncode == 4
    assert "no mock UR controller answers" in done.stderr
    assert "next: start one: hil mock ur" in done.stderr
