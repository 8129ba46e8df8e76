"""URScript functions of poses and rotations.

The source is Universal Robots, "The URScript Programming Language", module urmath.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from hil.core import CommandRefused
from hil_mock_robot.ur.kinematics import (
    Frame,
    compose,
    frame_of,
    inverted,
    pose_from,
    pose_inv,
    pose_trans,
    rotation_of,
    rotation_vector,
)
from hil_mock_robot.ur.script_arguments import Answer, Given, Named, bound
from hil_mock_robot.ur.script_values import Pose, Value, number, shown, six

if TYPE_CHECKING:
    from hil_mock_robot.ur.script_evaluation import Evaluator

Six = Sequence[float]
STILL = (0.0, 0.0, 0.0)


def three(value: Any) -> tuple[float, ...]:
    """Return a list of three numbers as a tuple.

    Raises:
        CommandRefused: The value is not a list of three numbers.
    """
    if not isinstance(value, list) or len(value) != 3:
        raise CommandRefused(f"three numbers are needed, not {shown(value)}")
    return tuple(number(each) for each in value)


def _of(name: str, arguments: Sequence[str], function: Callable[..., Any]) -> Answer:
    """Return a URScript function of poses that returns a pose or a single number."""

    def answer(program: Evaluator, given: Given, named: Named) -> Value:
        found = function(*map(six, bound(name, given, named, arguments)))
        return found if isinstance(found, float) else Pose(float(each) for each in found)

    return answer


def _turn(pose: Six) -> Frame:
    return frame_of((*STILL, *pose[3:]))


def _add(one: Six, other: Six) -> list[float]:
    moved = [a + b for a, b in zip(one[:3], other[:3], strict=True)]
    return [*moved, *rotation_vector(compose(_turn(one), _turn(other)))]


def _sub(to: Six, start: Six) -> list[float]:
    moved = [a - b for a, b in zip(to[:3], start[:3], strict=True)]
    return [*moved, *rotation_vector(compose(inverted(_turn(start)), _turn(to)))]


def _pose_dist(start: Six, to: Six) -> float:
    """Return the root of the sum of squared distances [m] and angles [rad].

    The manual does not specify the weight of the rotation.
    """
    return math.hypot(*_sub(to, start))


def _point_dist(start: Six, to: Six) -> float:
    return math.dist(start[:3], to[:3])


def between(start: Six, to: Six, alpha: float) -> list[float]:
    """Return the pose of URScript `interpolate_pose` for `alpha` from 0 to 1.

    The position moves on a straight line and the orientation rotates about one axis.
    """
    x, y, z, *turn = _sub(to, start)
    turned = compose(_turn(start), frame_of((*STILL, *(alpha * each for each in turn))))
    moved = [a + alpha * b for a, b in zip(start[:3], (x, y, z), strict=True)]
    return [*moved, *rotation_vector(turned)]


def _interpolate(program: Evaluator, given: Given, named: Named) -> Value:
    start, to, alpha = bound("interpolate_pose", given, named, ["p_from", "p_to", "alpha"])
    return Pose(between(six(start), six(to), number(alpha)))


def _rpy2rotvec(program: Evaluator, given: Given, named: Named) -> Value:
    """Return the rotation vector of roll about x, then pitch about y, then yaw about z.

    The three rotation axes are fixed.
    """
    (angles,) = bound("rpy2rotvec", given, named, ["rpy_vector"])
    roll, pitch, yaw = three(angles)
    turns = ((0.0, 0.0, yaw), (0.0, pitch, 0.0), (roll, 0.0, 0.0))
    z, y, x = (frame_of((*STILL, *each)) for each in turns)
    return list(pose_from(compose(compose(z, y), x))[3:])


def _rotvec2rpy(program: Evaluator, given: Given, named: Named) -> Value:
    (vector,) = bound("rotvec2rpy", given, named, ["rotation_vector"])
    x, y, z = three(vector)
    r00, r01, _, r10, r11, _, r20, r21, r22 = rotation_of(x, y, z)
    pitch = math.atan2(-r20, math.hypot(r00, r10))
    if math.hypot(r00, r10) < 1e-12:  # gimbal lock: yaw and roll have the same axis
        return [0.0, pitch, math.atan2(-r01, r11)]
    return [math.atan2(r21, r22), pitch, math.atan2(r10, r00)]


POSES: dict[str, Answer] = {
    "interpolate_pose": _interpolate,
    "point_dist": _of("point_dist", ["p_from", "p_to"], _point_dist),
    "pose_add": _of("pose_add", ["p_1", "p_2"], _add),
    "pose_dist": _of("pose_dist", ["p_from", "p_to"], _pose_dist),
    "pose_inv": _of("pose_inv", ["p_from"], pose_inv),
    "pose_sub": _of("pose_sub", ["p_to", "p_from"], _sub),
    "pose_trans": _of("pose_trans", ["p_from", "p_from_to"], pose_trans),
    "rotvec2rpy": _rotvec2rpy,
    "rpy2rotvec": _rpy2rotvec,
}
