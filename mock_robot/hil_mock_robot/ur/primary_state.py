"""The robot state of the primary and secondary interface: one packet of sub-packages.

Source: Universal Robots, "Primary and Secondary Interfaces", robot state message of 3.15 and
5.10; sizes as in a state packet of software 5.8 (1386 bytes, tests of UR's client library). CB3: a
UR10 of 3.5.3 sends 1350 (python-urx issue 65), which is this without what is the tool's in 11 and
12, and without the last byte of the master board, which that library reads on both series.
Everything is big-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING

from hil_mock_robot.ur.mode_codes import RobotMode, RuntimeState, SafetyMode
from hil_mock_robot.ur.primary_facts import configuration, kinematics

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine

ROBOT_STATE = 16
EMERGENCY = (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP)
PROTECTIVE = (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP)
BOX_C, SUPPLY_V = 24.0, 48.0
AUTOMATIC, PRESSED = 1, 1
TOOL_BAUD = 115_200


def state_packet(machine: Machine) -> bytes:
    """Everything that is published at 10 Hz."""
    parts = b"".join(
        struct.pack(">IB", 5 + len(body), kind) + body for kind, body in _parts(machine)
    )
    return struct.pack(">iB", 5 + len(parts), ROBOT_STATE) + parts


def _parts(machine: Machine) -> Iterator[tuple[int, bytes]]:
    """Type and content of the sub-packages, in the order of the real ones."""
    yield 0, _robot_mode(machine)
    yield 1, _joints(machine)
    yield 4, _cartesian(machine)
    yield 5, kinematics(machine.body.arm)
    yield 9, bytes(48)  # calibration data, for UR's own software only
    yield 3, _master_board(machine)
    yield 2, _tool(machine)
    yield 6, configuration(machine.body.arm, machine.series)
    yield 7, _force_mode(machine)
    yield 8, bytes((0, 1, 0, 1)) if machine.series.is_e else bytes((0, 1, 0))
    yield 10, bytes(38)  # safety data, for UR's own software only
    if not machine.series.is_e:
        return
    yield 11, struct.pack(">?iiiff", False, TOOL_BAUD, 0, 1, 1.5, 3.5)
    yield 12, bytes((0, 1, 1))


def _robot_mode(machine: Machine) -> bytes:
    modes, out = machine.modes, machine.outputs
    powered = modes.robot >= RobotMode.POWER_ON
    return struct.pack(
        ">Q7?BB3dB",
        round(machine.now_s * 1e6),
        True,
        modes.robot is RobotMode.RUNNING,
        powered,
        modes.safety in EMERGENCY,
        modes.safety in PROTECTIVE,
        machine.runtime is RuntimeState.PLAYING,
        machine.runtime is RuntimeState.PAUSED,
        int(modes.robot) & 0xFF,
        0,
        out["target_speed_fraction"],
        out["speed_scaling"],
        1.0,
        0,
    )


def _joints(machine: Machine) -> bytes:
    out = machine.outputs
    columns = zip(
        out["actual_q"],
        out["target_q"],
        out["actual_qd"],
        out["actual_current"],
        out["actual_joint_voltage"],
        out["joint_temperatures"],
        (0.0,) * 6,
        out["joint_mode"],
        strict=True,
    )
    return b"".join(struct.pack(">3d4fB", *joint) for joint in columns)


def _cartesian(machine: Machine) -> bytes:
    return struct.pack(">12d", *machine.outputs["actual_TCP_pose"], *machine.tcp)


def _master_board(machine: Machine) -> bytes:
    out, safety = machine.outputs, machine.modes.safety
    types = out["analog_io_types"]
    body = struct.pack(
        ">IIBBddBBddffff",
        out["actual_digital_input_bits"] & 0xFFFFFFFF,
        out["actual_digital_output_bits"] & 0xFFFFFFFF,
        types & 1,
        types >> 1 & 1,
        out["standard_analog_input0"],
        out["standard_analog_input1"],
        types >> 2 & 1,
        types >> 3 & 1,
        out["standard_analog_output0"],
        out["standard_analog_output1"],
        BOX_C,
        SUPPLY_V,
        out["actual_robot_current"],
        out["io_current"],
    )
    reduced = safety is SafetyMode.REDUCED
    return body + struct.pack(">B??IBBB", int(safety), reduced, False, 0, AUTOMATIC, PRESSED, 0)


def _tool(machine: Machine) -> bytes:
    out = machine.outputs
    types = out["tool_analog_input_types"]
    return struct.pack(
        ">BBddfBffB",
        types & 1,
        types >> 1 & 1,
        out["tool_analog_input0"],
        out["tool_analog_input1"],
        SUPPLY_V,
        out["tool_output_voltage"] & 0xFF,
        out["tool_output_current"],
        out["tool_temperature"],
        out["tool_mode"] & 0xFF,
    )


def _force_mode(machine: Machine) -> bytes:
    return struct.pack(">7d", *machine.outputs["actual_TCP_force"], 0.0)
