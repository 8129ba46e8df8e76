"""URScript functions that return the state of the arm, inputs and registers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import CommandRefused
from hil_mock_robot.ur.kinematics import pose_of
from hil_mock_robot.ur.program import is_steady, joint_torques, joints_of, pose_at, within_limits
from hil_mock_robot.ur.script_arguments import Answer, Given, Named, bound
from hil_mock_robot.ur.script_maths import MATHS
from hil_mock_robot.ur.script_poses import POSES
from hil_mock_robot.ur.script_values import Pose, Value, integer, six

if TYPE_CHECKING:
    from hil_mock_robot.ur.machine import Machine
    from hil_mock_robot.ur.script_evaluation import Evaluator

LARGEST_BIT = 127


def _indexed(name: str, argument: str, most: int, read: Callable[[Machine, int], Value]) -> Answer:
    """Return a URScript function that reads one of several items of a kind by its index."""

    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        (index,) = bound(name, given, named, [argument])
        return read(program.machine, integer(index, 0, most))

    return answer


def _register(side: str, kind: str, cast: Callable[[Any], Value]) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        machine = program.machine
        (index,) = bound(f"read_{side}_register", given, named, ["address"])
        values = machine.inputs if side == "input" else machine.outputs
        most = 47 if f"{side}_int_register_47" in values else 23
        return cast(values[f"{side}_{kind}_register_{integer(index, 0, most)}"])

    return answer


def _bit_register(side: str) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        machine = program.machine
        (address,) = bound(f"read_{side}_boolean_register", given, named, ["address"])
        index = integer(address, 0, LARGEST_BIT)
        values = machine.inputs if side == "input" else machine.outputs
        if index < 64:
            first = index // 32 * 32
            return bool(values[f"{side}_bit_registers{first}_to_{first + 31}"] >> index % 32 & 1)
        name = f"{side}_bit_register_{index}"
        if name not in values:
            raise CommandRefused(f"there is no {name}")
        return bool(values[name])

    return answer


def _digital(side: str) -> Callable[[Machine, int], Value]:
    return lambda machine, n: bool(machine.outputs[f"actual_digital_{side}_bits"] >> n & 1)


def _analog(side: str) -> Callable[[Machine, int], Value]:
    """Return a function that reads an analog signal [V or A]."""
    return lambda machine, n: float(machine.outputs[f"standard_analog_{side}{n}"])


def _state(find: Callable[[Machine], Iterable[float]], kind: type[list[Any]] = list) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        return kind(float(each) for each in find(program.machine))

    return answer


def _output(name: str) -> Answer:
    return _state(lambda machine: machine.outputs[name])


def _single(find: Callable[[Machine], Value]) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        return find(program.machine)

    return answer


def _solution(name: str, program: Evaluator, given: Given, named: Named) -> list[Any]:
    optional = {"qnear": None, "maxPositionError": 1e-10, "maxOrientationError": 1e-10}
    pose, near, *_ = bound(name, given, named, ["x"], optional)
    q_near = None if near is None else np.array(six(near))
    return [float(each) for each in joints_of(program.machine, np.array(six(pose)), q_near)]


def _inverse_kin(program: Evaluator, given: Given, named: Named) -> Value:
    return _solution("get_inverse_kin", program, given, named)


def _has_solution(program: Evaluator, given: Given, named: Named) -> Value:
    name = "get_inverse_kin_has_solution"
    named = {("x" if key == "pose" else key): value for key, value in named.items()}
    for pose in given[:1]:
        six(pose)  # an invalid pose is an error, whereas a pose out of reach returns False
    try:
        _solution(name, program, given, named)
    except CommandRefused as error:
        if not error.message.startswith("get_inverse_kin:"):
            raise
        return False
    return True


def _is_safe(program: Evaluator, given: Given, named: Named) -> Value:
    """Return whether a position is within joint limits and reach; the mock has no safety planes."""
    (where,) = bound("is_within_safety_limits", given, named, ["pose"])
    if isinstance(where, Pose):
        return _has_solution(program, [where], {})
    return within_limits(program.machine, np.array(six(where)))


def _forward_kin(program: Evaluator, given: Given, named: Named) -> Value:
    q, tcp = bound("get_forward_kin", given, named, [], {"q": None, "tcp": None})
    machine = program.machine
    joints = machine.reading.q if q is None else six(q)
    tool = machine.tcp if tcp is None else six(tcp)
    return Pose(float(each) for each in pose_of(machine.body.arm, joints, tool))


def _flange_pose(machine: Machine) -> Iterable[float]:
    return pose_of(machine.body.arm, machine.reading.q, np.zeros(6))


def _temperature(machine: Machine, joint: int) -> Value:
    return float(machine.outputs["joint_temperatures"][joint])


STATE: dict[str, Answer] = {
    "force": _single(lambda m: math.hypot(*map(float, m.outputs["actual_TCP_force"][:3]))),
    "get_actual_joint_positions": _state(lambda m: m.reading.q),
    "get_actual_joint_speeds": _state(lambda m: m.reading.qd),
    "get_actual_tcp_pose": _state(lambda m: pose_at(m, m.reading.q), Pose),
    "get_actual_tcp_speed": _output("actual_TCP_speed"),
    "get_actual_tool_flange_pose": _state(_flange_pose, Pose),
    "get_forward_kin": _forward_kin,
    "get_inverse_kin": _inverse_kin,
    "get_inverse_kin_has_solution": _has_solution,
    "get_joint_temp": _indexed("get_joint_temp", "j", 5, _temperature),
    "get_joint_torques": _state(joint_torques),
    "get_steptime": _single(lambda m: m.tick_s),
    "get_target_joint_positions": _state(lambda m: m.setpoint[0]),
    "get_target_joint_speeds": _state(lambda m: m.setpoint[1]),
    "get_target_payload": _single(lambda m: m.body.declared.mass),
    "get_target_payload_cog": _state(lambda m: m.body.declared.com),
    "get_target_tcp_pose": _state(lambda m: pose_at(m, m.setpoint[0]), Pose),
    "get_target_tcp_speed": _output("target_TCP_speed"),
    "get_tcp_force": _output("actual_TCP_force"),
    "get_tcp_offset": _state(lambda m: m.tcp, Pose),
    "is_steady": _single(is_steady),
    "is_within_safety_limits": _is_safe,
}
SIGNALS: dict[str, Answer] = {
    **{name: _indexed(name, "n", 17, _digital(name.rpartition("_")[2] + "put"))
       for name in ("get_digital_in", "get_digital_out",
                    "get_standard_digital_in", "get_standard_digital_out")},
    **{name: _indexed(name, "n", 1, _analog(name.rpartition("_")[2] + "put"))
       for name in ("get_analog_in", "get_analog_out",
                    "get_standard_analog_in", "get_standard_analog_out")},
    **{f"read_{side}_{said}_register": _register(side, kind, cast)
       for side in ("input", "output")
       for said, kind, cast in (("integer", "int", int), ("float", "double", float))},
    **{f"read_{side}_boolean_register": _bit_register(side) for side in ("input", "output")},
}  # fmt: skip
ANSWERS: dict[str, Answer] = {**MATHS, **POSES, **STATE, **SIGNALS}
