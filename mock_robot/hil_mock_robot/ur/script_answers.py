"""Functions of uploaded programs that only return something."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.errors import CommandRefused
from hil_mock_robot.ur.kinematics import pose_inv, pose_of, pose_trans
from hil_mock_robot.ur.moving import is_steady, joints_of, pose_at
from hil_mock_robot.ur.script_arguments import Given, Named, bound
from hil_mock_robot.ur.script_values import Pose, Value, integer, joined, number, shown, six

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_evaluation import Evaluator

Answer = Callable[["Evaluator", Given, Named], Value]


def _of_number(function: Callable[[float], float]) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        (value,) = bound(function.__name__, given, named, ["f"])
        try:
            return function(number(value))
        except (ValueError, OverflowError) as error:
            raise CommandRefused(f"{function.__name__}({value}): {error}") from error

    return answer


def _norm(program: Evaluator, given: Given, named: Named) -> Value:
    (value,) = bound("norm", given, named, ["a"])
    if not isinstance(value, list):
        return abs(number(value))
    return math.hypot(*(number(each) for each in value[: 3 if isinstance(value, Pose) else None]))


def _input(name: str, read: Callable[[Evaluator, int], Value]) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        (index,) = bound(name, given, named, ["address"])
        most = 47 if "input_int_register_47" in program.machine.inputs else 23
        return read(program, integer(index, 0, most))

    return answer


def _digital_in(program: Evaluator, given: Given, named: Named) -> Value:
    (index,) = bound("get_digital_in", given, named, ["n"])
    return bool(program.machine.outputs["actual_digital_input_bits"] >> integer(index, 0, 17) & 1)


def _digital_out(program: Evaluator, given: Given, named: Named) -> Value:
    (index,) = bound("get_digital_out", given, named, ["n"])
    return bool(program.machine.outputs["actual_digital_output_bits"] >> integer(index, 0, 17) & 1)


def _state(find: Callable[[Evaluator], Iterable[float]], kind: type[list[Any]] = list) -> Answer:
    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        return kind(float(each) for each in find(program))

    return answer


def _inverse_kin(program: Evaluator, given: Given, named: Named) -> Value:
    optional = {"qnear": None, "maxPositionError": 1e-10, "maxOrientationError": 1e-10}
    pose, near, *_ = bound("get_inverse_kin", given, named, ["x"], optional)
    q_near = None if near is None else np.array(six(near))
    return _floats(joints_of(program.machine, np.array(six(pose)), q_near))


def _forward_kin(program: Evaluator, given: Given, named: Named) -> Value:
    q, tcp = bound("get_forward_kin", given, named, [], {"q": None, "tcp": None})
    machine = program.machine
    joints = machine.reading.q if q is None else six(q)
    return Pose(
        _floats(pose_of(machine.body.arm, joints, machine.tcp if tcp is None else six(tcp)))
    )


def _pose_trans(program: Evaluator, given: Given, named: Named) -> Value:
    a, b = bound("pose_trans", given, named, ["p_from", "p_from_to"])
    return Pose(_floats(pose_trans(six(a), six(b))))


def _pose_inv(program: Evaluator, given: Given, named: Named) -> Value:
    (pose,) = bound("pose_inv", given, named, ["p_from"])
    return Pose(_floats(pose_inv(six(pose))))


def _steady(program: Evaluator, given: Given, named: Named) -> Value:
    return is_steady(program.machine)


def _step_time(program: Evaluator, given: Given, named: Named) -> Value:
    return program.machine.tick_s


def _payload(program: Evaluator, given: Given, named: Named) -> Value:
    return program.machine.body.declared.mass


def _to_str(program: Evaluator, given: Given, named: Named) -> Value:
    (value,) = bound("to_str", given, named, ["val"])
    return shown(value)


def _str_cat(program: Evaluator, given: Given, named: Named) -> Value:
    return joined(given)


def _floats(values: Iterable[float]) -> list[Any]:
    return [float(each) for each in values]


ANSWERS: dict[str, Answer] = {
    "acos": _of_number(math.acos),
    "asin": _of_number(math.asin),
    "atan": _of_number(math.atan),
    "ceil": _of_number(math.ceil),
    "cos": _of_number(math.cos),
    "d2r": _of_number(math.radians),
    "floor": _of_number(math.floor),
    "get_actual_joint_positions": _state(lambda program: program.machine.reading.q),
    "get_actual_joint_speeds": _state(lambda program: program.machine.reading.qd),
    "get_actual_tcp_pose": _state(lambda p: pose_at(p.machine, p.machine.reading.q), Pose),
    "get_digital_in": _digital_in,
    "get_digital_out": _digital_out,
    "get_forward_kin": _forward_kin,
    "get_inverse_kin": _inverse_kin,
    "get_standard_digital_in": _digital_in,
    "get_standard_digital_out": _digital_out,
    "get_steptime": _step_time,
    "get_target_joint_positions": _state(lambda program: program.machine.setpoint[0]),
    "get_target_joint_speeds": _state(lambda program: program.machine.setpoint[1]),
    "get_target_payload": _payload,
    "get_target_payload_cog": _state(lambda program: program.machine.body.declared.com),
    "get_target_tcp_pose": _state(lambda p: pose_at(p.machine, p.machine.setpoint[0]), Pose),
    "get_tcp_offset": _state(lambda program: program.machine.tcp, Pose),
    "is_steady": _steady,
    "norm": _norm,
    "pose_inv": _pose_inv,
    "pose_trans": _pose_trans,
    "r2d": _of_number(math.degrees),
    "read_input_float_register": _input(
        "read_input_float_register", lambda p, i: p.registers.double(i)
    ),
    "read_input_integer_register": _input(
        "read_input_integer_register", lambda p, i: p.registers.integer(i)
    ),
    "sin": _of_number(math.sin),
    "sqrt": _of_number(math.sqrt),
    "str_cat": _str_cat,
    "tan": _of_number(math.tan),
    "to_str": _to_str,
}
