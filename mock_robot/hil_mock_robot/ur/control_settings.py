"""The control script's settings: load, tool, watchdog, hand guiding."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from hil_mock_robot.ur.settings import set_payload, set_tcp, set_watchdog
from hil_mock_robot.ur.threaded import Steps

if TYPE_CHECKING:
    from hil_mock_robot.ur.control_script import ControlScript

PROTECTIVE_STOP_BY_PROGRAM = 0
FREEDRIVE_NORMAL = 0


def _set_payload(script: ControlScript) -> None:
    """A centre of all zeros means the present one, on e-Series only."""
    mass, *com = script.registers.doubles(0, 4).tolist()
    keep = script.has(None, (5, 0)) and not any(com)
    set_payload(script.machine, mass, None if keep else com)


def _set_target_payload(script: ControlScript) -> None:
    """Nothing, and done, before 5.10 and on CB3."""
    if script.has(None, (5, 10)):
        mass, *rest = script.registers.doubles(0, 10).tolist()
        com = rest[:3] if any(rest[:3]) else None
        set_payload(script.machine, mass, com, rest[3:])


def _set_tcp(script: ControlScript) -> None:
    set_tcp(script.machine, script.registers.doubles(0).tolist())


def _set_watchdog(script: ControlScript) -> None:
    variable = f"input_int_register_{script.registers.offset}"
    set_watchdog(script.machine, variable, script.registers.double(0), "stop")


def _protective_stop(script: ControlScript) -> Steps:
    """The program pauses before it can say that it is done: the client sees the stop first."""
    if script.has((3, 8), (5, 0)):
        script.machine.protective_stop(PROTECTIVE_STOP_BY_PROGRAM)
        yield


def _teach_mode(script: ControlScript) -> None:
    script.hand_guided = True


def _end_teach_mode(script: ControlScript) -> None:
    script.hand_guided = False


def _freedrive_mode(script: ControlScript) -> None:
    if script.has(None, (5, 10)):
        script.hand_guided = True


def _end_freedrive_mode(script: ControlScript) -> None:
    if script.has(None, (5, 10)):
        script.hand_guided = False


def _freedrive_status(script: ControlScript) -> None:
    if script.has(None, (5, 10)):
        script.registers.put_integer(1, FREEDRIVE_NORMAL)


def _nothing(script: ControlScript) -> None:
    """Accepted without effect: the mock has no such sensor, or no such setting."""


SETTINGS: dict[int, Callable[[ControlScript], Steps | None]] = {
    8: _nothing,  # zero_ftsensor
    17: _set_payload,
    18: _teach_mode,
    19: _end_teach_mode,
    20: _nothing,  # force_mode_set_damping
    21: _nothing,  # force_mode_set_gain_scaling
    29: _set_tcp,
    31: _protective_stop,
    35: _set_watchdog,
    52: _freedrive_mode,
    53: _end_freedrive_mode,
    54: _freedrive_status,
    56: _nothing,  # ft_rtde_input_enable
    57: _nothing,  # enable_external_ft_sensor
    59: _nothing,  # set_gravity
    65: _set_target_payload,
}
