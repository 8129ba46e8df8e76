"""Forward, differential and inverse kinematics of the controller, by the arm's published lengths.

Poses are (6,): metres and rotation vector [rad] of the tool in the base frame; `tcp` is the tool in
the flange frame. Inputs may be lists or arrays, results are arrays.
"""

from __future__ import annotations

import numpy as np

from hil.arms import ArmDescription
from hil.core import FloatArray
from hil_mock_robot.ur.chain import Posture, lengths_of, twist_of
from hil_mock_robot.ur.inverse import solve
from hil_mock_robot.ur.poses import Frame, Numbers, compose, frame_of, pose_from
from hil_mock_robot.ur.poses import pose_inv as pose_inv
from hil_mock_robot.ur.poses import pose_trans as pose_trans

__all__ = ["jacobian", "pose_inv", "pose_of", "pose_trans", "solve", "tool_frame", "tool_velocity"]


def tool_frame(arm: ArmDescription, q: Numbers, tcp: Numbers) -> Frame:
    """Frame of the tool at `q` (6,) [rad]."""
    return compose(Posture(lengths_of(arm), q).flange, frame_of(tcp))


def pose_of(arm: ArmDescription, q: Numbers, tcp: Numbers) -> FloatArray:
    """URScript `get_forward_kin`: pose (6,) of the tool at `q` (6,) [rad]."""
    return np.array(pose_from(tool_frame(arm, q, tcp)))


def jacobian(arm: ArmDescription, q: Numbers, tcp: Numbers) -> FloatArray:
    """Geometric Jacobian (6, 6) of the tool in the base frame: linear rows, then angular ones."""
    return np.array(_jacobian(arm, q, tcp)).reshape(6, 6)


def tool_velocity(arm: ArmDescription, q: Numbers, qd: Numbers, tcp: Numbers) -> FloatArray:
    """Velocity (6,) of the tool in the base frame, [m/s] and [rad/s]."""
    return np.array(twist_of(_jacobian(arm, q, tcp), qd))


def _jacobian(arm: ArmDescription, q: Numbers, tcp: Numbers) -> list[float]:
    posture = Posture(lengths_of(arm), q)
    tool = compose(posture.flange, frame_of(tcp))
    return posture.jacobian((tool[9], tool[10], tool[11]))
