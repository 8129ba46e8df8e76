"""A mock robot's truth in the parameters of the identification, by a route of its own.

The mock keeps links in their distal DH frames and moves them with MuJoCo; the identification's
parameters are those of Pinocchio's joint frames. Only the transform between the two frames of one
link leads from one to the other, and it is written here once more, from the DH convention.
"""

from __future__ import annotations

import numpy as np

from hil.arms import load_arm
from hil.core.typing import FloatArray
from hil.dynamics import BaseParameters
from hil.dynamics.inertial import body_parameters
from hil_mock_robot.plant.truth import LinkTruth, Truth


def true_parameters(truth: Truth) -> FloatArray:
    """(11 n,) inertial parameters and rotor inertias in the order of `RobotModel.parameters`."""
    dh = load_arm(truth.arm).dh
    links = [_in_joint_frame(link, row) for link, row in zip(truth.links, dh, strict=True)]
    rotors = [joint.drive.rotor_kgm2 for joint in truth.joints]
    return np.concatenate([*links, np.array(rotors)])


def true_coefficients(truth: Truth, base: BaseParameters) -> FloatArray:
    """(b + 3 n,) base parameters, then Coulomb, viscous and offset of every joint.

    They are what an `ideal` robot has; a `full` one has friction that no such numbers describe,
    and these are those its own law is built around.
    """
    friction = [
        (
            joint.friction.coulomb_nm,
            joint.friction.viscous_nm,
            joint.friction.offset_nm - joint.drive.constant_nm,
        )
        for joint in truth.joints
    ]
    return np.concatenate([base.combine(true_parameters(truth)), np.ravel(friction)])


def true_gains(truth: Truth) -> FloatArray:
    """(n,) K1 [N·m/A]."""
    return np.array([joint.drive.gain_nm_a for joint in truth.joints])


def sign_widths(truth: Truth, otherwise: float = 0.01) -> FloatArray:
    """(n,) width [rad/s] of an ideal robot's smooth sign; `otherwise` where friction has memory."""
    return np.array([joint.friction.smooth_rad_s or otherwise for joint in truth.joints])


def _in_joint_frame(link: LinkTruth, dh: FloatArray) -> FloatArray:
    """(10,) of one link; the distal frame lies at Tz(d)·Tx(a)·Rx(α) in the joint's."""
    a, alpha, d, _ = dh
    c, s = np.cos(alpha), np.sin(alpha)
    R = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    xx, yy, zz, xy, xz, yz = link.inertia_kgm2
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    com = np.array([a, 0.0, d]) + R @ np.array(link.com_m)
    return body_parameters(link.mass_kg, com, R @ inertia @ R.T)
