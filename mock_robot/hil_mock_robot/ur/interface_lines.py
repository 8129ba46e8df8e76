"""Lines on 30001 to 30003 that are no URScript: they act on the controller, beside any program.

No page of the maker lists them all; these are the ones that clients send (UR's client library,
python-urx and its predecessors).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

SPEED = "set speed "


def _run(machine: Machine) -> None:
    """Switch on and release the brakes; an arm that runs already goes on with what it does."""
    machine.modes.release_brakes()


def _nothing(machine: Machine) -> None:
    """Accepted without effect: the mock has no second arm to simulate, and nobody pushes it."""


LINES: Mapping[str, Callable[[Machine], object]] = {
    "pause program": lambda machine: machine.pause(),
    "power off": lambda machine: machine.modes.power_off(),
    "power on": lambda machine: machine.modes.power_on(),
    "resume program": lambda machine: machine.resume(),
    "run program": _nothing,
    "set real": _nothing,
    "set robotmode freedrive": _nothing,
    "set robotmode run": _run,
    "set sim": _nothing,
    "set unlock protective stop": lambda machine: machine.modes.unlock(),
    "stop program": lambda machine: machine.halt(),
}


def obey(line: str, machine: Machine) -> bool:
    """Do what a line says; False when it is none of these, and so a program.

    Args:
        line: Without comment and space around it.
        machine: The controller.
    """
    words = " ".join(line.split())
    if words.startswith(SPEED):
        return _set_speed(words.removeprefix(SPEED), machine)
    action = LINES.get(words)
    if action is None:
        return False
    action(machine)
    return True


def _set_speed(text: str, machine: Machine) -> bool:
    try:
        fraction = float(text)
    except ValueError:
        return False
    if math.isfinite(fraction):
        machine.speed_fraction = min(max(fraction, 0.0), 1.0)
    return True
