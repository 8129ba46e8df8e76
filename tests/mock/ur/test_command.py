"""The teach pendant of the mock UR controller: how its stops are released."""

from __future__ import annotations

import pytest

from hil.core.errors import CommandRefused, SpecError
from hil_mock_robot.ur.dashboard import PRESSES, pressed
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.mock import main, serial_of
from hil_mock_robot.ur.modes import RobotMode, SafetyMode
from hil_mock_robot.ur.pacing import LockStep
from hil_mock_robot.ur.side import SideService
from tests.support.mock_servers import mock_ur
from tests.support.ur_machine import Wire, machine_of
from tests.support.waiting import until

EMERGENCY_WAY = ("release_emergency_stop", "power_on", "brake_release")
FAULT_WAY = ("restart_safety", "power_on", "brake_release")


def let(machine, seconds):
    for _ in range(round(seconds / machine.tick_s)):
        machine.tick()


def press(machine, what):
    return pressed(machine, {"do": "pendant", "press": what})


def test_a_serial_number_is_digits():
    assert serial_of("2022050001") == "2022050001"
    with pytest.raises(SpecError):
        serial_of("²")


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
def test_a_stop_is_caused_and_released_from_a_shell(capsys):
    with mock_ur("--speed", "10") as mock:

        def ask(*words):
            return main(["tell", "--address", mock.address, *words])

        assert ask("fault", "emergency_stop") == 0
        assert ask("pendant", "unlock") == 4
        assert "next: press release_emergency_stop" in capsys.readouterr().err
        for what in ("release_emergency_stop", "brake_release"):
            assert ask("pendant", what) == 0
        until(lambda: mock.side("state")["robot_mode"] == "RUNNING")
        state = mock.side("state")
        assert (state["safety_mode"], state["faults"]) == ("NORMAL", [])
