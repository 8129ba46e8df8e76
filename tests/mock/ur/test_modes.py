"""Power and safety of the mock UR controller: modes, and the teach pendant that releases stops."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import CommandRefused, SpecError
from hil_mock_robot.ur.dashboard import PRESSES, IdleProgram, pressed
from hil_mock_robot.ur.faults import UrFaults
from hil_mock_robot.ur.mock import main, serial_of
from hil_mock_robot.ur.modes import (
    TRANSITIONS,
    UNLOCK_AFTER_S,
    Modes,
    RobotMode,
    RuntimeState,
    SafetyMode,
)
from hil_mock_robot.ur.motion import Setpoint
from hil_mock_robot.ur.pacing import LockStep
from hil_mock_robot.ur.side import SideService
from tests.support.mock_servers import mock_ur
from tests.support.ur_machine import Wire, machine_of, pass_time
from tests.support.waiting import until

TICK_S = 0.008


def modes_seen(modes, seconds):
    """Robot modes of the next seconds, in order."""
    seen = [modes.robot]
    for _ in range(round(seconds / TICK_S)):
        modes.tick()
        if modes.robot is not seen[-1]:
            seen.append(modes.robot)
    return [mode.name for mode in seen]


class Turning:
    """The base turns at a constant speed for ever."""

    def advance(self, now: Setpoint, scale: float) -> Setpoint | None:
        speed = np.zeros(6)
        speed[0] = 1.0
        return np.stack((now[0] + speed * TICK_S, speed, np.zeros(6)))


def test_switching_on_goes_through_booting_to_idle():
    modes = Modes(TICK_S, powered=False)
    assert modes.power_on()
    assert modes_seen(modes, 3) == ["BOOTING", "POWER_ON", "IDLE"]
    assert not modes.running


def test_released_brakes_make_it_run():
    modes = Modes(TICK_S, powered=False)
    modes.power_on()
    modes_seen(modes, 3)
    assert modes.release_brakes()
    assert modes_seen(modes, 1) == ["IDLE", "RUNNING"]
    assert modes.running


def test_releasing_the_brakes_of_an_arm_that_is_off_switches_it_on_first():
    modes = Modes(TICK_S, powered=False)
    assert modes.release_brakes()
    assert modes_seen(modes, 4) == ["BOOTING", "POWER_ON", "IDLE", "RUNNING"]


def test_an_arm_that_runs_is_not_switched_on_again():
    modes = Modes(TICK_S)
    assert not modes.power_on()
    assert not modes.release_brakes()
    assert modes.robot is RobotMode.RUNNING


def test_switched_off_while_it_powers_up_it_stays_off():
    modes = Modes(TICK_S, powered=False)
    modes.power_on()
    modes_seen(modes, 0.2)
    modes.power_off()
    assert modes_seen(modes, 3) == ["POWER_OFF"]


def test_a_protective_stop_is_not_unlocked_before_five_seconds():
    modes = Modes(TICK_S)
    modes.protective_stop(1)
    assert modes.safety is SafetyMode.PROTECTIVE_STOP
    assert modes.stop_code == 1
    modes_seen(modes, UNLOCK_AFTER_S - 0.1)
    assert not modes.unlock()
    assert not modes.running
    modes_seen(modes, 0.2)
    assert modes.unlock()
    assert modes.running
    assert modes.stop_code == 0


def test_the_five_seconds_start_again_with_the_next_protective_stop():
    modes = Modes(TICK_S)
    modes.protective_stop()
    modes_seen(modes, 6)
    modes.unlock()
    modes.protective_stop()
    assert not modes.unlock()


@pytest.mark.parametrize(
    ("cause", "mode"),
    [
        ("emergency stop", SafetyMode.ROBOT_EMERGENCY_STOP),
        ("system emergency stop", SafetyMode.SYSTEM_EMERGENCY_STOP),
        ("violation", SafetyMode.VIOLATION),
        ("fault", SafetyMode.FAULT),
    ],
)
def test_a_category_1_stop_cuts_the_power_after_the_braking(cause, mode):
    modes = Modes(TICK_S)
    assert modes.cause(cause)
    assert modes.safety is mode
    assert modes_seen(modes, 1) == ["RUNNING", "POWER_OFF"]
    assert not modes.power_on()
    assert not modes.unlock()


def test_a_released_emergency_stop_leaves_the_arm_off():
    modes = Modes(TICK_S)
    modes.emergency_stop()
    modes.release_emergency_stop()
    assert (modes.robot, modes.safety) == (RobotMode.POWER_OFF, SafetyMode.NORMAL)
    assert modes.power_on()


def test_only_a_restart_of_the_safety_system_ends_a_fault():
    modes = Modes(TICK_S)
    modes.fault(191)
    modes_seen(modes, 10)
    assert not modes.unlock()
    modes.release_emergency_stop()
    assert modes.safety is SafetyMode.FAULT
    assert modes.restart_safety()
    assert modes_seen(modes, 3) == ["BOOTING", "POWER_OFF"]
    assert modes.safety is SafetyMode.NORMAL
    assert modes.stop_code == 0


def test_the_safety_system_does_not_restart_under_a_pressed_button():
    modes = Modes(TICK_S)
    modes.emergency_stop()
    assert not modes.restart_safety()
    assert modes.safety is SafetyMode.ROBOT_EMERGENCY_STOP


def test_a_fault_is_not_taken_back_by_the_red_button():
    modes = Modes(TICK_S)
    modes.fault()
    modes.emergency_stop()
    modes.release_emergency_stop()
    assert modes.safety is SafetyMode.FAULT


def test_nothing_of_the_table_is_ambiguous():
    for one in TRANSITIONS:
        for other in TRANSITIONS:
            if one is not other and one.cause == other.cause:
                both = set(one.robot) & set(other.robot), set(one.safety) & set(other.safety)
                assert not all(both), (one, other)


def test_from_every_mode_there_is_a_way_back_to_a_running_arm():
    ways = ("end safeguard stop", "release emergency stop", "unlock", "restart safety")
    for safety in {row.becomes for row in TRANSITIONS if row.becomes}:
        modes = Modes(TICK_S)
        modes.safety = safety
        modes_seen(modes, 6)
        if safety not in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            assert any(modes.cause(way) for way in ways)
        modes_seen(modes, 6)
        if not modes.running:
            assert modes.release_brakes()
        modes_seen(modes, 6)
        assert modes.running, safety


def test_a_protective_stop_pauses_the_program_and_comes_to_rest():
    machine = machine_of()
    machine.play(IdleProgram("p"))
    machine.move(Turning())
    pass_time(machine, 0.2)
    machine.protective_stop(4)
    pass_time(machine, 0.3)
    assert machine.runtime is RuntimeState.PAUSED
    assert not machine.setpoint[1].any()
    machine.resume()
    assert machine.runtime is RuntimeState.PAUSED


def test_an_emergency_stop_brakes_and_then_locks_the_arm():
    machine = machine_of()
    machine.move(Turning())
    pass_time(machine, 0.2)
    machine.emergency_stop()
    assert not machine.body.braked
    pass_time(machine, 0.7)
    assert machine.body.braked
    assert machine.outputs["robot_mode"] == RobotMode.POWER_OFF


def test_a_safeguard_stop_pauses_while_the_servo_holds_the_arm():
    machine = machine_of()
    machine.play(IdleProgram("p"))
    machine.safeguard_stop()
    pass_time(machine, 1)
    assert machine.runtime is RuntimeState.PAUSED
    assert not machine.body.braked
    assert machine.outputs["safety_status_bits"] == 1 << 4 | 1 << 10
    machine.modes.cause("end safeguard stop")
    machine.resume()
    assert machine.runtime is RuntimeState.PLAYING


def test_a_safety_fault_ends_the_program_and_the_power():
    machine = machine_of()
    machine.play(IdleProgram("p"))
    machine.fault(191)
    pass_time(machine, 1)
    assert machine.program is None
    assert machine.body.braked
    assert machine.outputs["safety_mode"] == SafetyMode.FAULT


@pytest.mark.parametrize("powered", [True, False])
def test_an_idle_controller_that_was_booted_tells_what_a_fresh_one_tells(powered):
    machine, fresh = machine_of(powered=powered), machine_of(powered=powered)
    machine.cut_power()
    machine.boot(powered=powered)
    told = {
        name: machine.outputs[name]
        for name in machine.outputs.variables
        if name.endswith(("mode", "bits", "state", "voltage", "time", "window", "scaling"))
        or name.startswith(("safety", "payload", "tcp_offset"))
    }
    assert told == {name: fresh.outputs[name] for name in told}
    assert told["safety_mode"] == SafetyMode.NORMAL


def test_the_accelerometer_of_a_booted_controller_feels_no_step_of_the_speed_before():
    machine = machine_of()
    machine.move(Turning())
    pass_time(machine, 0.1)
    machine.cut_power()
    machine.boot(powered=True)
    assert np.linalg.norm(machine.outputs["actual_tool_accelerometer"]) == pytest.approx(9.81, 0.01)


# The teach pendant of the mock UR controller: how its stops are released.


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
            return main(["send", "--address", mock.address, *words])

        assert ask("fault", "emergency_stop") == 0
        assert ask("pendant", "unlock") == 4
        assert "next: press release_emergency_stop" in capsys.readouterr().err
        for what in ("release_emergency_stop", "brake_release"):
            assert ask("pendant", what) == 0
        until(lambda: mock.side("state")["robot_mode"] == "RUNNING")
        state = mock.side("state")
        assert (state["safety_mode"], state["faults"]) == ("NORMAL", [])
