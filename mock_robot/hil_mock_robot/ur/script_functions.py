"""URScript functions of uploaded programs: actions, which may take ticks, and answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import CommandRefused
from hil_mock_robot.ur.program import Steps, set_payload, set_tcp, set_watchdog
from hil_mock_robot.ur.script_answers import ANSWERS as ANSWERS
from hil_mock_robot.ur.script_arguments import Given, Named, bound
from hil_mock_robot.ur.script_motions import MOTIONS
from hil_mock_robot.ur.script_values import integer, joined, number, shown, six, truth

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_evaluation import Evaluator

Action = Callable[["Evaluator", Given, Named], Steps | None]

STANDARD, CONFIGURABLE, TOOL = (0, 8), (8, 8), (16, 2)
"""Lowest bit and number of bits of each group in RTDE's `actual_digital_output_bits`."""
MOST_REGISTERS = 48
SMALLEST_INT32, LARGEST_INT32 = -(2**31), 2**31 - 1
FULL_SCALE_V = 10.0


def _write_integer(program: Evaluator, given: Given, named: Named) -> None:
    index, value = bound("write_output_integer_register", given, named, ["address", "value"])
    value = integer(value, SMALLEST_INT32, LARGEST_INT32)
    program.registers.put_integer(integer(index, 0, MOST_REGISTERS - 1), value)


def _write_float(program: Evaluator, given: Given, named: Named) -> None:
    index, value = bound("write_output_float_register", given, named, ["address", "value"])
    program.registers.put_doubles(integer(index, 0, MOST_REGISTERS - 1), [number(value)])


def _write_boolean(program: Evaluator, given: Given, named: Named) -> None:
    index, value = bound("write_output_boolean_register", given, named, ["address", "value"])
    _set_bit(program, integer(index, 0, 127), truth(value))


def _set_bit(program: Evaluator, index: int, value: bool) -> None:
    outputs = program.machine.outputs
    if index >= 64:
        outputs.offer(f"output_bit_register_{index}", value)
        return
    first = index // 32 * 32
    name = f"output_bit_registers{first}_to_{first + 31}"
    bit = 1 << index % 32
    outputs[name] = (outputs[name] & ~bit) | (bit * value)


def _digital(group: tuple[int, int]) -> Action:
    lowest, count = group

    def action(program: Evaluator, given: Given, named: Named) -> None:
        index, value = bound("set_digital_out", given, named, ["n", "b"])
        bit = 1 << lowest + integer(index, 0, count - 1)
        outputs = program.machine.outputs
        bits = outputs["actual_digital_output_bits"]
        outputs["actual_digital_output_bits"] = bits | bit if truth(value) else bits & ~bit

    return action


def _analog(program: Evaluator, given: Given, named: Named) -> None:
    index, value = bound("set_analog_out", given, named, ["n", "f"])
    share = min(max(number(value), 0.0), 1.0)
    program.machine.outputs[f"standard_analog_output{integer(index, 0, 1)}"] = share * FULL_SCALE_V


def _payload(program: Evaluator, given: Given, named: Named) -> None:
    mass, com = bound("set_payload", given, named, ["m"], {"cog": None})
    set_payload(program.machine, number(mass), _three(com))


def _target_payload(program: Evaluator, given: Given, named: Named) -> None:
    optional = {"inertia": [0.0] * 6, "transition_time": 0.0}
    mass, com, inertia, _ = bound("set_target_payload", given, named, ["m", "cog"], optional)
    if not program.machine.series.at_least(None, (5, 10)):
        raise CommandRefused("there is no function 'set_target_payload' in this software")
    set_payload(program.machine, number(mass), _three(com), six(inertia))


def _three(values: Any) -> list[float] | None:
    if values is None:
        return None
    if not isinstance(values, list) or len(values) != 3:
        raise CommandRefused(f"three numbers are needed, not {shown(values)}")
    return [number(each) for each in values]


def _tcp(program: Evaluator, given: Given, named: Named) -> None:
    pose, _ = bound("set_tcp", given, named, ["pose"], {"tcp_name": ""})
    set_tcp(program.machine, six(pose))


def _watchdog(program: Evaluator, given: Given, named: Named) -> None:
    names, optional = ["variable_name", "min_frequency"], {"action": "pause"}
    variable, least_hz, action = bound("rtde_set_watchdog", given, named, names, optional)
    set_watchdog(program.machine, str(variable), number(least_hz), str(action))


def _guided(start: bool) -> Action:
    def action(program: Evaluator, given: Given, named: Named) -> None:
        program.hand_guided = start

    return action


def _text(program: Evaluator, given: Given, named: Named) -> None:
    program.machine.tell("text", program.name, joined([*given, *named.values()]))


def _popup(program: Evaluator, given: Given, named: Named) -> None:
    optional = {"title": "Popup", "warning": False, "error": False, "blocking": False}
    text, title, *_ = bound("popup", given, named, ["s"], optional)
    program.machine.tell("popup", shown(title), shown(text))


def _protective_stop(program: Evaluator, given: Given, named: Named) -> Steps:
    bound("protective_stop", given, named, [])
    program.machine.protective_stop(0)
    yield


def _slider(program: Evaluator, given: Given, named: Named) -> None:
    (fraction,) = bound("set_speed_slider", given, named, ["f"])
    program.machine.speed_fraction = float(np.clip(number(fraction), 0.0, 1.0))


def _nothing(program: Evaluator, given: Given, named: Named) -> None:
    """Accept a call of a URScript function without effect."""


ACTIONS: dict[str, Action] = {
    **MOTIONS,
    "end_freedrive_mode": _guided(start=False),
    "end_teach_mode": _guided(start=False),
    "freedrive_mode": _guided(start=True),
    "popup": _popup,
    "protective_stop": _protective_stop,
    "rtde_set_watchdog": _watchdog,
    "set_analog_out": _analog,
    "set_configurable_digital_out": _digital(CONFIGURABLE),
    "set_digital_out": _digital((0, 18)),
    "set_payload": _payload,
    "set_speed_slider": _slider,
    "set_standard_analog_out": _analog,
    "set_standard_digital_out": _digital(STANDARD),
    "set_target_payload": _target_payload,
    "set_tcp": _tcp,
    "set_tool_digital_out": _digital(TOOL),
    "teach_mode": _guided(start=True),
    "textmsg": _text,
    "write_output_boolean_register": _write_boolean,
    "write_output_float_register": _write_float,
    "write_output_integer_register": _write_integer,
    **dict.fromkeys(
        ("end_force_mode", "force_mode", "force_mode_set_damping", "force_mode_set_gain_scaling",
         "set_analog_outputdomain", "set_gravity", "set_tool_output_mode", "set_tool_voltage",
         "zero_ftsensor"),
        _nothing,
    ),
}  # fmt: skip
