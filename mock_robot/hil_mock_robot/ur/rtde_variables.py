"""RTDE variables: names, wire types, first software versions, and values.

`CB3` and `E_SERIES` are the two generations of controllers that the mock simulates (CB3: the UR5 of
the static paper). `Values` contains the present values of inputs or outputs in one flat list, which
recipes pack. The machine updates the values after every tick (`machine`).

The source is Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of outputs and
inputs. Source of `tcp_offset`: Universal_Robots_Client_Library, pull request 110 (3.12.0 and
5.5.1). Variables of later software than the simulated versions are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hil.core import SpecError


@dataclass(frozen=True, slots=True)
class Series:
    """Generation of controllers.

    Attributes:
        name: Name of the series: `cb3` or `e`.
        version: Major, minor, bug-fix and build number of the controller software.
        date: Date of the software, sent with the version.
        rate_hz: Ticks per second, also the maximum RTDE rate [Hz].
        arms: Built-in arms that a controller of this series can move.
    """

    name: str
    version: tuple[int, int, int, int]
    date: str
    rate_hz: float
    arms: tuple[str, ...]

    @property
    def is_e(self) -> bool:
        """Whether the controller belongs to the e-Series."""
        return self.version[0] >= 5

    def at_least(self, cb3: tuple[int, int] | None, e: tuple[int, int] | None) -> bool:
        """Return whether the software has a feature, given its first versions; None means never."""
        since = e if self.is_e else cb3
        return since is not None and self.version[:2] >= since


CB3 = Series("cb3", (3, 15, 8, 106339), "Apr 17 2022", 125.0, ("ur3", "ur5", "ur10"))
E_SERIES = Series("e", (5, 12, 2, 1101534), "Dec 02 2022", 500.0, ("ur3e", "ur5e", "ur10e"))


def series_of(arm: str) -> Series:
    """Return the generation of the controller that moves a built-in arm.

    Raises:
        SpecError: The arm is not one of Universal Robots.
    """
    for series in (CB3, E_SERIES):
        if arm in series.arms:
            return series
    known = ", ".join(CB3.arms + E_SERIES.arms)
    raise SpecError(f"a UR controller cannot move a {arm}", hint=f"use one of {known}")


Number = float | int | bool

WIRE: Mapping[str, tuple[str, int]] = {
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("d", 3),
    "VECTOR6D": ("d", 6),
    "VECTOR6INT32": ("i", 6),
    "VECTOR6UINT32": ("I", 6),
}
"""Map from RTDE type name to format letter of `struct` and number of values."""

ALWAYS = (0, 0)

UPPER_SINCE = ((3, 9), (5, 3))
"""First software versions that have registers 24 to 47 and single bits 64 to 127."""


@dataclass(frozen=True, slots=True)
class Variable:
    """RTDE variable with its name, its wire type, and the index of its first value."""

    name: str
    type: str
    offset: int

    @property
    def count(self) -> int:
        """Number of values of the variable."""
        return WIRE[self.type][1]

    @property
    def format(self) -> str:
        """Format of the values for `struct`."""
        letter, count = WIRE[self.type]
        return letter * count

    @property
    def places(self) -> range:
        """Indices of the values in `Values.flat`."""
        return range(self.offset, self.offset + self.count)


class Values:
    """Present values of a set of variables.

    Args:
        named: Pairs (name, type), in any order.

    Attributes:
        variables: Name → variable.
        flat: List of the numbers of all variables; recipes pack numbers of this list into packages.
    """

    def __init__(self, named: Iterable[tuple[str, str]]) -> None:
        self.variables: dict[str, Variable] = {}
        self.flat: list[Any] = []
        self._places: dict[str, tuple[Any, int]] = {}
        for name, kind in named:
            at = self.variables[name] = Variable(name, kind, len(self.flat))
            several = slice(at.offset, at.offset + at.count)
            self._places[name] = (several if at.count > 1 else at.offset), at.count
            self.flat += [0.0 if WIRE[kind][0] == "d" else 0] * at.count

    def __contains__(self, name: str) -> bool:
        return name in self.variables

    def __setitem__(self, name: str, value: Any) -> None:
        """Set a number, or a list with as many numbers as the variable has.

        Raises:
            ValueError: The list has a different length, which would shift the following variables.
        """
        at, count = self._places[name]
        if count > 1 and len(value) != count:
            raise ValueError(f"{name}: {len(value)} numbers instead of {count}")
        self.flat[at] = value

    def __getitem__(self, name: str) -> Any:
        """Return a number, or a list of numbers."""
        return self.flat[self._places[name][0]]

    def offer(self, name: str, value: Number | Sequence[Number]) -> None:
        """Set a variable if the simulated software has this variable."""
        if name in self.variables:
            self[name] = value


_OUTPUTS: tuple[tuple[str, str, tuple[int, int] | None, tuple[int, int] | None], ...] = (
    ("timestamp", "DOUBLE", ALWAYS, ALWAYS),
    ("target_q", "VECTOR6D", ALWAYS, ALWAYS),
    ("target_qd", "VECTOR6D", ALWAYS, ALWAYS),
    ("target_qdd", "VECTOR6D", ALWAYS, ALWAYS),
    ("target_current", "VECTOR6D", ALWAYS, ALWAYS),
    ("target_moment", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_q", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_qd", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_current", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_current_window", "VECTOR6D", None, ALWAYS),
    ("actual_current_as_torque", "VECTOR6D", None, (5, 23)),
    ("joint_control_output", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_TCP_pose", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_TCP_speed", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_TCP_force", "VECTOR6D", ALWAYS, ALWAYS),
    ("target_TCP_pose", "VECTOR6D", ALWAYS, ALWAYS),
    ("target_TCP_speed", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_digital_input_bits", "UINT64", ALWAYS, ALWAYS),
    ("joint_temperatures", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_execution_time", "DOUBLE", ALWAYS, ALWAYS),
    ("robot_mode", "INT32", ALWAYS, ALWAYS),
    ("joint_mode", "VECTOR6INT32", ALWAYS, ALWAYS),
    ("safety_mode", "INT32", ALWAYS, ALWAYS),
    ("safety_status", "INT32", (3, 10), (5, 4)),
    ("actual_tool_accelerometer", "VECTOR3D", ALWAYS, ALWAYS),
    ("speed_scaling", "DOUBLE", ALWAYS, ALWAYS),
    ("target_speed_fraction", "DOUBLE", ALWAYS, ALWAYS),
    ("actual_momentum", "DOUBLE", ALWAYS, ALWAYS),
    ("actual_main_voltage", "DOUBLE", ALWAYS, ALWAYS),
    ("actual_robot_voltage", "DOUBLE", ALWAYS, ALWAYS),
    ("actual_robot_current", "DOUBLE", ALWAYS, ALWAYS),
    ("actual_joint_voltage", "VECTOR6D", ALWAYS, ALWAYS),
    ("actual_digital_output_bits", "UINT64", ALWAYS, ALWAYS),
    ("runtime_state", "UINT32", ALWAYS, ALWAYS),
    ("elbow_position", "VECTOR3D", (3, 5), ALWAYS),
    ("elbow_velocity", "VECTOR3D", (3, 5), ALWAYS),
    ("robot_status_bits", "UINT32", ALWAYS, ALWAYS),
    ("safety_status_bits", "UINT32", ALWAYS, ALWAYS),
    ("analog_io_types", "UINT32", ALWAYS, ALWAYS),
    ("standard_analog_input0", "DOUBLE", ALWAYS, ALWAYS),
    ("standard_analog_input1", "DOUBLE", ALWAYS, ALWAYS),
    ("standard_analog_output0", "DOUBLE", ALWAYS, ALWAYS),
    ("standard_analog_output1", "DOUBLE", ALWAYS, ALWAYS),
    ("io_current", "DOUBLE", ALWAYS, ALWAYS),
    ("euromap67_input_bits", "UINT32", ALWAYS, ALWAYS),
    ("euromap67_output_bits", "UINT32", ALWAYS, ALWAYS),
    ("euromap67_24V_voltage", "DOUBLE", ALWAYS, ALWAYS),
    ("euromap67_24V_current", "DOUBLE", ALWAYS, ALWAYS),
    ("tool_mode", "UINT32", ALWAYS, ALWAYS),
    ("tool_analog_input_types", "UINT32", ALWAYS, ALWAYS),
    ("tool_analog_input0", "DOUBLE", ALWAYS, ALWAYS),
    ("tool_analog_input1", "DOUBLE", ALWAYS, ALWAYS),
    ("tool_output_voltage", "INT32", ALWAYS, ALWAYS),
    ("tool_output_current", "DOUBLE", ALWAYS, ALWAYS),
    ("tool_temperature", "DOUBLE", ALWAYS, ALWAYS),
    ("tcp_force_scalar", "DOUBLE", ALWAYS, ALWAYS),
    ("tool_output_mode", "UINT8", None, (5, 2)),
    ("tool_digital_output0_mode", "UINT8", None, (5, 2)),
    ("tool_digital_output1_mode", "UINT8", None, (5, 2)),
    ("payload", "DOUBLE", (3, 11), (5, 6)),
    ("payload_cog", "VECTOR3D", (3, 11), (5, 6)),
    ("payload_inertia", "VECTOR6D", (3, 15), (5, 11)),
    ("script_control_line", "UINT32", None, (5, 9)),
    ("ft_raw_wrench", "VECTOR6D", None, (5, 9)),
    ("joint_position_deviation_ratio", "DOUBLE", None, (5, 11)),
    ("collision_detection_ratio", "DOUBLE", None, (5, 15)),
    ("time_scale_source", "INT32", None, (5, 17)),
    ("tcp_offset", "VECTOR6D", (3, 12), (5, 6)),
    ("output_bit_registers0_to_31", "UINT32", ALWAYS, ALWAYS),
    ("output_bit_registers32_to_63", "UINT32", ALWAYS, ALWAYS),
    ("input_bit_registers0_to_31", "UINT32", ALWAYS, ALWAYS),
    ("input_bit_registers32_to_63", "UINT32", ALWAYS, ALWAYS),
)


def outputs_of(series: Series) -> Values:
    """Return all RTDE outputs of a controller."""
    named = [(name, kind) for name, kind, cb3, e in _OUTPUTS if series.at_least(cb3, e)]
    return Values([*named, *_registers("output", series), *_registers("input", series)])


def _registers(side: str, series: Series) -> list[tuple[str, str]]:
    upper = series.at_least(*UPPER_SINCE)
    count = 48 if upper else 24
    bits = [(f"{side}_bit_register_{i}", "BOOL") for i in range(64, 128)] if upper else []
    return [
        *bits,
        *((f"{side}_int_register_{i}", "INT32") for i in range(count)),
        *((f"{side}_double_register_{i}", "DOUBLE") for i in range(count)),
    ]


_INPUTS: tuple[tuple[str, str, tuple[int, int] | None, tuple[int, int] | None], ...] = (
    ("speed_slider_mask", "UINT32", ALWAYS, ALWAYS),
    ("speed_slider_fraction", "DOUBLE", ALWAYS, ALWAYS),
    ("standard_digital_output_mask", "UINT8", ALWAYS, ALWAYS),
    ("standard_digital_output", "UINT8", ALWAYS, ALWAYS),
    ("configurable_digital_output_mask", "UINT8", ALWAYS, ALWAYS),
    ("configurable_digital_output", "UINT8", ALWAYS, ALWAYS),
    ("tool_digital_output_mask", "UINT8", ALWAYS, ALWAYS),
    ("tool_digital_output", "UINT8", ALWAYS, ALWAYS),
    ("standard_analog_output_mask", "UINT8", ALWAYS, ALWAYS),
    ("standard_analog_output_type", "UINT8", ALWAYS, ALWAYS),
    ("standard_analog_output_0", "DOUBLE", ALWAYS, ALWAYS),
    ("standard_analog_output_1", "DOUBLE", ALWAYS, ALWAYS),
    ("external_force_torque", "VECTOR6D", (3, 3), ALWAYS),
    ("input_bit_registers0_to_31", "UINT32", ALWAYS, ALWAYS),
    ("input_bit_registers32_to_63", "UINT32", ALWAYS, ALWAYS),
)


def inputs_of(series: Series) -> Values:
    """Return all RTDE inputs of a controller."""
    named = [(name, kind) for name, kind, cb3, e in _INPUTS if series.at_least(cb3, e)]
    return Values([*named, *_registers("input", series)])
