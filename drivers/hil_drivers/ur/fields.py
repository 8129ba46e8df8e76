"""Which RTDE outputs are recorded, by series of controller; what there is of them is negotiated.

Sorted by width, widest first: so packages become rows by a few copies (`rtde_wire.Layout`), and
rows are valid messages as they lie in memory (decision record 0002).
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", table of controller outputs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Since = Literal["always", "e"]


@dataclass(frozen=True, slots=True)
class Field:
    """One RTDE output.

    Attributes:
        name, type: As RTDE has them.
        unit: For the recording; empty for bits, modes and ratios.
        since: `e` for what no CB3 controller has. Other differences come out when asking.
    """

    name: str
    type: str
    unit: str = ""
    since: Since = "always"


REQUIRED = ("timestamp", "actual_q", "actual_qd")
"""Without these there is nothing to record."""

FIELDS = (
    Field("timestamp", "DOUBLE", "s"),
    Field("target_q", "VECTOR6D", "rad"),
    Field("target_qd", "VECTOR6D", "rad/s"),
    Field("target_qdd", "VECTOR6D", "rad/s^2"),
    Field("target_current", "VECTOR6D", "A"),
    Field("target_moment", "VECTOR6D", "N·m"),
    Field("actual_q", "VECTOR6D", "rad"),
    Field("actual_qd", "VECTOR6D", "rad/s"),
    Field("actual_current", "VECTOR6D", "A"),
    Field("joint_temperatures", "VECTOR6D", "°C"),
    Field("actual_current_as_torque", "VECTOR6D", "N·m", "e"),
    Field("actual_current_window", "VECTOR6D", "A", "e"),
    Field("joint_control_output", "VECTOR6D", "A"),
    Field("actual_joint_voltage", "VECTOR6D", "V"),
    Field("actual_TCP_pose", "VECTOR6D", "m, rad (rotation vector)"),
    Field("actual_TCP_speed", "VECTOR6D", "m/s, rad/s"),
    Field("actual_TCP_force", "VECTOR6D", "N, N·m"),
    Field("target_TCP_pose", "VECTOR6D", "m, rad (rotation vector)"),
    Field("target_TCP_speed", "VECTOR6D", "m/s, rad/s"),
    Field("tcp_offset", "VECTOR6D", "m, rad (rotation vector)", "e"),
    Field("ft_raw_wrench", "VECTOR6D", "N, N·m", "e"),
    Field("payload_inertia", "VECTOR6D", "kg·m^2 (xx yy zz xy xz yz)"),
    Field("payload_cog", "VECTOR3D", "m"),
    Field("payload", "DOUBLE", "kg"),
    Field("actual_tool_accelerometer", "VECTOR3D", "m/s^2"),
    Field("elbow_position", "VECTOR3D", "m"),
    Field("elbow_velocity", "VECTOR3D", "m/s"),
    Field("actual_execution_time", "DOUBLE", "ms"),
    Field("speed_scaling", "DOUBLE"),
    Field("target_speed_fraction", "DOUBLE"),
    Field("actual_momentum", "DOUBLE", "kg·m/s"),
    Field("tcp_force_scalar", "DOUBLE", "N"),
    Field("joint_position_deviation_ratio", "DOUBLE", "", "e"),
    Field("collision_detection_ratio", "DOUBLE", "", "e"),
    Field("actual_main_voltage", "DOUBLE", "V"),
    Field("actual_robot_voltage", "DOUBLE", "V"),
    Field("actual_robot_current", "DOUBLE", "A"),
    Field("io_current", "DOUBLE", "mA"),
    Field("tool_output_current", "DOUBLE", "mA"),
    Field("tool_temperature", "DOUBLE", "°C"),
    Field("standard_analog_input0", "DOUBLE", "A or V"),
    Field("standard_analog_input1", "DOUBLE", "A or V"),
    Field("standard_analog_output0", "DOUBLE", "A or V"),
    Field("standard_analog_output1", "DOUBLE", "A or V"),
    Field("actual_digital_input_bits", "UINT64"),
    Field("actual_digital_output_bits", "UINT64"),
    Field("robot_mode", "INT32"),
    Field("joint_mode", "VECTOR6INT32"),
    Field("safety_mode", "INT32"),
    Field("safety_status", "INT32"),
    Field("time_scale_source", "INT32", "", "e"),
    Field("runtime_state", "UINT32"),
    Field("robot_status_bits", "UINT32"),
    Field("safety_status_bits", "UINT32"),
    Field("script_control_line", "UINT32", "", "e"),
)

NOT_IN_SERIES = "no CB3 controller has it"


def names_for(major: int, also: tuple[str, ...] = ()) -> tuple[list[str], dict[str, str]]:
    """What to ask a controller for, and what is missing without asking, with the reason.

    Args:
        major: Of the controller's software: 3 for CB3, 5 for e-Series, 10 for PolyScope X.
        also: Names beyond the recorded ones, such as registers.
    """
    wanted = [field.name for field in FIELDS if major > 3 or field.since == "always"]
    missing = {field.name: NOT_IN_SERIES for field in FIELDS if field.name not in wanted}
    return [*wanted, *(name for name in also if name not in wanted)], missing
