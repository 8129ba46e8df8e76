"""URScript motion functions of uploaded programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hil.core import CommandRefused
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.motion import ServoJ
from hil_mock_robot.ur.program import Steps, follow, pose_at, speed_motion, stop_joints, stop_line
from hil_mock_robot.ur.routes import Leg
from hil_mock_robot.ur.script_arcs import arc_legs
from hil_mock_robot.ur.script_arguments import Given, Named, bound
from hil_mock_robot.ur.script_values import Pose, integer, number, six

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_evaluation import Evaluator

Motions = Callable[["Evaluator", Given, Named], Steps]

MOVES: Mapping[str, tuple[Literal["j", "l", "p"], Mapping[str, float]]] = {
    "movej": ("j", {"a": 1.4, "v": 1.05, "t": 0.0, "r": 0.0}),
    "movel": ("l", {"a": 1.2, "v": 0.25, "t": 0.0, "r": 0.0}),
    "movep": ("p", {"a": 1.2, "v": 0.25, "r": 0.0}),
}
"""URScript moves with their default speeds and accelerations."""
LONGEST_S, LEAST_A = 86_400.0, 1e-3


def leg_of(kind: str, given: Given, named: Named) -> Leg:
    """Return a move of `MOVES` as a leg of a path.

    Raises:
        CommandRefused: The arguments are invalid.
    """
    target, *rest = bound(kind, given, named, ["target"], MOVES[kind][1])
    of = dict(zip(MOVES[kind][1], map(number, rest), strict=True))
    return Leg(
        MOVES[kind][0], np.array(six(target)), of["v"], of["a"], radius=max(0.0, of["r"]),
        time_s=max(0.0, of.get("t", 0.0)), is_pose=isinstance(target, Pose),
    )  # fmt: skip


def _stopj(program: Evaluator, given: Given, named: Named) -> Steps:
    (a,) = bound("stopj", given, named, ["a"])
    return stop_joints(program, number(a))


def _stopl(program: Evaluator, given: Given, named: Named) -> Steps:
    a, _ = bound("stopl", given, named, ["a"], {"aRot": 0.0})
    return stop_line(program, number(a))


def _servoj(program: Evaluator, given: Given, named: Named) -> Steps:
    optional = {"a": 0.0, "v": 0.0, "t": 0.002, "lookahead_time": 0.1, "gain": 300.0}
    q, _, _, *rest = bound("servoj", given, named, ["q"], optional)
    target = np.array(six(q))
    t, lookahead, gain = map(number, rest)
    machine = program.machine
    with program.control():
        if program.servo is None or machine.motion is not program.servo:
            program.servo = ServoJ(machine.tick_s, machine.body.arm)
            machine.move(program.servo)
        program.servo.aim(target, t, lookahead, gain)
        yield from program.wait(_ticks(machine, t))


def _speedj(program: Evaluator, given: Given, named: Named) -> Steps:
    return _speed(program, "speedj", given, named)


def _speedl(program: Evaluator, given: Given, named: Named) -> Steps:
    return _speed(program, "speedl", given, named)


def _speed(program: Evaluator, kind: str, given: Given, named: Named) -> Steps:
    """Move with a speed for the time `t`; without `t`, for the duration of the acceleration."""
    named = {("t" if name == "t_min" else name): value for name, value in named.items()}
    optional = {"a": 1.4, "t": 0.0, "aRot": 0.0}
    wanted, a, t, _ = bound(kind, given, named, ["speed"], optional)
    machine, linear = program.machine, kind == "speedl"
    motion = speed_motion(machine, linear=linear)
    speed = np.array(six(wanted))
    motion.aim(speed, abs(number(a)))
    seconds = number(t) or float(np.abs(speed).max()) / max(abs(a), LEAST_A)
    with program.control():
        machine.move(motion)
        yield from program.wait(_ticks(machine, seconds))


def _ticks(machine: Machine, seconds: float) -> int:
    if not 0 <= seconds <= LONGEST_S:
        raise CommandRefused(f"invalid duration {seconds:g} s")
    return max(1, round(seconds / machine.tick_s))


def _movec(program: Evaluator, given: Given, named: Named) -> Steps:
    """Move along an arc and stop at its end, without a blend with the next move."""
    optional = {"a": 1.2, "v": 0.25, "r": 0.0, "mode": 0}
    via, to, a, v, _, mode = bound("movec", given, named, ["pose_via", "pose_to"], optional)
    machine = program.machine
    start = pose_at(machine, machine.setpoint[0]).tolist()
    targets = _pose(machine, via), _pose(machine, to)
    fixed = integer(mode, 0, 1) == 1
    return follow(program, arc_legs(start, *targets, number(v), number(a), fixed=fixed))


def _pose(machine: Machine, where: Any) -> tuple[float, ...]:
    """Return the target pose from a pose or from joint angles."""
    if isinstance(where, Pose):
        return six(where)
    return tuple(map(float, pose_at(machine, six(where))))


def _sleep(program: Evaluator, given: Given, named: Named) -> Steps:
    (t,) = bound("sleep", given, named, ["t"])
    return program.wait(_ticks(program.machine, number(t)))


def _sync(program: Evaluator, given: Given, named: Named) -> Steps:
    bound("sync", given, named, [])
    return program.wait()


def _unknown_motion(program: Evaluator, given: Given, named: Named) -> Steps:
    raise CommandRefused("the mock does not support this motion")


MOTIONS: dict[str, Motions] = {
    "movec": _movec,
    "servoc": _unknown_motion,
    "servoj": _servoj,
    "sleep": _sleep,
    "speedj": _speedj,
    "speedl": _speedl,
    "stopj": _stopj,
    "stopl": _stopl,
    "sync": _sync,
}
