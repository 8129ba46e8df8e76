"""The control script's motion commands, with the script's own peculiarities."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

from hil.core import FloatArray
from hil_mock_robot.ur.motions import Leg
from hil_mock_robot.ur.moving import joints_of, pose_at, stop_joints, stop_line
from hil_mock_robot.ur.path import follow
from hil_mock_robot.ur.threaded import Steps

if TYPE_CHECKING:
    from hil_mock_robot.ur.control_script import ControlScript

MOVE, STOP = "move", "stop"
"""Threads."""


def _movej(script: ControlScript) -> Steps:
    return _move(script, "j", script.registers.doubles(0), is_pose=False)


def _movej_ik(script: ControlScript) -> Steps:
    """The arm's posture is chosen here, not where an asynchronous move comes to its turn."""
    q = joints_of(script.machine, script.registers.doubles(0))
    return _move(script, "j", q, is_pose=False)


def _movel(script: ControlScript) -> Steps:
    return _move(script, "l", script.registers.doubles(0), is_pose=True)


def _movel_fk(script: ControlScript) -> Steps:
    return _move(script, "l", script.registers.doubles(0), is_pose=False)


def _move(
    script: ControlScript, kind: Literal["j", "l"], target: FloatArray, *, is_pose: bool
) -> Steps:
    v, a = script.registers.doubles(6, 2).tolist()
    script.waypoint = target if is_pose else pose_at(script.machine, target)
    leg = Leg(kind, target, v, a, is_pose=is_pose)
    return _now_or_later(script, lambda: follow(script, [leg]))


def _move_path(script: ControlScript) -> Steps:
    legs, marks = [leg for _, leg in script.path], [mark for mark, _ in script.path]

    def reached(index: int) -> None:
        leg = legs[index]
        script.waypoint = leg.target if leg.is_pose else pose_at(script.machine, leg.target)
        for mark in marks[index]:
            script.operation.progress(mark)

    return _now_or_later(script, lambda: follow(script, legs, reached))


def _now_or_later(script: ControlScript, move: Callable[[], Steps]) -> Steps:
    """Move, and be done when that is over, or leave it to a thread and be done at once."""
    stop_move(script)
    if script.registers.integer(1) == 1:
        script.run(MOVE, _operation(script, move))
    else:
        yield from move()


def _operation(script: ControlScript, what: Callable[[], Steps]) -> Steps:
    script.operation.start()
    yield from what()
    script.operation.finish()


def stop_move(script: ControlScript) -> None:
    """End the asynchronous move, if there is one; somebody else has to stop the arm."""
    if script.runs(MOVE):
        script.kill(MOVE)
        script.operation.finish()


def _stop(script: ControlScript) -> Steps:
    """Both stopJ and stopL: how it stops is what the script remembers, not what was asked for."""
    deceleration = script.registers.double(0)
    if script.runs(STOP):
        script.kill(STOP)
        script.operation.finish()
    else:
        stop_move(script)
    if script.registers.integer(1) == 1:
        script.stop_linear = True
        script.run(STOP, _operation(script, lambda: stop_line(script, deceleration)))
    elif script.stop_linear:
        yield from stop_line(script, deceleration)
    else:
        yield from stop_joints(script, deceleration)


MOVES: dict[int, Callable[[ControlScript], Steps | None]] = {
    1: _movej,
    2: _movej_ik,
    3: _movel,
    4: _movel_fk,
    33: _stop,
    34: _stop,
    45: _move_path,
}
