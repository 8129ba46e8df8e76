"""What RTDE inputs do to the controller besides lying in registers: masked outputs, the slider.

An input group takes effect when a package with one of its variables comes, with the values that
lie there then. Source: RTDE Guide, comments in the table of inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

Effect = Callable[["Machine"], None]

STANDARD, CONFIGURABLE, TOOL = 0, 8, 16
"""Lowest bit of each group in `actual_digital_output_bits`."""

LOWEST_MA, SPAN_MA, SPAN_V = 4.0, 16.0, 10.0
VOLTAGE_BITS = (1 << 2, 1 << 3)
"""Of `analog_io_types`: analog output 0 and 1 are voltages."""


def effects_of(names: Iterable[str]) -> tuple[Effect, ...]:
    """What a package with these inputs does; each effect once."""
    return tuple(dict.fromkeys(_EFFECTS[name] for name in names if name in _EFFECTS))


def _digital(group: str, lowest: int, width: int) -> Effect:
    bits, mask = f"{group}_digital_output", f"{group}_digital_output_mask"

    def effect(machine: Machine) -> None:
        inputs, outputs = machine.inputs, machine.outputs
        chosen = (inputs[mask] & (1 << width) - 1) << lowest
        before = outputs["actual_digital_output_bits"]
        outputs["actual_digital_output_bits"] = (before & ~chosen) | (
            inputs[bits] << lowest & chosen
        )

    return effect


def _analog(machine: Machine) -> None:
    inputs, outputs = machine.inputs, machine.outputs
    mask, kinds = inputs["standard_analog_output_mask"], inputs["standard_analog_output_type"]
    for number, voltage in enumerate(VOLTAGE_BITS):
        ratio = inputs[f"standard_analog_output_{number}"]
        # What is not chosen may be anything: ur_rtde sends uninitialised memory there.
        if not mask >> number & 1 or not math.isfinite(ratio):
            continue
        ratio = min(max(ratio, 0.0), 1.0)
        is_voltage = bool(kinds >> number & 1)
        level = SPAN_V * ratio if is_voltage else LOWEST_MA + SPAN_MA * ratio
        outputs[f"standard_analog_output{number}"] = level
        types = outputs["analog_io_types"]
        outputs["analog_io_types"] = types | voltage if is_voltage else types & ~voltage


def _slider(machine: Machine) -> None:
    fraction = machine.inputs["speed_slider_fraction"]
    if machine.inputs["speed_slider_mask"] & 1 and math.isfinite(fraction):
        machine.speed_fraction = min(max(fraction, 0.0), 1.0)


_EFFECTS: dict[str, Effect] = {
    "standard_analog_output_mask": _analog,
    "standard_analog_output_type": _analog,
    "standard_analog_output_0": _analog,
    "standard_analog_output_1": _analog,
    "speed_slider_mask": _slider,
    "speed_slider_fraction": _slider,
}
for _group, _lowest, _width in (
    ("standard", STANDARD, 8),
    ("configurable", CONFIGURABLE, 8),
    ("tool", TOOL, 2),
):
    _effect = _digital(_group, _lowest, _width)
    _EFFECTS[f"{_group}_digital_output"] = _EFFECTS[f"{_group}_digital_output_mask"] = _effect
