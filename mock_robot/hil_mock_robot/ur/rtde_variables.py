"""RTDE's variables: names, wire types, since which software, and their values after every tick.

`CB3` and `E_SERIES` are the two generations of controllers that are played (CB3: the paper's UR5).
`Values` are the present values of the inputs or outputs in one flat list, which recipes pack.
After every tick `Publishing` fills in joints, modes and supply, `Cartesian` what needs kinematics:
TCP, elbow, accelerometer, wrench. Quantities the plant does not have are simple but plausible
(docs/reference/mock-ur-rtde.md, docs/reference/mock-ur-motions.md).

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of outputs and inputs.
`tcp_offset` is not in it: Universal_Robots_Client_Library, pull request 110 (3.12.0 and 5.5.1).
What came after the versions that are played here is left out: it is not found.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg.lapack import dposv

from hil.core import FloatArray, SpecError
from hil_mock_robot.ur.contracts import Setpoint
from hil_mock_robot.ur.kinematics import (
    Frame,
    Posture,
    Triple,
    compose,
    frame_of,
    inverted,
    lengths_of,
    pose_from,
    turned,
    twist_of,
)
from hil_mock_robot.ur.modes import (
    JOINT_BOOTING,
    JOINT_FAULT,
    JOINT_IDLE,
    JOINT_POWER_OFF,
    JOINT_RUNNING,
    SAFETY_BITS,
    RobotMode,
    RuntimeState,
    SafetyMode,
)

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine


@dataclass(frozen=True, slots=True)
class Series:
    """What differs between generations.

    Attributes:
        name: `cb3` or `e`.
        version: Major, minor, bug-fix and build number of the controller software.
        date: Of that software, as it is told with the version.
        rate_hz: Ticks per second, also the highest RTDE rate [Hz].
        arms: Built-in arms that such a controller moves.
    """

    name: str
    version: tuple[int, int, int, int]
    date: str
    rate_hz: float
    arms: tuple[str, ...]

    @property
    def is_e(self) -> bool:
        """Whether it is an e-Series controller."""
        return self.version[0] >= 5

    def at_least(self, cb3: tuple[int, int] | None, e: tuple[int, int] | None) -> bool:
        """Whether its software has what came with these versions; None for never."""
        since = e if self.is_e else cb3
        return since is not None and self.version[:2] >= since


CB3 = Series("cb3", (3, 15, 8, 106339), "Apr 17 2022", 125.0, ("ur3", "ur5", "ur10"))
E_SERIES = Series("e", (5, 12, 2, 1101534), "Dec 02 2022", 500.0, ("ur3e", "ur5e", "ur10e"))


def series_of(arm: str) -> Series:
    """The controller that moves a built-in arm.

    Raises:
        SpecError: It is no arm of Universal Robots.
    """
    for series in (CB3, E_SERIES):
        if arm in series.arms:
            return series
    known = ", ".join(CB3.arms + E_SERIES.arms)
    raise SpecError(f"a UR controller moves no {arm}", hint=f"it moves {known}")


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
"""Type as RTDE names it → letter of `struct`, and how many of them."""

ALWAYS = (0, 0)

UPPER_SINCE = ((3, 9), (5, 3))
"""Since when there are registers 24 to 47, and single bits 64 to 127."""


@dataclass(frozen=True, slots=True)
class Variable:
    """One variable: its name, its wire type, and where its first value lies."""

    name: str
    type: str
    offset: int

    @property
    def count(self) -> int:
        """How many numbers it is."""
        return WIRE[self.type][1]

    @property
    def format(self) -> str:
        """Its letters for `struct`."""
        letter, count = WIRE[self.type]
        return letter * count

    @property
    def places(self) -> range:
        """Where its numbers lie in `Values.flat`."""
        return range(self.offset, self.offset + self.count)


class Values:
    """The present values of a set of variables.

    Args:
        named: (name, type), in any order.

    Attributes:
        variables: By name.
        flat: All numbers, one after the other; what a recipe packs.
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
        """Set a number, or a list of as many as the variable has.

        Raises:
            ValueError: They are more or fewer, which would shift all that lies behind them.
        """
        at, count = self._places[name]
        if count > 1 and len(value) != count:
            raise ValueError(f"{name}: {len(value)} numbers instead of {count}")
        self.flat[at] = value

    def __getitem__(self, name: str) -> Any:
        """A number, or a list of them."""
        return self.flat[self._places[name][0]]

    def offer(self, name: str, value: Number | Sequence[Number]) -> None:
        """Set it, where this software has it."""
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
    """Everything a controller tells by RTDE."""
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
    """Everything a controller can be told by RTDE."""
    named = [(name, kind) for name, kind, cb3, e in _INPUTS if series.at_least(cb3, e)]
    return Values([*named, *_registers("input", series)])


SUPPLY_V = 48.0

STANDBY_A = 0.5
"""What control box and joint electronics draw of the 48 V."""

WINDING_OHM = 1.0
"""Heat in each motor and its amplifier per square of its current; of a usual size."""

EXECUTION_MS = 0.35
"""`actual_execution_time` does not depend on the computer that simulates."""

DEVIATION_RAD = 0.1
"""Distance of actual from target position that `joint_position_deviation_ratio` counts as 1."""

CURRENT_WINDOW_A = 2.0
POWER_ON, PROGRAM_RUNNING = 1, 2
TOOL_RUNNING, TOOL_IDLE = 253, 255

JOINT_MODES = {
    RobotMode.RUNNING: JOINT_RUNNING,
    RobotMode.IDLE: JOINT_IDLE,
    RobotMode.POWER_ON: JOINT_IDLE,
    RobotMode.BOOTING: JOINT_BOOTING,
}


class Publishing:
    """Fills a machine's outputs."""

    def __init__(self) -> None:
        self._before: tuple[object, ...] = ()
        self._payload: object = None

    def publish(self, machine: Machine) -> None:
        """All that may change from tick to tick."""
        out, seen = machine.outputs, machine.reading
        out["timestamp"] = machine.now_s
        for name, values in zip(
            ("target_q", "target_qd", "target_qdd"), machine.setpoint, strict=True
        ):
            out[name] = values.tolist()
        out["target_current"] = seen.current_target.tolist()
        out["target_moment"] = seen.moment_target.tolist()
        out["actual_q"], out["actual_qd"] = seen.q.tolist(), seen.qd.tolist()
        out["actual_current"] = out["joint_control_output"] = seen.current.tolist()
        out["joint_temperatures"] = celsius = seen.temperature.tolist()
        out["tool_temperature"] = celsius[-1]
        if "joint_position_deviation_ratio" in out:
            apart = float(np.abs(machine.setpoint[0] - seen.q).max())
            out["joint_position_deviation_ratio"] = apart / DEVIATION_RAD
        self._publish_modes(machine)
        self._publish_load(machine)
        for publish in machine.publishers:
            publish(machine)
        out["actual_robot_current"] = _supply_current(machine)
        out["actual_momentum"] = _momentum(machine)

    def _publish_modes(self, machine: Machine) -> None:
        out, modes = machine.outputs, machine.modes
        moving = machine.motion is not None and np.abs(machine.setpoint[1]).max() > 0
        playing = machine.runtime is RuntimeState.PLAYING
        out["speed_scaling"] = 1.0 if moving or playing else 0.0
        out["target_speed_fraction"] = machine.speed_fraction
        now = modes.robot, modes.safety, machine.runtime
        if now == self._before:
            return
        self._before = now
        out["robot_mode"], out["safety_mode"] = int(modes.robot), int(modes.safety)
        out["safety_status_bits"] = SAFETY_BITS[modes.safety]
        out.offer("safety_status", int(modes.safety))
        out["runtime_state"] = int(machine.runtime)
        powered = modes.robot >= RobotMode.POWER_ON
        out["robot_status_bits"] = POWER_ON * powered + PROGRAM_RUNNING * playing
        fault = modes.safety in (SafetyMode.FAULT, SafetyMode.VIOLATION)
        joint = JOINT_FAULT if fault else JOINT_MODES.get(modes.robot, JOINT_POWER_OFF)
        out["joint_mode"] = [joint] * 6
        _publish_supply(out, powered=powered, running=modes.robot is RobotMode.RUNNING)

    def _publish_load(self, machine: Machine) -> None:
        out, payload = machine.outputs, machine.body.declared
        out.offer("tcp_offset", machine.tcp.tolist())
        if payload is self._payload:
            return
        self._payload = payload
        out.offer("payload", payload.mass)
        out.offer("payload_cog", payload.com)
        out.offer("payload_inertia", payload.inertia)


def _supply_current(machine: Machine) -> float:
    """What the robot draws of its 48 V [A]: electronics, heat in the motors, work of the joints."""
    if machine.modes.robot < RobotMode.POWER_ON:
        return 0.0
    seen = machine.reading
    heat = WINDING_OHM * float(seen.current @ seen.current)
    work = float(seen.moment_target @ machine.setpoint[1])
    return STANDBY_A + (heat + max(0.0, work)) / SUPPLY_V


def _momentum(machine: Machine) -> float:
    """Half the arm and the whole load at the speed of the TCP [kg·m/s]: a rough measure."""
    body = machine.body
    x, y, z, *_ = machine.outputs["actual_TCP_speed"]
    moved = 0.5 * float(body.arm.mass.sum()) + body.declared.mass
    return moved * math.sqrt(x * x + y * y + z * z)


def _publish_supply(out: Values, *, powered: bool, running: bool) -> None:
    """Voltages, and what else never changes while the mode stays."""
    out["actual_main_voltage"] = SUPPLY_V
    out["actual_robot_voltage"] = SUPPLY_V if powered else 0.0
    out["actual_joint_voltage"] = [SUPPLY_V if powered else 0.0] * 6
    out["actual_execution_time"] = EXECUTION_MS
    out["tool_mode"] = TOOL_RUNNING if running else TOOL_IDLE
    out.offer("actual_current_window", [CURRENT_WINDOW_A] * 6)


DAMPING = 0.05
"""Keeps a push finite in a singularity, where the joints do not feel some of it."""


class Cartesian:
    """Fills the outputs of one machine that need kinematics."""

    def __init__(self, machine: Machine) -> None:
        body = machine.body
        self._lengths = lengths_of(body.arm)
        self._gains = body.arm.drive_gains
        self._gravity: Triple = body.gravity
        self._rate = 1.0 / machine.tick_s
        self._damping = DAMPING**2 * np.eye(6)
        self._setpoint: Setpoint = np.empty((3, 6))
        self._tcp: FloatArray = np.empty(6)
        self._before: list[float] | None = None

    def publish(self, machine: Machine) -> None:
        """After every tick."""
        out, seen = machine.outputs, machine.reading
        tool = frame_of(machine.tcp)
        if machine.setpoint is not self._setpoint or machine.tcp is not self._tcp:
            self._setpoint, self._tcp = machine.setpoint, machine.tcp
            self._publish_target(out, tool)
        posture = Posture(self._lengths, seen.q)
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        speeds = seen.qd.tolist()
        out["actual_TCP_pose"] = pose_from(frame)
        out["actual_TCP_speed"] = twist_of(J, speeds)
        if "elbow_position" in out:
            out["elbow_position"] = posture.elbow
            out["elbow_velocity"] = posture.elbow_velocity(speeds)
        wrench = self._wrench(machine, J)
        out["actual_TCP_force"] = wrench
        out["tcp_force_scalar"] = sqrt(wrench[0] ** 2 + wrench[1] ** 2 + wrench[2] ** 2)
        out["actual_tool_accelerometer"] = felt = self._felt(posture, out["target_TCP_speed"])
        if "ft_raw_wrench" in out:
            out["ft_raw_wrench"] = raw_wrench(machine, posture, felt)

    def _publish_target(self, out: Values, tool: Frame) -> None:
        """What follows from the set-point, which mostly stands still in a dwell program."""
        posture = Posture(self._lengths, self._setpoint[0])
        frame = compose(posture.flange, tool)
        J = posture.jacobian((frame[9], frame[10], frame[11]))
        out["target_TCP_pose"] = pose_from(frame)
        out["target_TCP_speed"] = twist_of(J, self._setpoint[1])

    def _wrench(self, machine: Machine, jacobian: list[float]) -> list[float]:
        """What pushes the tool, from the torque that the servo's model does not explain."""
        if machine.body.braked:
            return [0.0] * 6
        seen = machine.reading
        torque = (seen.current_target - seen.current) * self._gains
        J = np.array(jacobian).reshape(6, 6)
        _, wrench, _ = dposv(J @ J.T + self._damping, J @ torque)
        numbers: list[float] = wrench.tolist()
        return numbers

    def _felt(self, posture: Posture, twist: list[float]) -> Triple:
        """Acceleration of the set-point less gravity, in the flange's axes [m/s²]."""
        before = self._before or twist
        self._before = twist
        gx, gy, gz = self._gravity
        x, y, z = (self._rate * (twist[i] - before[i]) for i in range(3))
        return turned(inverted(posture.flange), x - gx, y - gy, z - gz)


def raw_wrench(machine: Machine, posture: Posture, felt: Triple) -> list[float]:
    """(6,) force [N] and torque [N·m] on the flange, in its axes, about its origin.

    The weight and inertia of what really hangs there, as a point mass that does not turn, and the
    pushes of the side channel. Ideal: no noise, no offset, nothing taken off for what is declared.

    Args:
        machine: Whose arm.
        posture: Where its flange is.
        felt: Acceleration less gravity, in the axes of the flange [m/s²].
    """
    load = machine.body.mounted
    fx, fy, fz = (-load.mass * each for each in felt)
    x, y, z = load.com
    wrench = [fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx]
    push = machine.body.pushed
    if not push.any():
        return wrench
    flange = posture.flange
    J = np.array(posture.jacobian((flange[9], flange[10], flange[11]))).reshape(6, 6)
    pushed = np.linalg.solve(J @ J.T + DAMPING**2 * np.eye(6), J @ push).tolist()
    back = inverted(flange)
    along = (*turned(back, *pushed[:3]), *turned(back, *pushed[3:]))
    return [a + b for a, b in zip(wrench, along, strict=True)]
