"""The buttons of the teach pendant that the mock does not have: how its stops are released.

Unlike the dashboard they work in local control, and there is one for the emergency stop itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hil.core import CommandRefused, SpecError
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.mode_codes import RuntimeState, SafetyMode
from hil_mock_robot.ur.transitions import UNLOCK_AFTER_S


def _play(machine: Machine) -> bool:
    machine.resume()
    return machine.runtime is RuntimeState.PLAYING


def _pause(machine: Machine) -> bool:
    playing = machine.runtime is RuntimeState.PLAYING
    machine.pause()
    return playing


def _stop(machine: Machine) -> bool:
    machine.halt()
    return True


def _control(remote: bool) -> Callable[[Machine], bool]:
    def choose(machine: Machine) -> bool:
        machine.modes.remote = remote
        return True

    return choose


def _cause(what: str) -> Callable[[Machine], bool]:
    return lambda machine: machine.modes.cause(what)


PRESSES: Mapping[str, Callable[[Machine], bool]] = {
    "unlock": _cause("unlock"),
    "release_emergency_stop": _cause("release emergency stop"),
    "restart_safety": _cause("restart safety"),
    "power_on": _cause("power on"),
    "brake_release": _cause("release brakes"),
    "power_off": _cause("power off"),
    "play": _play,
    "pause": _pause,
    "stop": _stop,
    "remote": _control(True),
    "local": _control(False),
}
"""What can be pressed; each says whether it did anything."""


def pressed(machine: Machine, request: Mapping[str, Any]) -> dict[str, Any]:
    """Press a button; what the controller is like right after.

    Raises:
        SpecError: There is no such button.
        CommandRefused: It does nothing as things are.
    """
    what = request.get("press")
    if not isinstance(what, str) or what not in PRESSES:
        raise SpecError(f"pendant: press is {what!r}", hint=f"use one of {', '.join(PRESSES)}")
    if not PRESSES[what](machine):
        robot, safety = machine.modes.robot.name, machine.modes.safety.name
        raise CommandRefused(
            f"pendant: {what} does nothing now: robot mode {robot}, safety mode {safety}, "
            f"program {machine.runtime.name}",
            hint=_way_out(machine),
        )
    modes = machine.modes
    return {"robot_mode": modes.robot.name, "safety_mode": modes.safety.name}


def _way_out(machine: Machine) -> str:
    safety = machine.modes.safety
    if safety is SafetyMode.PROTECTIVE_STOP:
        return f"unlock it {UNLOCK_AFTER_S:g} s of device time after it has stopped"
    if safety in (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP):
        return "press release_emergency_stop, then brake_release, which switches the arm on, too"
    if safety is SafetyMode.SAFEGUARD_STOP:
        return 'end it first: {"do": "clear"}'
    if safety in (SafetyMode.FAULT, SafetyMode.VIOLATION):
        return "press restart_safety and, 2 s of device time later, brake_release"
    return "an arm that is off or idle needs brake_release, one that boots a second"
