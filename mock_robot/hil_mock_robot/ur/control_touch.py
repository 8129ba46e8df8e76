"""The control script's commands about contacts, which only e-Series software knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hil.core import CommandRefused, FloatArray
from hil_mock_robot.ur.contact import SINCE
from hil_mock_robot.ur.control_moves import stop_move
from hil_mock_robot.ur.kinematics import tool_velocity
from hil_mock_robot.ur.motions import Leg
from hil_mock_robot.ur.moving import stop_line
from hil_mock_robot.ur.path import follow
from hil_mock_robot.ur.servoing import SpeedL
from hil_mock_robot.ur.threaded import Steps

if TYPE_CHECKING:
    from hil_mock_robot.ur.control_script import ControlScript

CONTACT = "contact"
"""Thread."""
CONTACT_SEEN = 254
STOP_M_S2, BACK_M_S, BACK_M_S2 = 3.0, 0.25, 1.2
"""How it stops at a contact, and URScript's own speed of the way back."""


def _tool_contact(script: ControlScript) -> None:
    direction = script.registers.doubles(0)
    if script.has(*SINCE):
        script.registers.put_integer(1, script.touch.along(direction))


def _history(script: ControlScript) -> None:
    if script.has(*SINCE):
        script.registers.put_doubles(0, _past(script, script.registers.integer(1)))


def _past(script: ControlScript, ticks: int) -> FloatArray:
    q = script.touch.past(ticks)
    if q is None:
        raise CommandRefused(f"get_actual_joint_positions_history: no {ticks} steps are remembered")
    return q


def _move_until_contact(script: ControlScript) -> Steps | None:
    if not script.has(*SINCE):
        return None
    r = script.registers
    return _until_contact(script, r.doubles(0), r.doubles(6), r.double(12))


def _until_contact(
    script: ControlScript, speed: FloatArray, direction: FloatArray, acceleration: float
) -> Steps:
    machine = script.machine
    motion: SpeedL | None = None
    with script.control():
        while not (ticks := script.touch.along(direction)):
            if motion is None or machine.motion is not motion:
                motion = SpeedL(machine.body.arm, machine.tcp, machine.tick_s)
                machine.move(motion)
            motion.aim(speed, acceleration)
            yield
        yield from _back_to_contact(script, ticks)


def _back_to_contact(script: ControlScript, ticks: int) -> Steps:
    q = _past(script, ticks)
    yield from stop_line(script, STOP_M_S2)
    yield from follow(script, [Leg("l", q, BACK_M_S, BACK_M_S2)])


def _start_detection(script: ControlScript) -> None:
    script.kill(CONTACT)
    script.run(CONTACT, _detect(script, script.registers.doubles(0)))


def _detect(script: ControlScript, direction: FloatArray) -> Steps:
    """Wait until nothing is touched, then until something is; CB3 sees a contact at once."""
    script.contact = 0
    if not script.has(*SINCE):
        script.contact, script.internal = 1, CONTACT_SEEN
        return
    while script.touch.along(_way(script, direction)):
        yield
    while not (ticks := script.touch.along(_way(script, direction))):
        yield
    script.contact, script.internal = ticks, CONTACT_SEEN


def _way(script: ControlScript, direction: FloatArray) -> FloatArray:
    """A sum of zero means: wherever the TCP moves, as in the script."""
    if direction.sum() >= 1e-10:
        return direction
    machine = script.machine
    q, qd, _ = machine.setpoint
    return tool_velocity(machine.body.arm, q, qd, machine.tcp)


def _stop_detection(script: ControlScript) -> None:
    script.kill(CONTACT)
    script.registers.put_integer(1, script.contact)


def _read_detection(script: ControlScript) -> None:
    script.registers.put_integer(1, script.contact)


def _contact_seen(script: ControlScript) -> Steps | None:
    if not script.has(*SINCE):
        return None
    stop_move(script)
    return _back_to_contact(script, script.contact)


TOUCHES: dict[int, Callable[[ControlScript], Steps | None]] = {
    25: _tool_contact,
    27: _history,
    51: _move_until_contact,
    62: _start_detection,
    63: _stop_detection,
    64: _read_detection,
    CONTACT_SEEN: _contact_seen,
}
